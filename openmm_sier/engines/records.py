"""Records of engines: clock, what can be brought back, and kinds of change."""

from enum import Flag, auto
from typing import Any, NamedTuple

import openmm

from openmm_sier.dynamics.tally import Mark


class TrajectoryError(openmm.OpenMMException):
    """A trajectory cannot be followed: a force or position is not finite, or constraints cannot be satisfied."""


def says_nan(error: BaseException) -> bool:
    """Return whether OpenMM says that a number is NaN."""
    return isinstance(error, openmm.OpenMMException) and "nan" in str(error).lower()


class Clock(NamedTuple):
    """Time in ps, and number of steps of the integrator."""

    time: float
    steps: int


class RollbackState(NamedTuple):
    """The state that `Engine.restore` brings back.

    Attributes:
        point: phase point, in the form of the engine.
        clock: time and number of steps.
        box: periodic box vectors, nm.
        mark: of the tally.
        counts: of the ensemble, by name, which `Engine.transaction` brings back.
        more: further data of the engine.
    """

    point: Any
    clock: Clock
    box: Any
    mark: Mark
    counts: dict[str, float]
    more: Any = None


class Changes(Flag):
    """Kinds of change since the last step.

    Attributes:
        ATOMS: positions or velocities were set.
        BOX: the box was set.
        FORCES: the potential was changed.
        FAST: forces that act within drifts were changed, or which ones do.
        BONDS: harmonic bonds or angles were changed, of which bonds keep molecules together.
        VARIABLES: a checkpoint or State has brought the variables of the integrator.
        HISTORY: the next step must depend only on the contents of the Context, as after a restart.
        SETTINGS: settings, parameters or the clock were changed, or a step failed.
    """

    NONE = 0
    ATOMS = auto()
    BOX = auto()
    FORCES = auto()
    FAST = auto()
    BONDS = auto()
    VARIABLES = auto()
    HISTORY = auto()
    SETTINGS = auto()
