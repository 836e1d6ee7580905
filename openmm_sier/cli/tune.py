"""The command `openmm-sier tune`: scheme, step and trial length of hybrid Monte Carlo for an input."""

import shlex
from collections.abc import Mapping
from typing import Any

from openmm_sier.analysis.many_runs import argument, arguments
from openmm_sier.cli.beginning import Simulated
from openmm_sier.cli.console import note
from openmm_sier.cli.errors import Misused
from openmm_sier.cli.planning import new_settings
from openmm_sier.cli.starting import begin, read_origin
from openmm_sier.cli.streams import PROGRAM
from openmm_sier.integrators.tuning import SCHEMES, tune
from openmm_sier.integrators.tuning_results import Tuning


def execute(given: Mapping[str, Any], acceptance: float | None, trials: int, samples: int) -> None:
    """Run `openmm-sier tune`. Only the scheme that was given, if any, is tried.

    Args:
        given: settings of a run by name, see `RunSettings`.
        acceptance, trials, samples: see `openmm_sier.integrators.tuning.tune`.

    Raises:
        Misused: there are no coordinates.
        RunError: settings contradict each other.
        Runaway: the equilibration broke down.
        ForceFieldError, RecordError, RigidityError, OSError, openmm.OpenMMException: as their messages say.
    """
    if "box" not in given:
        raise Misused("tune needs BOX, a file of coordinates (see openmm-sier tune --help)")
    origin = read_origin(given.get("start"))
    settings = new_settings({**given, "ensemble": "hmc"}, origin.settings if origin else None)
    context, _ = begin(Simulated(settings), origin)
    schemes = [given["scheme"]] if "scheme" in given else None
    several = len(schemes or SCHEMES)
    note(f"{settings.title} on the {context.getPlatform().getName()} platform: tunes scheme, step and length of trials")
    # Each of the four lengths has as many steps in all; a step is found by some four attempts.
    note(f"this takes some {4 * samples + 4 * trials * several} trials of {settings.step_time:g} ps")
    found = tune(context, acceptance, trials, samples, schemes=schemes)
    # The run below has the scheme, whatever this Context has.
    note(str(found._replace(isSet=True)))
    note(f"Do not take averages over these trials. To run with what was found:\n{run_line(given, found)}")


def run_line(given: Mapping[str, Any], found: Tuning) -> str:
    """Return the command line of a run with what was found, and all else as given."""
    chosen = {
        "scheme": found.scheme.name.lower(),
        "dt": float(f"{1000 * found.schemeStepSize:.4g}"),
        "steps_per_trial": found.stepsPerTrial,
    }
    line = [PROGRAM, "run", argument(given["box"]), "--ensemble", "hmc"]
    for name, value in {**given, **chosen}.items():
        line += [] if name == "box" else arguments(name, value)
    return shlex.join(line)
