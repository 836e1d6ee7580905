"""The command `openmm-sier tune`: the step of hybrid Monte Carlo for an input."""

import shlex
from typing import Any

from openmm_sier.cli.arguments import argument, arguments
from openmm_sier.cli.console import note
from openmm_sier.cli.new_run import NewRun
from openmm_sier.cli.settings import RunSettings, TrialSettings
from openmm_sier.cli.simulated_system import SimulatedSystem
from openmm_sier.cli.streams import PROGRAM
from openmm_sier.integrators.tuning import Tuning, tune


def execute(given: TrialSettings, acceptance: float | None, trials: int) -> None:
    """Run `openmm-sier tune`.

    Args:
        given: settings that the user chose, and defaults.
        acceptance, trials: see `openmm_sier.integrators.tuning.tune`.

    Raises:
        Misused: there are no coordinates, or settings contradict each other.
        Runaway: the equilibration broke down.
        ForceFieldError, RecordError, RigidityError, OSError, openmm.OpenMMException: as their messages say.
    """
    beginning = NewRun(RunSettings.model_construct(**given.chosen, ensemble=given.ensemble))
    settings = beginning.settings
    context = beginning.context(SimulatedSystem(settings, beginning.sources))
    note(f"{settings.title} on the {context.getPlatform().getName()} platform: tunes the step of trials")
    # A step is found by some four attempts.
    note(f"this takes some {4 * trials} trials of {settings.step_time:g} ps")
    tuning = tune(context, acceptance, trials)
    note(str(tuning))
    note(f"Do not take averages over these trials. To run with the result:\n{run_line(given.chosen, tuning)}")


def run_line(chosen: dict[str, Any], tuning: Tuning) -> str:
    """Return the command line of a run with the result of tuning, and otherwise the same settings."""
    tuned = {"dt": float(f"{1000 * tuning.schemeStepSize:.4g}"), "steps_per_trial": tuning.stepsPerTrial}
    line = [PROGRAM, "run", argument(chosen["box"]), "--ensemble", "hmc"]
    for name, value in {**chosen, **tuned}.items():
        line += [] if name == "box" else arguments(name, value)
    return shlex.join(line)
