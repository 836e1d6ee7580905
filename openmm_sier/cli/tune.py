"""The command `openmm-sier tune`: step and trial length of hybrid Monte Carlo for an input."""

import shlex
from typing import Any

from openmm_sier.cli.beginning import Simulated, read_start
from openmm_sier.cli.console import note
from openmm_sier.cli.options import OF_TUNING, OPTIONS
from openmm_sier.cli.plan import Options, new_plan
from openmm_sier.cli.streams import PROGRAM
from openmm_sier.integrators.tuning import Tuning, tune


def execute(acceptance: float, trials: int, samples: int, **given: Any) -> None:
    """Run `openmm-sier tune`.

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
    note(f"{plan.title} on the {context.getPlatform().getName()} platform: tunes step and length of trials")
    # Each of the four lengths has as many steps in all.
    note(f"this takes some {4 * samples + 4 * trials} trials of {plan.step_time:g} ps")
    found = tune(context, acceptance, trials, samples)
    note(str(found))
    note(f"These trials are no samples. A run with this step and length:\n{run_line(options, found)}")


def run_line(options: Options, found: Tuning) -> str:
    """The command line of a run with the step and trial length that were found, and all other options as given."""
    chosen = {"dt": float(f"{1000 * found.stepSize:.4g}"), "steps_per_trial": found.stepsPerTrial}
    given = {name: value for name in OF_TUNING if name != "box" and (value := getattr(options, name)) is not None}
    words = [PROGRAM, "run", str(options.box), "--ensemble", "hmc"]
    for name, value in (given | chosen).items():
        words += OPTIONS[name].words(value)
    return shlex.join(words)
