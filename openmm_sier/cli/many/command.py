"""The command `openmm-sier run --seeds`: parallel runs, their progress in one table, and their means."""

import logging
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

from openmm_sier.cli import pictures, summary
from openmm_sier.cli.console import note, progress_bar
from openmm_sier.cli.errors import Misused, RunError
from openmm_sier.cli.many.members import Member, RunsError, named, run_many
from openmm_sier.cli.planning import new_settings
from openmm_sier.cli.results import FEWEST_ROWS
from openmm_sier.cli.settings import RunSettings
from openmm_sier.cli.simulated_system import check_platform
from openmm_sier.cli.stopping import Stopped, StopRequests
from openmm_sier.dynamics.threads import cores
from openmm_sier.engines.snapshot import is_on_host
from openmm_sier.inputs.equilibration import platform_for

#: Words of a warning that the table of means repeats.
UNSETTLED = "not equilibrated"


def execute(given: RunSettings, seeds: Sequence[int], workers: int | None, scheduler: str | None) -> None:
    """Run `openmm-sier run --seeds`.

    Args:
        given: settings that the user chose, and defaults.
        seeds: of the members.
        workers: number of parallel runs on this machine; None for a number that suits its platform.
        scheduler: address of a scheduler of Dask; None for this machine.

    Raises:
        Misused: settings contradict each other.
        RunError: members failed; the message has each complaint once.
        Stopped: a signal stopped the members.
        ForceFieldError, RecordError, OSError, ModuleNotFoundError: as their messages say.
    """
    _check(given, workers, scheduler)
    if scheduler is None:
        check_platform(given.platform)
    settings = new_settings(given)
    members = [named(settings.out, seed) for seed in seeds]
    if given.plot:
        pictures.check(given.plot, [settings.box, *members], settings.overwrite, log=Member(seeds[0], members[0]).log)
    # A switch that is off as by default is no option of a command line.
    options = {name: value for name, value in given.chosen.items() if not _is_usual(name, value)}
    at_a_time = None if scheduler else min(workers or _usual_workers(given.platform), len(seeds))
    where = f"on the workers of {scheduler}" if scheduler else f"{at_a_time} at a time"
    number = "1 run" if len(seeds) == 1 else f"{len(seeds)} runs"
    note(f"{number} of {settings.title}, to step {settings.length(settings.steps)}, {where}")
    bar = progress_bar(number, settings.steps * len(seeds))
    with _dask_in_silence(), StopRequests() as requests, bar as show:
        requests.defer()

        def watch(members: Sequence[Member]) -> None:
            states = Counter(member.state for member in members)
            done = sum(min(member.step, settings.steps) for member in members)
            show(done, ", ".join(f"{count} {state}" for state, count in states.items()))

        try:
            ended = run_many(
                seeds=seeds,
                workers=at_a_time,
                scheduler=scheduler,
                watch=watch,
                stop=lambda: requests.received is not None,
                **{name: value for name, value in options.items() if name != "plot"},
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
    summary.execute([member.log for member in ended], json=None, plot=given.plot, skip=None, overwrite=True)


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


def _check(given: RunSettings, workers: int | None, scheduler: str | None) -> None:
    """Refuse settings that many runs cannot have."""
    if given.restart:
        raise Misused("--seeds continues each run that has a checkpoint: leave out --restart")
    if "seed" in given.chosen:
        raise Misused("--seed and --seeds both set seeds: give one of them")
    if workers and scheduler:
        raise Misused("--workers is for this machine, and --scheduler has its own workers: leave out --workers")
    if "report" in given.chosen:
        raise Misused("--report names one file, but the logs of --seeds are named after --out: leave out --report")


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
    """Print each warning once, with its seeds. The means say how many runs were not equilibrated."""
    for line in _grouped((text, member) for member in members for text in member.warnings if UNSETTLED not in text):
        note(line)


def _complaints(members: Sequence[Member]) -> str:
    """Return the complaints of members, each once."""
    incomplete = [member for member in members if member.state != "complete"]
    return "; ".join(_grouped((member.error or "it was stopped", member) for member in incomplete))


def _grouped(messages: Iterable[tuple[str, Member]]) -> list[str]:
    """Return each text once, with the seeds of its members."""
    seeds: dict[str, list[str]] = {}
    for text, member in messages:
        seeds.setdefault(text, []).append(str(member.seed))
    return [f"{text} (--seed {', '.join(numbers)})" for text, numbers in seeds.items()]
