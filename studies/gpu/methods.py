"""Choose the integrators that are compared on GPUs."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from functools import partial

from openmm_sier.dynamics.schemes import SIER4G
from studies.contestants import (
    MIDDLE_IN_RIGID_WATER,
    SEVERAL_STEPS,
    Contestant,
    at_constant_energy,
    in_bath,
    middle,
    verlet,
)
from studies.hmc import trials

#: What ratios are taken over.
REFERENCE = "LangevinMiddle, 4 fs"

#: What averages are compared with, and what is not timed.
SHORT_STEPS = "LangevinMiddle, 1 fs"

#: SIER2 at the longest step that is recommended.
LONG_STEPS = Contestant("SIER2", 9, in_bath, hydrogens=4.0, prepared=True)

#: It has the averages of the other engine.
EXACT_ENGINE = replace(LONG_STEPS, make=partial(in_bath, engine="exact"), detail="exact engine")

STEADY = Contestant(
    "SIER4G",
    4,
    partial(at_constant_energy, scheme=SIER4G),
    SIER4G.force_evaluations,
    prepared=True,
    has_bath=False,
)


def in_water() -> list[Contestant]:
    """Return the methods that are compared in rigid water alone."""
    middle_steps = [replace(MIDDLE_IN_RIGID_WATER, step=step, detail="heavy hydrogens") for step in (9, 10)]
    longer = [replace(LONG_STEPS, step=step) for step in (10, 11)]
    return [*middle_steps, *longer, trials.METHODS[trials.USUAL]]


def around_a_solute() -> list[Contestant]:
    """Return the methods that are compared around a solute alone."""
    return [
        Contestant("LangevinMiddle", 5, middle, hydrogens=3.0, friction=1.0),
        replace(SEVERAL_STEPS, friction=1.0),
        replace(LONG_STEPS, step=8),
        replace(LONG_STEPS, make=partial(in_bath, substeps=3), detail="five inner steps"),
        trials.METHODS[trials.SHORT],
    ]


def methods(has_solute: bool) -> list[Contestant]:
    """Return all methods for a box; the bath of LangevinMiddle at 4 fs is that of OpenMM's benchmark."""
    return [
        Contestant("Verlet", 2, verlet, has_bath=False),
        Contestant("LangevinMiddle", 4, middle, friction=1.0),
        Contestant("LangevinMiddle", 1, middle, hydrogens=4.0, prepared=True),
        *(around_a_solute() if has_solute else in_water()),
        LONG_STEPS,
        replace(LONG_STEPS, make=partial(in_bath, countsHeat=True), detail="heat counted"),
        EXACT_ENGINE,
        STEADY,
    ]


def averaged(has_solute: bool, wanted: Collection[str]) -> list[Contestant]:
    """Return those of `methods` whose averages are compared, if their names are wanted."""
    found = [method for method in methods(has_solute) if method.has_bath and method != EXACT_ENGINE]
    return [method for method in found if method.name in wanted]


def at_constant_energies() -> list[Contestant]:
    """Return the methods whose energies are followed: Verlet with as many forces as SIER4G, and at its usual step."""
    return [
        Contestant("Verlet", 2, verlet, has_bath=False),
        Contestant("Verlet", 1, verlet, has_bath=False),
        Contestant("Verlet", 1, verlet, has_bath=False, prepared=True, detail="prepared"),
        STEADY,
        replace(STEADY, step=3),
    ]
