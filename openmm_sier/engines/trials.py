"""A trial of hybrid Monte Carlo: its choices, its result, and the list of operations by which every engine makes it."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from openmm_sier.dynamics.plan import Operation
from openmm_sier.engines.variables import PREFIX

#: Global variables in which an ensemble counts trials, with the error of the first end of the last one in kT.
TRIALS, ACCEPTED, ERROR = (PREFIX + name for name in ("trials", "accepted", "error"))


class Trial(NamedTuple):
    """Choices of one trial.

    Attributes:
        steps: number of steps of the scheme to each end of the trajectory.
        chances: how many times the trajectory may go on where its end is rejected.
        kept: fraction of the old momenta that is kept where they are refreshed in part.
        kT: thermal energy, kJ/mol.
        kinetic_energy: at the start, after momenta were drawn, kJ/mol. It is 0 where nothing moves.
        threshold: the largest energy error in kT at which an end is accepted.
        centre: velocity that is given to the centre of mass before momenta are drawn, (3,), nm/ps.
    """

    steps: int
    chances: int
    kept: float
    kT: float
    kinetic_energy: float
    threshold: float
    centre: np.ndarray


class Outcome(NamedTuple):
    """Result of one trial.

    Attributes:
        energy: potential energy of the start, kJ/mol.
        error: total energy at the first end less that at the start, in kT; infinite where it could not be reached.
        is_accepted: whether an end was accepted.
    """

    energy: float
    error: float
    is_accepted: bool


class Draw(Operation):
    """Momenta are drawn, in part or all of them, and scaled to the kinetic energy of the start."""


class Keep(Operation):
    """The start is kept, with its total energy."""


class Follow(Operation):
    """The trajectory is followed to its next end, whose energy comes with its last forces."""


class Decide(Operation):
    """The end is accepted or not. The trajectory goes on if it is not, and chances are left."""


@dataclass(frozen=True)
class WhileItGoesOn(Operation):
    """Operations that are repeated while the trajectory goes on, at least once."""

    operations: tuple[Operation, ...]


class GoBack(Operation):
    """The start comes back with reversed momenta, unless an end was accepted."""


class StopCentre(Operation):
    """The centre of mass is stopped, where a CMMotionRemover does so."""


#: A trial.
TRIAL = (Draw(), Keep(), WhileItGoesOn((Follow(), Decide())), GoBack(), StopCentre())
