"""The command `openmm-sier run --seeds`: runs beside each other, how far they are in one table, and their means."""

import logging
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from openmm_sier.cli import summary
from openmm_sier.cli.arguments import flag
from openmm_sier.cli.console import note
from openmm_sier.cli.errors import Misused, RunError
from openmm_sier.cli.files.places import same_file
from openmm_sier.cli.many.members import Member, RunsError, named, run_many
from openmm_sier.cli.many.seeds import shown
from openmm_sier.cli.many.table import watching
from openmm_sier.cli.pictures import canvas
from openmm_sier.cli.planning import new_settings
from openmm_sier.cli.platforms import check_platform
from openmm_sier.cli.results import FEWEST_ROWS
from openmm_sier.cli.settings import RunSettings
from openmm_sier.cli.stopping import Stopped, StopRequests
from openmm_sier.dynamics.threads import cores
from openmm_sier.engines.choice import is_on_host
from openmm_sier.inputs.equilibration import platform_for

#: Options that name a file which each member writes by itself.
OF_MEMBERS = ("report", "pressure_tensor", "save_config")

#: What a member warns of, and the table of means too.
UNSETTLED = "not equilibrated"


def execute(chosen: Mapping[str, Any], seeds: Sequence[int], workers: int | None, scheduler: str | None) -> None:
    """Run `openmm-sier run --seeds`.

    Args:
        chosen: options of the user by name.
        seeds: of the members.
        workers: how many run at a time on this machine; None for as many as its platform suits.
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
        canvas.check(picture, [settings.box, *members], may_replace=True)
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
    summary.execute([member.log for member in ended], json=None, plot=picture, skip=None)


@contextmanager
def _dask_in_silence() -> Iterator[None]:
    """Keep Dask from logging errors, with their tracebacks, which the command reports in one line."""
    logging.disable()
    try:
        yield
    finally:
        # Threads of Dask end later, and report connections that closed.
        for name in ("distributed", "distributed.client"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
        logging.disable(logging.NOTSET)


def _check(options: Mapping[str, Any], workers: int | None, scheduler: str | None) -> None:
    """Refuse what many runs cannot have."""
    if options.get("restart"):
        raise Misused("--seeds continues each run that has a checkpoint: leave out --restart")
    if options.get("seed") is not None:
        raise Misused("--seed and --seeds both set seeds: give one of them")
    if workers and scheduler:
        raise Misused("--workers is for this machine, and --scheduler has its own workers: leave out --workers")


def _refuse_one_file(options: dict[str, Any], settings: RunSettings, seeds: Sequence[int]) -> None:
    """Refuse files of which each member needs its own under another name."""
    for name in OF_MEMBERS:
        if options.get(name):
            raise Misused(f"{flag(name)} names one file, but each run writes a file of its own: leave out {flag(name)}")
    for seed in seeds:
        for read in (settings.box, settings.topology):
            if read and same_file(named(settings.out, seed), read):
                raise RunError(f"{named(settings.out, seed)} would overwrite {read}: give another name with --out")


def _is_usual(name: str, value: object) -> bool:
    """Return whether a switch is off that is off by itself, for which a command line has no word."""
    return value is False and RunSettings.model_fields[name].default is False


def _usual_workers(platform: str | None) -> int:
    """Return how many runs a machine has at a time: one for each core, or one alone on a GPU."""
    return cores() if is_on_host(platform_for(platform)) else 1


# --- messages ---


def _counted(members: Sequence[Member]) -> str:
    complete = sum(member.state == "complete" for member in members)
    return f"{complete} of {len(members)} runs are complete"


def _print_warnings(members: Sequence[Member]) -> None:
    """Print each warning once, with the seeds that it is of. The means say which runs were not equilibrated."""
    warnings = [(text, member) for member in members for text in member.warnings if UNSETTLED not in text]
    for text, seeds in _grouped(warnings):
        note(f"{text} ({seeds})")


def _complaints(members: Sequence[Member]) -> str:
    """Return the complaints of members, each once."""
    failed = [(member.error or "it was stopped", member) for member in members if member.state != "complete"]
    return "; ".join(f"{seeds}: {text}" for text, seeds in _grouped(failed))


def _grouped(messages: Sequence[tuple[str, Member]]) -> list[tuple[str, str]]:
    """Return texts, each once though it names another file or number in each member, and the seeds that they are of."""
    first: dict[str, str] = {}
    seeds: dict[str, list[int]] = {}
    for text, member in messages:
        alike = re.sub(r"\d+(\.\d+)?", "#", text)
        first.setdefault(alike, text)
        seeds.setdefault(alike, []).append(member.seed)
    return [(first[alike], shown(seeds[alike])) for alike in first]
