"""When a run stops because its temperature runs away, and when its table warns of a long step.

The temperatures of translation, rotation and flexible molecules are held against the bounds of `stability.runaway`
before anything is written, also with OpenMM's integrators. What a bath takes up, or what has not yet become hot, shows
in the fluctuation of the conserved energy H, the total energy less the heat that a heat bath and moves of the volume
have added.
"""

from collections.abc import Mapping

import numpy as np
import openmm

from openmm_sier.analysis.observables import energy_error_within_1_ps
from openmm_sier.analysis.statistics import rms
from openmm_sier.cli.settings import RunSettings
from openmm_sier.dynamics.bodies import NotFiniteError
from openmm_sier.engines.protocol import TrajectoryError
from openmm_sier.observe.conservation import CONSERVED, POTENTIAL
from openmm_sier.stability.runaway import RunawayError, hottest
from openmm_sier.system.temperature import DegreesOfFreedom

#: Exit code of a run that was stopped for this reason.
EXIT_CODE = 3

#: rms(H)/rms(V) above which the final table warns. Recommended steps give SIER2 0.9 to 1.3 % and the schemes of fourth
#: order 0.01 to 0.41 %, by water model; these bounds are two to three times the largest values.
LARGEST_FLUCTUATION = {2: 0.03, 4: 0.01}

#: Fewest rows of a log that tell a fluctuation.
FEWEST_ROWS = 10


class Runaway(RuntimeError):
    """End a run, since a temperature has run away, or positions and forces are no longer finite."""

    exit_code = EXIT_CODE


#: Highest temperatures, K, by the names of `DegreesOfFreedom`.
Bounds = dict[str, float]


def bounds(plan: RunSettings, dof: DegreesOfFreedom) -> Bounds:
    """Return the temperatures that a run with these degrees of freedom does not exceed."""
    return {name: hottest(plan.temperature, number) for name, number in dof._asdict().items() if number}


def check(context: openmm.Context, bounds: Bounds) -> None:
    """Refuse to go on with a Context that is too hot.

    Raises:
        RunawayError: a temperature is above its bound, or no number.
    """
    temperatures = context.getIntegrator().computeTemperatures().in_kelvin()
    for name, bound in bounds.items():
        if not (temperature := getattr(temperatures, name)) <= bound:
            raise RunawayError(f"the temperature of {name} is {temperature:.3g} K, above {bound:.4g} K")


def is_runaway(error: BaseException) -> bool:
    """Tell whether a step failed because it made the System too hot, or forces or positions are not finite."""
    # OpenMM has one class for all its errors.
    broken = isinstance(error, TrajectoryError | RunawayError) or isinstance(error.__context__, NotFiniteError)
    return broken or "coordinate is NaN" in str(error)


def likely_cause(plan: RunSettings) -> str:
    """Return why a run with these settings may have run away, and what to do."""
    usual, name = plan.usual_step, plan.method.name
    if plan.dt > usual:
        return f"the step of {plan.dt:g} fs is too long for {name}, for which {usual:g} fs is usual: --dt {usual:g}"
    return (
        f"the step of {plan.dt:g} fs should be short enough for {name} and rigid water, for which {usual:g} fs is "
        "usual. The cause may be flexible bonds, overlaps at the start (--minimize) or too short an equilibration. If "
        "a shorter step changes nothing, call openmm_sier.check_forces in a script: it tells which Force is not the "
        "gradient of its energy"
    )


def fluctuation_warning(plan: RunSettings, log: Mapping[str, np.ndarray]) -> str | None:
    """Return a warning if the energy fluctuates more than with the scheme's usual step, else None.

    Only constant energy draws one, and only what H does within 1 ps counts, so that a drift does not.

    Args:
        plan: of the run.
        log: its columns, see `openmm_sier.observe.conservation.COLUMNS`.
    """
    t, H, V = (log[name] for name in ("Time (ps)", CONSERVED, POTENTIAL))
    # Where the potential energy hardly changes, the ratio shows only rounding to single precision.
    if plan.ensemble != "nve" or len(t) < FEWEST_ROWS or rms(V) < 1e-6 * (1 + np.abs(V).mean()):
        return None
    bound = LARGEST_FLUCTUATION[2 if plan.method.order == 2 else 4]
    error = energy_error_within_1_ps(t, H, V)
    if error <= bound:
        return None
    return f"{100 * error:.2g} %, more than the {100 * bound:.2g} % of a good step; {likely_cause(plan)}"
