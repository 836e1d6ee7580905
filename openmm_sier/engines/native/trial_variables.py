"""The numbers that host and device exchange about a trial of hybrid Monte Carlo, in global variables."""

from typing import NamedTuple

import numpy as np
import openmm

from openmm_sier.engines.native.statements import THERMAL
from openmm_sier.engines.program import TRIAL_VECTORS
from openmm_sier.engines.trials import Trial
from openmm_sier.engines.variables import PREFIX, per_atom_values

#: Global variables that the host sets beside `THERMAL`: steps to an end, extra chances, the share of momenta that is
#: kept, the kinetic energy of the start, the largest error that is accepted, and the velocity that the centre of mass
#: is given. A kinetic energy of zero leaves momenta as they are, and does not stop the centre of mass.
STEPS, CHANCES, SHARE, WANTED, THRESHOLD = (
    PREFIX + name for name in ("steps", "chances", "share", "wanted", "threshold")
)
CENTRE = tuple(f"{PREFIX}centre_{axis}" for axis in "xyz")

#: Global variables that the program sets: potential and kinetic energy of the start, kinetic energy of the present
#: state, energy error in kT of the present and of the first end, number of ends, whether the last one is accepted,
#: whether the trajectory goes on, steps left to the end, and the kinetic energy that was taken from the centre of mass.
START, START_KINETIC, KINETIC, END_ERROR, FIRST_ERROR, ENDS, TAKEN, GOES_ON, LEFT, STOPPED = (
    PREFIX + name
    for name in (
        "start",
        "start_kinetic",
        "kinetic",
        "end_error",
        "first_error",
        "ends",
        "taken",
        "goes_on",
        "left",
        "stopped",
    )
)

#: All of them.
GLOBALS = (
    *(STEPS, CHANCES, SHARE, WANTED, THRESHOLD, *CENTRE),
    *(START, START_KINETIC, KINETIC, END_ERROR, FIRST_ERROR, ENDS, TAKEN, GOES_ON, LEFT, STOPPED),
)

#: An error above this counts as infinite, kT.
INFINITE = 1e20


class Numbers(NamedTuple):
    """Numbers that a program leaves after a trial; see the global variables above."""

    start: float
    first_error: float
    is_accepted: bool
    ends: int
    kinetic: float
    stopped: float


def variables(trial: Trial) -> dict[str, float]:
    """Return the global variables that describe a trial, by name."""
    values = (trial.steps, trial.chances, trial.kept, trial.kT, trial.kinetic_energy, trial.threshold, *trial.centre)
    return dict(zip((STEPS, CHANCES, SHARE, THERMAL, WANTED, THRESHOLD, *CENTRE), values, strict=True))


def execute(integrator: openmm.CustomIntegrator, trial: Trial) -> Numbers:
    """Let OpenMM make a trial."""
    for name, value in variables(trial).items():
        integrator.setGlobalVariableByName(name, value)
    openmm.CustomIntegrator.step(integrator, 1)
    start, error, taken, ends, kinetic, stopped = map(
        integrator.getGlobalVariableByName, (START, FIRST_ERROR, TAKEN, ENDS, KINETIC, STOPPED)
    )
    return Numbers(start, error, taken > 0, int(ends), kinetic, stopped)


def followed(steps: int) -> Trial:
    """Return the trial that follows a trajectory from the present momenta, and accepts its end if it is finite."""
    return Trial(steps, 0, kept=1.0, kT=1.0, kinetic_energy=0.0, threshold=INFINITE, centre=np.zeros(3))


def start_of(context: openmm.Context) -> tuple[np.ndarray, np.ndarray]:
    """Return positions, nm, and velocities, nm/ps, at the start of the last trial, (N, 3) each; massless ones are 0."""
    positions, velocities = per_atom_values(context, *TRIAL_VECTORS)
    return positions, velocities
