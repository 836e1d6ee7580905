"""Checks of a run, which stops if its temperature runs away.

The temperatures of translation, rotation and flexible molecules are compared with the bounds of `stability.runaway`
before anything is written, also with OpenMM's integrators.
"""

import openmm

from openmm_sier.cli.settings import RunSettings
from openmm_sier.dynamics.bodies import NotFiniteError
from openmm_sier.engines.records import TrajectoryError
from openmm_sier.stability.runaway import RunawayError, hottest
from openmm_sier.system.temperature import DegreesOfFreedom

#: Exit code of a run that ran away.
EXIT_CODE = 3


class Runaway(RuntimeError):
    """The end of a run whose temperature has run away, or whose positions or forces are not finite."""

    exit_code = EXIT_CODE


#: Highest temperatures, K, by the names of `DegreesOfFreedom`.
Bounds = dict[str, float]


def bounds(plan: RunSettings, dof: DegreesOfFreedom) -> Bounds:
    """Return upper bounds of the temperatures of a run with these degrees of freedom."""
    return {name: hottest(plan.temperature, number) for name, number in dof._asdict().items() if number}


def check(context: openmm.Context, bounds: Bounds) -> None:
    """Refuse to continue with a Context that is too hot.

    Raises:
        RunawayError: a temperature is above its bound, or not a number.
    """
    temperatures = context.getIntegrator().computeTemperatures().in_kelvin()
    for name, bound in bounds.items():
        if not (temperature := getattr(temperatures, name)) <= bound:
            raise RunawayError(f"the temperature of {name} is {temperature:.3g} K, above {bound:.4g} K")


def is_runaway(error: BaseException) -> bool:
    """Return whether a step failed because it made the System too hot, or forces or positions are not finite."""
    # OpenMM has one class for all its errors.
    broken = isinstance(error, TrajectoryError | RunawayError) or isinstance(error.__context__, NotFiniteError)
    return broken or "coordinate is NaN" in str(error)


def likely_cause(plan: RunSettings) -> str:
    """Return the likely cause of a runaway with these settings, and a remedy."""
    usual, name = plan.usual_step, plan.method.name
    if plan.dt > usual:
        return f"the step of {plan.dt:g} fs is too long for {name}, for which {usual:g} fs is usual: --dt {usual:g}"
    return (
        f"the step of {plan.dt:g} fs should be short enough for {name} and rigid water, for which {usual:g} fs is "
        "usual. The cause may be flexible bonds, overlaps at the start (--minimize) or too short an equilibration. If "
        "a shorter step changes nothing, call openmm_sier.check_forces in a script: it tells which Force is not the "
        "gradient of its energy"
    )
