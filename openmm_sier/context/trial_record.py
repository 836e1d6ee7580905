"""Names of the variables of the CustomIntegrator in which a trial of hybrid Monte Carlo travels in checkpoints."""

from openmm_sier.context.stored_state import STATE_VARIABLES

#: Per-atom variables that hold the start of the trial in progress: the bodies' state as `stored_state.pack` gives it
#: with the exact engine, positions and velocities with the native one.
START_VARIABLES = tuple(f"sier_start{i}" for i in range(len(STATE_VARIABLES)))

#: Global variables of the trial in progress, see `metropolis.Trial`; LEFT is 0 where the exact engine follows none.
LEFT, ENERGY, THERMAL, STEP, START_HEAT = (
    f"sier_trial_{name}" for name in ("left", "energy", "thermal", "step", "heat")
)

#: With the native engine: the step at which the trial in progress ends, 0 where there is none; checksums of the
#: positions and velocities, and of box and parameters, that this package left in the Context.
END, PLACE, ENVIRONMENT = "sier_trial_end", "sier_trial_place", "sier_trial_environment"

#: Those of all trials: how many, how many were accepted, and the energy error of the last one in kT.
TRIALS, ACCEPTED, ERROR = "sier_trials", "sier_accepted", "sier_error"

#: Those of the check of reversibility: the step in ps that it was made at, and the error in nm.
CHECKED_STEP, REVERSAL = "sier_checked_step", "sier_reversal"

GLOBALS = (
    *(LEFT, ENERGY, THERMAL, STEP, START_HEAT),
    *(END, PLACE, ENVIRONMENT),
    *(TRIALS, ACCEPTED, ERROR, CHECKED_STEP, REVERSAL),
)
