"""The command `openmm-sier tune`: the step of hybrid Monte Carlo for an input."""

import shlex
from collections.abc import Mapping
from typing import Any

from openmm_sier.cli.arguments import argument, arguments
from openmm_sier.cli.console import note
from openmm_sier.cli.errors import Misused
from openmm_sier.cli.new_run import NewRun
from openmm_sier.cli.simulated_system import SimulatedSystem
from openmm_sier.cli.streams import PROGRAM
from openmm_sier.integrators.tuning import Tuning, tune


def execute(options: Mapping[str, Any], acceptance: float | None, trials: int) -> None:
    """Run `openmm-sier tune`.

    Args:
        options: of the user by name, see `RunSettings`.
        acceptance, trials: see `openmm_sier.integrators.tuning.tune`.

    Raises:
        Misused: there are no coordinates.
        RunError: settings contradict each other.
        Runaway: the equilibration broke down.
        ForceFieldError, RecordError, RigidityError, OSError, openmm.OpenMMException: as their messages say.
    """
    if "box" not in options:
        raise Misused("tune needs BOX, a file of coordinates (see openmm-sier tune --help)")
    beginning = NewRun({**options, "ensemble": "hmc"})
    settings = beginning.settings
    context = beginning.context(SimulatedSystem(settings, beginning.sources))
    note(f"{settings.title} on the {context.getPlatform().getName()} platform: tunes the step of trials")
    # A step is found by some four attempts.
    note(f"this takes some {4 * trials} trials of {settings.step_time:g} ps")
    tuning = tune(context, acceptance, trials)
    note(str(tuning))
    note(f"Do not take averages over these trials. To run with the result:\n{run_line(options, tuning)}")


def run_line(options: Mapping[str, Any], tuning: Tuning) -> str:
    """Return the command line of a run with the result of tuning, and otherwise the same options."""
    tuned = {"dt": float(f"{1000 * tuning.schemeStepSize:.4g}"), "steps_per_trial": tuning.stepsPerTrial}
    line = [PROGRAM, "run", argument(options["box"]), "--ensemble", "hmc"]
    for name, value in {**options, **tuned}.items():
        line += [] if name == "box" else arguments(name, value)
    return shlex.join(line)
