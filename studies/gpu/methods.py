"""Integrators compared on GPUs."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from openmm_sier.dynamics.schemes import SIER4G
from studies.hmc import trials
from studies.methods import (
    HEAVY,
    MIDDLE,
    VERLET,
    Contestant,
    in_bath,
    middle_in_rigid_water,
    more_inner_steps,
    of_scheme,
    own,
    several_steps,
)

#: What ratios are taken over.
REFERENCE = "LangevinMiddle, 4 fs"

#: What averages are compared with, and what is not timed.
SHORT_STEPS = "LangevinMiddle, 1 fs"

#: SIER2 at the longest step that is recommended.
LONG_STEPS = own(9)

#: It has the averages of the other engine.
EXACT_ENGINE = in_bath(engine="exact").at(9, **HEAVY, detail=", exact engine")

STEADY = of_scheme(SIER4G).at(4, prepared=True)


def in_water() -> list[Contestant]:
    """Return the methods that are compared in rigid water alone."""
    middle_steps = [middle_in_rigid_water(step, ", heavy hydrogens") for step in (9, 10)]
    longer = [replace(LONG_STEPS, step=step) for step in (10, 11)]
    return [*middle_steps, *longer, trials.METHODS[trials.USUAL]]


def around_a_solute() -> list[Contestant]:
    """Return the methods that are compared around a solute alone."""
    return [
        MIDDLE.at(5, hydrogens=3.0, friction=1.0),
        several_steps(8, friction=1.0),
        replace(LONG_STEPS, step=8),
        more_inner_steps(9, 3, ", five inner steps"),
        trials.METHODS[trials.SHORT],
    ]


def methods(has_solute: bool) -> list[Contestant]:
    """Return all methods for a box; the bath of LangevinMiddle at 4 fs is that of OpenMM's benchmark."""
    return [
        VERLET.at(2),
        MIDDLE.at(4, friction=1.0),
        MIDDLE.at(1, **HEAVY),
        *(around_a_solute() if has_solute else in_water()),
        LONG_STEPS,
        in_bath(countsHeat=True).at(9, **HEAVY, detail=", heat counted"),
        EXACT_ENGINE,
        STEADY,
    ]


def averaged(has_solute: bool, names: Collection[str]) -> list[Contestant]:
    """Return those of `methods` whose averages are compared, if their names are wanted."""
    contestants = [method for method in methods(has_solute) if method.method.has_bath and method != EXACT_ENGINE]
    return [method for method in contestants if method.name in names]


def at_constant_energies() -> list[Contestant]:
    """Return the methods whose energies are followed: Verlet with as many forces as SIER4G, and at its usual step."""
    return [
        VERLET.at(2),
        VERLET.at(1),
        VERLET.at(1, prepared=True, detail=", prepared"),
        STEADY,
        replace(STEADY, step=3),
    ]
