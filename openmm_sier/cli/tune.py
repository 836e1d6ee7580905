"""The command `openmm-sier tune`: scheme, step and trial length of hybrid Monte Carlo for an input."""

import shlex
from typing import Any

from openmm_sier.cli.beginning import Simulated, read_start
from openmm_sier.cli.console import note
from openmm_sier.cli.options import OF_TUNING, OPTIONS
from openmm_sier.cli.plan import Options, new_plan
from openmm_sier.cli.streams import PROGRAM
from openmm_sier.integrators.tuning import SCHEMES, tune
from openmm_sier.integrators.tuning_results import Tuning


def execute(acceptance: float | None, trials: int, samples: int, **given: Any) -> None:
    """Run `openmm-sier tune`. Only the scheme that was given, if any, is tried.

    Args:
        acceptance, trials, samples: see `openmm_sier.integrators.tuning.tune`.
        given: options of a run by name, as for `Options`.

    Raises:
        RunError: options contradict each other.
        Runaway: the equilibration broke down.
        ForceFieldError, RecordError, RigidityError, OSError, openmm.OpenMMException: as their messages say.
    """
    options = Options(ensemble="hmc", **given)
    state, origin = read_start(options.start)
    plan = new_plan(options, origin)
    context = Simulated(options, plan).begin(state, origin)
    schemes = None if options.scheme is None else [options.scheme]
    several = len(SCHEMES) if schemes is None else 1
    note(f"{plan.title} on the {context.getPlatform().getName()} platform: tunes scheme, step and length of trials")
    # Each of the four lengths has as many steps in all; a step is found by some four attempts.
    note(f"this takes some {4 * samples + 4 * trials * several} trials of {plan.step_time:g} ps")
    found = tune(context, acceptance, trials, samples, schemes=schemes)
    # The run below has the scheme, whatever this Context has.
    note(str(found._replace(isSet=True)))
    note(f"These trials are no samples. A run with what was found:\n{run_line(options, found)}")


def run_line(options: Options, found: Tuning) -> str:
    """Return the command line of a run with what was found, and all other options as given."""
    chosen = {
        "scheme": found.scheme.name.lower(),
        "dt": float(f"{1000 * found.stepSize:.4g}"),
        "steps_per_trial": found.stepsPerTrial,
    }
    given = {name: value for name in OF_TUNING if name != "box" and (value := getattr(options, name)) is not None}
    words = [PROGRAM, "run", str(options.box), "--ensemble", "hmc"]
    for name, value in (given | chosen).items():
        words += OPTIONS[name].words(value)
    return shlex.join(words)
