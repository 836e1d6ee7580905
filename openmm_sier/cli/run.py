"""The command `openmm-sier run`: coordinates in, a trajectory out."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from openmm_sier.analysis import read_log
from openmm_sier.cli import many, results, run_checks
from openmm_sier.cli.config import joined, read_config, write_config
from openmm_sier.cli.console import note, table
from openmm_sier.cli.errors import Misused
from openmm_sier.cli.files.locks import FileLocks
from openmm_sier.cli.logged_runs import read_runs
from openmm_sier.cli.pictures import drawing
from openmm_sier.cli.resuming import Complete, checkpoint_to_resume, resume
from openmm_sier.cli.settings import RunSettings
from openmm_sier.cli.starting import start
from openmm_sier.cli.stopping import StopRequests


def execute(
    given: Mapping[str, Any],
    config: Path | None = None,
    seeds: Sequence[int] | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
) -> None:
    """Run `openmm-sier run`.

    Args:
        given: settings by name, see `RunSettings`.
        config: a TOML file with more of them.
        seeds, workers, scheduler: of many runs, see `openmm_sier.cli.many.execute`; None for one run.

    Raises:
        Misused: there are no coordinates, or settings contradict each other.
        RunError: settings contradict the checkpoint, or a file is in the way or cannot be written.
        Runaway: the energy or the temperature ran away.
        Stopped: a signal ended the run; the message says how to go on.
        ForceFieldError, RecordError, RigidityError, OSError, openmm.OpenMMException: as their messages say.
    """
    if config:
        given = joined(read_config(config), given)
    if "box" not in given and "restart" not in given:
        raise Misused("run needs BOX, a file of coordinates, or --restart (see openmm-sier run --help)")
    if seeds:
        many.execute(given, seeds, workers, scheduler)
        return
    if workers or scheduler:
        raise Misused(f"{'--workers' if workers else '--scheduler'} needs --seeds, such as --seeds 1-24")
    with FileLocks() as locks, StopRequests() as requests:
        checkpoint = checkpoint_to_resume(given, locks)
        try:
            run = resume(given, checkpoint, locks, requests) if checkpoint else start(given, locks, requests, config)
        except Complete as done:
            if not given.get("resume"):
                raise
            note(f"{checkpoint} is at step {done.settings.length(done.settings.steps)}: the run is complete")
            report(done.settings, [], done.unsettled)
            return
        if run.settings.save_config:
            write_config(run.settings.save_config, run.settings)
        cost = run.advance(requests)
        report(run.settings, cost, run.unsettled)
    extras = [path for path in (run.settings.plot, run.settings.save_config) if path]
    note(f"wrote {', '.join(map(str, [*run.outputs.paths, *extras]))}")


def report(settings: RunSettings, cost: list[tuple[str, str]], unsettled: str | None) -> None:
    """Print the table at the end of a run, and draw its log."""
    log = read_log(settings.report)
    warning = run_checks.fluctuation_warning(settings, log)
    rows = results.rows(log, settings.ensemble, settings.moves_volume)
    rows += [("WARNING: rms(H)/rms(V)", warning)] if warning else []
    rows += [("WARNING: not equilibrated", f"after {unsettled}")] if unsettled else []
    table(f"{settings.title}, {settings.steps * settings.step_time:g} ps", ("", ""), rows + cost)
    if settings.plot:
        drawing.draw(read_runs([settings.report]), settings.plot)
