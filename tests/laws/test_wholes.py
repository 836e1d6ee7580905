"""Whole molecules: `make_whole` brings together what was cut atom by atom, by box vectors, and moves nothing else."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from hypothesis import reject
from hypothesis import strategies as st

from openmm_sier import make_whole
from tests.laws.law import Law
from tests.laws.mechanics import masses_of
from tests.laws.mixture_strategies import mixtures
from tests.laws.mixtures import SURROUNDINGS, Mixture, box_of
from tests.laws.molecules import Tethered
from tests.laws.readings import molecules_of
from tests.support.waters import plain_context

#: nm: rounding of positions in a few boxes.
ROUNDING = 1e-12


@dataclass(frozen=True)
class Whole:
    """A mixture whose atoms are moved by box vectors, each by others.

    Attributes:
        seed: of the box vectors.
    """

    mixture: Mixture
    seed: int
    platform: str = "Reference"

    def check(self) -> None:
        built = self.mixture.build()
        box, positions = box_of(built.system), built.positions
        images = np.random.default_rng(self.seed).integers(-1, 2, positions.shape)
        bodies = built.named or None
        assert np.array_equal(make_whole(built.system, positions, bodies=bodies), positions)
        try:
            found = make_whole(built.system, positions + images @ box, bodies=bodies)
        except ValueError as error:
            if "half the box" not in str(error):
                raise
            # Nothing says how the atoms of such a body belong together.
            reject()
        moved = (found - positions) @ np.linalg.inv(box)
        assert np.abs(moved - np.round(moved)).max() < ROUNDING, "atoms are moved by other than box vectors"
        masses, context = masses_of(built.system), plain_context(built.system, positions)
        for atoms in molecules_of(context, built.named):
            if not masses[atoms].any():
                # Between frozen atoms OpenMM has no constraints.
                continue
            apart = np.abs(moved[atoms] - moved[atoms[0]]).max()
            assert apart < ROUNDING, f"atoms {atoms} are {apart} boxes apart"


# --- the law ----------------------------------------------------------------------------------------------------------


@st.composite
def cases(draw: st.DrawFn, platform: str) -> Whole:
    """Draw a mixture with a box, of which bonds know nothing."""
    mixture = draw(mixtures(SURROUNDINGS[1:]).filter(is_bonded))
    return Whole(replace(mixture, crossing=False), draw(st.integers(0, 999)), platform)


def is_bonded(mixture: Mixture) -> bool:
    """Return whether molecules in a box have bonds that are known, and are no restraints, which move no molecule."""
    are_restrained = any(isinstance(molecule, Tethered) for molecule in mixture.molecules)
    return mixture.form not in ("custom", "none") and not are_restrained


WHOLES = Law("wholes", cases, few=8)


@WHOLES.numbers()
def test_what_was_cut_becomes_whole(examples):
    WHOLES.hold(examples)
