"""Averages: where they are known exactly, every sampler has them, at any step.

So do Langevin dynamics, velocity rescaling and hybrid Monte Carlo, at constant volume and pressure, on both engines.
Copies of molecules do not interact, so that there is no chaos, and start in the exact distribution.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import openmm
import pytest
from hypothesis import reject
from hypothesis import strategies as st

from openmm_sier.dynamics.schemes import CATALOGUE
from tests.laws.exact_bodies import Dipoles, Free, Joined, Suspended
from tests.laws.exact_models import Chains, FastBonds, Quartics, Wells
from tests.laws.exact_motions import MOTIONS, Driven, Held
from tests.laws.law import MANY, Law
from tests.laws.linear_maps import in_bath, is_stable
from tests.laws.samplers import Bath, Rescaling, Sampler, Trials
from tests.laws.sampling import BRIEF, LONG, Length, Series


@dataclass(frozen=True)
class Experiment:
    """A sampler of a mixture.

    Attributes:
        method: of sampling.
        kinds: of molecules.
        copies: of each.
        seed: of the start and the integrator.
        platform: name of the platform.
        length: of the series.
    """

    method: Sampler
    kinds: tuple
    copies: int = 30
    seed: int = 1
    platform: str = "Reference"
    length: Length = LONG

    def check(self) -> None:
        """Raise an AssertionError that names the averages that are wrong."""
        with warnings.catch_warnings():
            # Steps are as long as they can be.
            warnings.simplefilter("ignore")
            distances = self._started().distances()
        wrong = {name: distance for name, distance in distances.items() if abs(distance) > self.length.bound}
        assert not wrong, f"standard errors from the exact averages: {wrong}"

    def _started(self) -> Series:
        """Return the series at its start, unless a chain is drawn there whose bonds in line OpenMM cannot hold."""
        try:
            return Series(self.method, self.kinds, self.copies, self.seed, self.platform, self.length)
        except openmm.OpenMMException as error:
            if "OpenMM cannot satisfy the constraints" in str(error):
                reject()
            raise


# --- strategies: the first value is the simplest ----------------------------------------------------------------------


def chosen(*values):
    return st.sampled_from(values)


shapes = chosen("triangle", "pair", "corner")

#: Hydrogens in the middle of a chain, which turns through itself, are beyond OpenMM's solver at these steps.
CHAINS = chosen((2.0, 1.0, 3.0), (1.0, 1.0, 1.0), (2.0, 30.0, 5.0), (1.0, 3.0, 2.0, 1.0))


@st.composite
def free_kinds(draw, engine: str, pace: float, named: bool):
    """A molecule without a place of its own, whose constraints and bodies an engine can move at a pace."""
    solved = min(pace, 0.06)
    kind = draw(chosen(Free, Dipoles, Chains, Joined) if named else chosen(Free, Dipoles, Chains))
    if kind is Chains:
        return Chains(draw(CHAINS), solved if engine == "native" else min(pace, 0.15))
    pace = min(pace, 0.15) if engine == "native" else pace
    if kind is Joined:
        return Joined(draw(shapes), pace, draw(chosen(2.0, 5.0)))
    by_name = named and draw(st.booleans())
    shape = draw(shapes)
    if kind is Free:
        return Free(shape, by_name, pace)
    site = shape != "corner" and draw(st.booleans())
    return Dipoles(shape, draw(chosen(1.0, 3.0, 8.0)), by_name, site, pace)


@st.composite
def types(draw, oscillation: float, pace: float):
    """Bodies of a type that move along some axes only."""
    return Held(draw(shapes), draw(chosen(*MOTIONS)), draw(chosen(2.0, 5.0)), pace, oscillation)


def driven(pace: float):
    """Draw bodies that forces drive, which no energy describes."""
    return st.builds(Driven, shapes, st.just(pace))


@st.composite
def held_kinds(draw, oscillation: float, pace: float, anchors: bool, named: bool):
    """A molecule in a well."""
    kind = draw(chosen(Wells, Quartics, Suspended) if named else chosen(Wells, Quartics))
    if kind is Suspended:
        return Suspended(draw(chosen(1.0, 4.0)), pace)
    mass = draw(chosen(12.0, 1.0, 40.0))
    if kind is Quartics:
        return Quartics(mass, min(pace, 0.15))
    return Wells(mass, oscillation, anchors and draw(st.booleans()))


#: Volumes change slowly, so that runs in which they do are several times as long.
pressures = chosen("", "", "", "", "moves", "barostat")
own_pressures = chosen("", "", "", "", "moves")


def copies(pressure: str, *others: int):
    """Draw numbers of copies: few, which show the number in the moments of the volume.

    OpenMM's barostat tries changes by 30 % of an earlier volume, which is larger than that of now where that of ten
    molecules has fallen to a third.
    """
    return {"": chosen(*others), "moves": chosen(3, 8), "barostat": chosen(30)}[pressure]


@st.composite
def baths(draw):
    engine = draw(chosen("exact", "native"))
    scheme = draw(chosen(*CATALOGUE))
    friction = draw(chosen(0.3, 0.1, 1.0))
    turning = draw(chosen(None, 0.1, 0.5)) if engine == "exact" else None
    pressure = draw(pressures)
    named = engine == "exact" and pressure != "barostat"
    has_types = named and not pressure and draw(st.booleans())
    named &= not has_types
    bathed = CATALOGUE[scheme].with_bath()
    paces = [part * CATALOGUE[scheme].stability_limit for part in (0.2, 0.5, 0.8)]
    # At 1.9 the relaxation of the ratio of kinetic and potential energy is slow, and averages are off by large factors.
    sound = [pace for pace in paces if is_stable(bathed.without_bath(), pace) and 0.3 < in_bath(bathed, pace).q2 < 3]
    oscillation, pace = draw(chosen(*sound)), draw(chosen(0.15, 0.1))
    kinds = [draw(free_kinds(engine, pace, named))] if pressure else []
    kinds += [draw(st.one_of(types(oscillation, pace), driven(pace)))] if has_types else []
    others = st.one_of(
        held_kinds(oscillation, pace, not pressure, named),
        free_kinds(engine, pace, named),
        *([st.builds(FastBonds, chosen((12.0, 1.0), (1.0, 1.0)), chosen(0.5, 1.2))] if scheme == "sier2" else []),
    )
    if pressure == "barostat":
        # It brings wells, as all molecules, into the box.
        others = free_kinds(engine, pace, named)
    kinds += draw(st.lists(others, min_size=0 if pressure else 1, max_size=2, unique_by=type))
    substeps = draw(chosen(None, 1, 3)) if has_bonds(kinds) else None
    method = Bath(scheme, engine, friction, turning, draw(steps), draw(temperatures), pressure, substeps)
    return Experiment(method, tuple(kinds), draw(copies(pressure, 30, 60)), draw(seeds))


@st.composite
def trials(draw):
    engine, scheme = draw(chosen("exact", "native")), draw(chosen("sier2v2", *CATALOGUE))
    number, phase = draw(chosen(3, 1, 2, 5)), draw(chosen(0.8, 1.3, 2.0))
    share, chances = draw(chosen(0.0, 0.5, 0.9)), draw(chosen(0, 1, 2))
    pressure = draw(own_pressures)
    has_types = engine == "exact" and not pressure and draw(st.booleans())
    named = engine == "exact" and not has_types
    oscillation = min(phase / number, 0.6 * CATALOGUE[scheme].stability_limit)
    pace = min(phase / number, 0.4)
    kinds = [draw(free_kinds(engine, pace, named))] if pressure else []
    kinds += [draw(types(oscillation, pace))] if has_types else []
    others = st.one_of(
        held_kinds(oscillation, pace, not pressure, named),
        free_kinds(engine, pace, named),
        st.builds(FastBonds, chosen((12.0, 1.0), (1.0, 1.0)), st.just(oscillation)),
    )
    kinds += draw(st.lists(others, min_size=0 if pressure else 1, max_size=2, unique_by=type))
    substeps = draw(chosen(None, 1, 3)) if has_bonds(kinds) else None
    # The motion of the centre of mass is a part of that of few molecules alone.
    at = draw(steps), draw(temperatures), pressure, substeps, draw(st.booleans())
    method = Trials(scheme, engine, number, share, chances, *at)
    return Experiment(method, tuple(kinds), draw(copies(pressure, 8, 30)), draw(seeds))


@st.composite
def rescalings(draw):
    engine, scheme = draw(chosen("exact", "native")), draw(chosen(*CATALOGUE))
    pressure = draw(pressures)
    named = engine == "exact" and pressure != "barostat"
    free = Free(draw(shapes), named and draw(st.booleans()), 0.1)
    # Half a period is near 3 or 10 such steps of no scheme: potential energies would stay as they are.
    oscillation = 0.26 * CATALOGUE[scheme].stability_limit
    held = draw(types(oscillation, 0.1)) if engine == "exact" else free
    kinds = (free,) if pressure else (draw(chosen(Wells(12.0, oscillation), free, held)),)
    rate, every = draw(chosen(0.1, 0.03)), draw(chosen(3, 1, 10))
    method = Rescaling(scheme, engine, rate, every, draw(steps), draw(temperatures), pressure)
    return Experiment(method, kinds, draw(copies(pressure, 3, 8)), draw(seeds))


def has_bonds(kinds) -> bool:
    return any(isinstance(kind, FastBonds) for kind in kinds)


steps, temperatures, seeds = chosen(0.004, 0.0005, 0.02), chosen(300.0, 30.0, 1000.0), st.integers(1, 2**30)


def cases(platform: str) -> st.SearchStrategy[Experiment]:
    """Draw an experiment on a platform."""
    return st.one_of(baths(), trials(), rescalings()).map(lambda drawn: replace(drawn, platform=platform, length=BRIEF))


# --- the law ----------------------------------------------------------------------------------------------------------

#: One of each way to move a molecule and to draw random numbers.
EXAMPLES = [
    Experiment(Bath(friction=1.0, turning=0.5), (Free("corner", named=True),), 60),
    Experiment(Bath(friction=1.0), (Held("corner", "in plane"),), 60),
    Experiment(Bath(friction=0.5, turning=0.3), (Driven(),), 20),
    Experiment(Bath(friction=1.0, substeps=1), (Wells(pace=1.6), FastBonds(pace=1.2)), 60),
    Experiment(Bath("sier4g"), (Suspended(), Wells(pace=1.0, anchored=True)), 20),
    Experiment(Bath(engine="native", friction=1.0), (Wells(pace=1.6), Free("pair", pace=0.1), FastBonds(pace=1.2)), 60),
    Experiment(Bath(pressure="moves"), (Free("pair", named=True), Wells(pace=0.5)), 5),
    Experiment(Trials("sier2", steps=2), (Wells(pace=0.9), Dipoles("triangle", site=True, pace=0.4)), 12),
    Experiment(Trials("sier2", steps=3, share=0.9), (Wells(pace=0.7),), 30),
    Experiment(Trials("sier2", steps=2), (Held("pair", "rotating"),), 12),
    Experiment(Trials("sier2", chances=1, share=0.5), (Chains(pace=0.1), Wells(pace=0.7)), 10),
    Experiment(Trials("sier2", "native", 2, share=0.9, chances=1), (Wells(pace=0.9), Chains(pace=0.06)), 15),
    Experiment(Trials("sier2", steps=1, chances=2, share=0.5), (Wells(pace=1.6),), 8),
    Experiment(Rescaling(rate=0.5, every=2), (Wells(pace=0.8),), 1),
    Experiment(Rescaling(rate=1.0, every=2), (Free("pair", named=True, pace=0.1),), 3),
    Experiment(Rescaling(engine="native", rate=1.0, every=2), (Free(pace=0.1),), 4),
    Experiment(Trials("sier2", steps=2, share=0.5, remover=True), (Wells(pace=0.9),), 2),
    Experiment(Trials("sier2", "native", steps=2, share=0.5, remover=True), (Wells(pace=0.9),), 2),
    Experiment(Rescaling(rate=0.5, every=2), (Held("pair", "hinged"),), 2),
]

#: Slower ones.
MORE = [
    Experiment(Trials("sier2", steps=2, share=0.9), (Joined(pace=0.3), Wells(pace=0.7)), 8),
    Experiment(Bath(), (Dipoles(site=True), Quartics())),
    Experiment(Bath("sier4g", friction=1.0), (Held("pair", "hinged"),), 30),
    Experiment(Trials("sier2", steps=2), (Held("corner", "free on a line"), Wells(pace=0.9)), 12),
    Experiment(Trials("sier2", steps=2), (Held("triangle", "translating"), Held("pair", "in plane")), 12),
    Experiment(Bath("sier4", "native"), (Wells(pace=1.0), Dipoles("pair", site=True, pace=0.1)), 8),
    Experiment(Bath(engine="native", pressure="barostat"), (Free(pace=0.1),), 10),
    Experiment(Trials("sier2", "native", 1, pressure="moves"), (Free("pair", pace=0.1), Wells(pace=0.8)), 5),
    Experiment(Rescaling(engine="native", pressure="moves"), (Free(pace=0.1),), 3),
]


LAW = Law("averages", cases, few=len(EXAMPLES))


@pytest.mark.parametrize("number", range(len(EXAMPLES)))
def test_averages_are_exact(number):
    EXAMPLES[number].check()


@pytest.mark.thorough
@pytest.mark.parametrize("number", range(len(MORE)))
def test_more_averages_are_exact(number):
    MORE[number].check()


@pytest.mark.thorough
@pytest.mark.hundreds
def test_averages_of_any_mixture_are_exact():
    LAW.hold(MANY)
