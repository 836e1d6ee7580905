"""Strategies of mixtures: molecules of all kinds, from the simplest, to which Hypothesis shrinks."""

from __future__ import annotations

import functools

import numpy as np
from hypothesis import strategies as st

from tests.laws.methods import Method
from tests.laws.mixtures import FORMS, PREPARATIONS, SURROUNDINGS, Mixture
from tests.laws.molecules import (
    HELD_BY_CONSTRAINTS,
    SHAPES,
    SITES,
    Alike,
    Body,
    Chain,
    Frozen,
    Ion,
    Jointed,
    Molecule,
    Ring,
    Star,
    Tethered,
    Water,
    WithSite,
)

#: Most particles of a mixture.
PARTICLES = 30


@functools.cache
def molecules(named: bool = True) -> st.SearchStrategy[Molecule]:
    """Draw a molecule of any kind, the simplest first, with or without named bodies."""
    ions = st.builds(Ion, st.sampled_from([1.0, -1.0]), st.booleans())
    waters = st.builds(Water, st.sampled_from(["rigid", "hydrogens", "flexible"]))
    held = st.sampled_from(["nothing", "hydrogens", "bonds"])
    chains = st.builds(Chain, st.integers(2, 6), st.integers(0, 2), held, st.booleans())
    lines = st.builds(Chain, st.integers(3, 5), st.just(0), st.just("bonds"), st.booleans(), st.just(True))
    stars = st.builds(Star, st.integers(1, 4), st.sampled_from(["none", "bond", "constraint"]), st.booleans())
    stars = stars.filter(lambda star: star.leaves < 4 or star.stem == "none")
    rings = st.builds(Ring, st.integers(3, 6), st.booleans(), st.booleans())
    held_bodies = st.builds(Body, st.sampled_from(HELD_BY_CONSTRAINTS), st.just(False))
    alike = st.builds(Alike, st.sampled_from(HELD_BY_CONSTRAINTS), st.just(False))
    plain = [waters, chains, stars, rings, held_bodies, lines, alike]
    frozen = st.builds(Frozen, st.one_of(*plain, _with_sites(plain)))
    if named:
        shapes = st.sampled_from(list(SHAPES))
        others = st.sampled_from(["none", *SHAPES])
        jointed = st.builds(Jointed, shapes, st.integers(0, 3), others, st.booleans(), st.booleans())
        plain += [st.builds(Body, shapes), jointed, st.builds(Alike, shapes)]
    with_sites = _with_sites(plain)
    tethered = st.builds(Tethered, st.one_of(*plain, with_sites), st.sampled_from([0.0, 0.5]), st.booleans())
    return st.one_of(ions, *plain, with_sites, tethered, frozen)


def _with_sites(kinds: list[st.SearchStrategy[Molecule]]) -> st.SearchStrategy[WithSite]:
    """Draw a molecule of some kinds with virtual sites of any kind."""
    return st.builds(WithSite, st.one_of(kinds), st.sampled_from(list(SITES)), *3 * [st.booleans()]).filter(
        _has_parents
    )


def _has_parents(molecule: WithSite) -> bool:
    """Whether a molecule has as many atoms as the site depends on, not in line where the site needs a plane."""
    places = np.array(molecule.molecule.parts().places)
    count = max(SITES[molecule.site][0], 2 if molecule.angle else 1)
    if len(places) < count:
        return False
    # A site on the line through two atoms makes no angle that can bend smoothly.
    if molecule.angle and molecule.site in ("two", "shifted"):
        return False
    if count < 3:
        return True
    return bool(np.linalg.norm(np.cross(places[1] - places[0], places[2] - places[0])) > 1e-3)


def _few(drawn: list[Molecule]) -> tuple[Molecule, ...]:
    """Return the first molecules, with `PARTICLES` at most."""
    totals = np.cumsum([len(molecule.parts().masses) for molecule in drawn])
    return tuple(drawn[: max(1, int((totals <= PARTICLES).sum()))])


@functools.cache
def mixtures(
    surroundings: tuple[str, ...] = SURROUNDINGS,
    prepared: tuple[str, ...] = PREPARATIONS,
    named: bool = True,
    least: int = 1,
) -> st.SearchStrategy[Mixture]:
    """Draw a Mixture of `least` molecules or more, in which something moves."""
    return st.builds(
        Mixture,
        st.lists(molecules(named), min_size=least, max_size=5).map(_few).filter(_moves),
        st.integers(0, 2**16),
        st.sampled_from(surroundings),
        st.sampled_from(FORMS),
        st.sampled_from([0, 1, 3]),
        st.sampled_from(prepared),
        st.sampled_from([False, False, True]),
    )


@functools.cache
def mixtures_without_vibrations(named: bool = True) -> st.SearchStrategy[Mixture]:
    """Draw a Mixture in vacuum of molecules with constraints and without bonds and angles, beside others."""
    held = st.one_of(
        st.builds(Chain, st.integers(3, 5), st.integers(0, 1), st.just("bonds"), st.just(False)),
        st.builds(Ring, st.integers(4, 6)),
        st.builds(Star, st.integers(2, 3), st.sampled_from(["none", "constraint"]), st.just(False)),
    )
    others = st.one_of(
        held,
        st.builds(Ion, st.sampled_from([1.0, -1.0]), st.booleans()),
        st.just(Water()),
        st.builds(Body, st.sampled_from(list(SHAPES) if named else HELD_BY_CONSTRAINTS), st.just(named)),
        st.builds(WithSite, held, st.sampled_from(["two", "three"])),
    )
    drawn = st.tuples(held, st.lists(others, min_size=1, max_size=2)).map(lambda each: (each[0], *each[1]))
    return st.builds(Mixture, drawn, st.integers(0, 2**16))


@st.composite
def moved(draw: st.DrawFn, ways: st.SearchStrategy[Method]) -> tuple[Mixture, Method]:
    """Draw a method of some, and a mixture that its engine moves: the native one moves no named bodies."""
    method = draw(ways)
    return draw(mixtures(named=method.engine != "native")), method


def _moves(drawn: tuple[Molecule, ...]) -> bool:
    return any(mass > 0 for molecule in drawn for mass in molecule.parts().masses)
