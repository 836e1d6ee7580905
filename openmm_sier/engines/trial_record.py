"""Names of the variables of the CustomIntegrator in which a trial of hybrid Monte Carlo travels in checkpoints."""

from openmm_sier.engines.stored_state import STATE_VARIABLES

#: Per-atom variables that hold the start of the trial in progress. With the exact engine it is the bodies' state as
#: `stored_state.pack` gives it, with the native one positions and velocities.
START_VARIABLES = tuple(f"sier_start{i}" for i in range(len(STATE_VARIABLES)))

#: Global variables of the trial in progress, see `metropolis.Trial`; LEFT is 0 if the exact engine has none in
#: progress.
LEFT, ENERGY, THERMAL, STEP, START_HEAT = (
    f"sier_trial_{name}" for name in ("left", "energy", "thermal", "step", "heat")
)

#: For the native engine, the step at which the trial in progress ends, 0 if there is none; and checksums of the
#: positions and velocities, and of box and parameters, that this package left in the Context.
END, PLACE, ENVIRONMENT = "sier_trial_end", "sier_trial_place", "sier_trial_environment"

#: Global variables of all trials, for their number, how many were accepted, and the energy error of the last one in kT.
TRIALS, ACCEPTED, ERROR = "sier_trials", "sier_accepted", "sier_error"

#: Global variables of the reversibility check, for the step in ps at which it was made and the error in nm.
CHECKED_STEP, REVERSAL = "sier_checked_step", "sier_reversal"

GLOBALS = (
    *(LEFT, ENERGY, THERMAL, STEP, START_HEAT),
    *(END, PLACE, ENVIRONMENT),
    *(TRIALS, ACCEPTED, ERROR, CHECKED_STEP, REVERSAL),
)
