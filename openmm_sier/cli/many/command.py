"""The command `openmm-sier run --seeds`: parallel runs, their progress in one table, and their means."""

import logging
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from openmm_sier.cli import pictures, summary
from openmm_sier.cli.arguments import flag
from openmm_sier.cli.console import note
from openmm_sier.cli.errors import Misused, RunError
from openmm_sier.cli.files.places import same_file
from openmm_sier.cli.many.members import Member, RunsError, named, run_many
from openmm_sier.cli.many.seeds import shown
from openmm_sier.cli.many.table import watching
from openmm_sier.cli.planning import new_settings
from openmm_sier.cli.platforms import check_platform
from openmm_sier.cli.results import FEWEST_ROWS
from openmm_sier.cli.settings import RunSettings
from openmm_sier.cli.stopping import Stopped, StopRequests
from openmm_sier.dynamics.threads import cores
from openmm_sier.engines.choice import is_on_host
from openmm_sier.inputs.equilibration import platform_for

#: Options that name an output of each member.
OF_MEMBERS = ("report", "pressure_tensor", "save_config")

#: Words of a warning that the table of means repeats.
UNSETTLED = "not equilibrated"


def execute(chosen: Mapping[str, Any], seeds: Sequence[int], workers: int | None, scheduler: str | None) -> None:
    """Run `openmm-sier run --seeds`.

    Args:
        chosen: options of the user by name.
        seeds: of the members.
        workers: number of parallel runs on this machine; None for a number that suits its platform.
        scheduler: address of a scheduler of Dask; None for this machine.

    Raises:
        Misused: options contradict each other.
        RunError: members failed; the message has each complaint once.
        Stopped: a signal stopped the members.
        ForceFieldError, RecordError, OSError, ModuleNotFoundError: as their messages say.
    """
    options = {name: value for name, value in chosen.items() if not _is_usual(name, value)}
    picture = options.pop("plot", None)
    _check(options, workers, scheduler)
    if scheduler is None:
        check_platform(options.get("platform"))
    settings = new_settings(options)
    members = [named(settings.out, seed) for seed in seeds]
    if picture:
        pictures.check(picture, [settings.box, *members], overwrite=True)
    _refuse_one_file(options, settings, seeds)
    box, out = options.pop("box"), options.pop("out", None)
    at_a_time = None if scheduler else min(workers or _usual_workers(options.get("platform")), len(seeds))
    where = f"on the workers of {scheduler}" if scheduler else f"{at_a_time} at a time"
    number = "1 run" if len(seeds) == 1 else f"{len(seeds)} runs"
    note(f"{number} of {settings.title}, to step {settings.length(settings.steps)}, {where}")
    with _dask_in_silence(), StopRequests() as requests, watching(settings.steps) as watch:
        requests.defer()
        try:
            ended = run_many(
                box,
                seeds,
                out=out,
                workers=at_a_time,
                scheduler=scheduler,
                watch=watch,
                stop=lambda: requests.received is not None,
                **options,
            )
        except RunsError as error:
            raise RunError(
                f"{error}. Give the same command again to continue the runs that are not complete"
            ) from error
    _print_warnings(ended)
    if requests.received is not None:
        raise Stopped(requests.received, f"stopped: {_counted(ended)}. Give the same command again to continue")
    if any(member.state != "complete" for member in ended):
        again = "Give the same command again to continue the others"
        raise RunError(f"{_complaints(ended)}. {_counted(ended)}. {again}")
    if settings.steps // settings.interval(settings.report_every) + 1 < FEWEST_ROWS:
        note(f"no means: a log needs {FEWEST_ROWS} rows or more. Lower --report-every")
        return
    summary.execute([member.log for member in ended], json=None, plot=picture, skip=None, overwrite=True)


@contextmanager
def _dask_in_silence() -> Iterator[None]:
    """Disable logging, since Dask logs tracebacks of errors that the command reports in one line."""
    logging.disable()
    try:
        yield
    finally:
        # Threads of Dask end later, and report connections that closed.
        for name in ("distributed", "distributed.client"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
        logging.disable(logging.NOTSET)


def _check(options: Mapping[str, Any], workers: int | None, scheduler: str | None) -> None:
    """Refuse options that many runs cannot have."""
    if options.get("restart"):
        raise Misused("--seeds continues each run that has a checkpoint: leave out --restart")
    if options.get("seed") is not None:
        raise Misused("--seed and --seeds both set seeds: give one of them")
    if workers and scheduler:
        raise Misused("--workers is for this machine, and --scheduler has its own workers: leave out --workers")


def _refuse_one_file(options: dict[str, Any], settings: RunSettings, seeds: Sequence[int]) -> None:
    """Refuse a name of a file that each member would write."""
    for name in OF_MEMBERS:
        if options.get(name):
            raise Misused(f"{flag(name)} names one file, but each run writes a file of its own: leave out {flag(name)}")
    for seed in seeds:
        for source in (settings.box, settings.topology):
            if source and same_file(named(settings.out, seed), source):
                raise RunError(f"{named(settings.out, seed)} would overwrite {source}: give another name with --out")


def _is_usual(name: str, value: object) -> bool:
    """Return whether a switch is off as by default, which a command line cannot express."""
    return value is False and RunSettings.model_fields[name].default is False


def _usual_workers(platform: str | None) -> int:
    """Return the usual number of parallel runs: one for each core, or one on a GPU."""
    return cores() if is_on_host(platform_for(platform)) else 1


# --- messages ---


def _counted(members: Sequence[Member]) -> str:
    complete = sum(member.state == "complete" for member in members)
    return f"{complete} of {len(members)} runs are complete"


def _print_warnings(members: Sequence[Member]) -> None:
    """Print each warning once, with its seeds. The means name the runs that were not equilibrated."""
    warnings = [(text, member) for member in members for text in member.warnings if UNSETTLED not in text]
    for text, seeds in _grouped(warnings):
        note(f"{text} ({seeds})")


def _complaints(members: Sequence[Member]) -> str:
    """Return the complaints of members, each once."""
    failed = [(member.error or "it was stopped", member) for member in members if member.state != "complete"]
    return "; ".join(f"{seeds}: {text}" for text, seeds in _grouped(failed))


def _grouped(messages: Sequence[tuple[str, Member]]) -> list[tuple[str, str]]:
    """Return texts and their seeds; texts that differ only in numbers count as one."""
    first: dict[str, str] = {}
    seeds: dict[str, list[int]] = {}
    for text, member in messages:
        alike = re.sub(r"\d+(\.\d+)?", "#", text)
        first.setdefault(alike, text)
        seeds.setdefault(alike, []).append(member.seed)
    return [(first[alike], shown(seeds[alike])) for alike in first]
