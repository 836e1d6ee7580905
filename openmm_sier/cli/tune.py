"""The command `openmm-sier tune`: scheme, step and trial length of hybrid Monte Carlo for an input."""

import shlex
from collections.abc import Mapping
from typing import Any

from openmm_sier.cli.arguments import argument, arguments
from openmm_sier.cli.console import note
from openmm_sier.cli.errors import Misused
from openmm_sier.cli.new_run import NewRun
from openmm_sier.cli.simulated_system import SimulatedSystem
from openmm_sier.cli.streams import PROGRAM
from openmm_sier.integrators.tuning import SCHEMES, tune
from openmm_sier.integrators.tuning_results import Tuning


def execute(options: Mapping[str, Any], acceptance: float | None, trials: int, samples: int) -> None:
    """Run `openmm-sier tune`. Only the scheme that the user chose, if any, is tried.

    Args:
        options: of the user by name, see `RunSettings`.
        acceptance, trials, samples: see `openmm_sier.integrators.tuning.tune`.

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
    schemes = [options["scheme"]] if "scheme" in options else None
    count = len(schemes or SCHEMES)
    note(f"{settings.title} on the {context.getPlatform().getName()} platform: tunes scheme, step and length of trials")
    # Each of the four lengths has the same number of steps; a step is found by some four attempts.
    note(f"this takes some {4 * samples + 4 * trials * count} trials of {settings.step_time:g} ps")
    # A run has the usual substeps.
    tuning = tune(context, acceptance, trials, samples, schemes=schemes, substeps=[])
    # The run below sets the scheme, whether this Context has it or not.
    note(str(tuning._replace(isSet=True)))
    note(f"Do not take averages over these trials. To run with the result:\n{run_line(options, tuning)}")


def run_line(options: Mapping[str, Any], tuning: Tuning) -> str:
    """Return the command line of a run with the result of tuning, and otherwise the same options."""
    tuned = {
        "scheme": tuning.scheme.name.lower(),
        "dt": float(f"{1000 * tuning.schemeStepSize:.4g}"),
        "steps_per_trial": tuning.stepsPerTrial,
    }
    line = [PROGRAM, "run", argument(options["box"]), "--ensemble", "hmc"]
    for name, value in {**options, **tuned}.items():
        line += [] if name == "box" else arguments(name, value)
    return shlex.join(line)
