"""Parallel runs that differ in their seeds: ordinary runs of the command, on workers of Dask.

A member is a separate process, `openmm-sier run … --resume --seed N`, which a worker starts and watches. It continues
from its checkpoint wherever it is started again. Dask gives members to workers, and gives those of a dead worker to
another.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from asyncio import CancelledError
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from openmm_sier.cli.arguments import argument, arguments
from openmm_sier.cli.files.records import last_step
from openmm_sier.dynamics.threads import cores

if TYPE_CHECKING:
    from distributed import Client, Future

#: Number of times that a member is restarted after its process or worker died.
RETRIES = 3

#: Seconds between two checks of a member, and of all members.
LOOK, REFRESH = 0.2, 0.5

#: Seconds for a scheduler to answer, and for stopped members to complete their step and their files.
PATIENCE, LAST_STEP = 30.0, 60.0

#: Number of members that are looked at between two calls of `watch`, which counts all.
WATCHED = 20

#: Exit code of a stopped member.
STOPPED = 128 + signal.SIGTERM

#: Address of the HTTP servers that Dask requires: any port, for this machine only.
OWN_MACHINE = "127.0.0.1:0"

State = Literal["waiting", "running", "complete", "failed", "stopped"]

#: Called with all members whenever something may have changed.
Watch = Callable[[Sequence["Member"]], None]


class RunsError(RuntimeError):
    """Runs could not be begun, or not be completed."""


@dataclass
class Member:
    """One of many runs.

    Attributes:
        seed: of the run.
        out: its trajectory; other files are named after it.
        state: of the run.
        step: the last one in its log.
        error: its error message, in one line.
        warnings: its warnings.
    """

    seed: int
    out: Path
    state: State = "waiting"
    step: int = 0
    error: str = ""
    warnings: tuple[str, ...] = ()

    @property
    def log(self) -> Path:
        """Path of the log."""
        return self.out.with_suffix(".csv")


class Ended(NamedTuple):
    """End of the process of a member: exit code, the last line of its error message, and its warnings."""

    code: int
    error: str = ""
    warnings: tuple[str, ...] = ()


class DiedError(RuntimeError):
    """The process of a member was killed."""


def run_many(
    box: str | os.PathLike[str],
    seeds: Sequence[int],
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    retries: int = RETRIES,
    watch: Watch | None = None,
    stop: Callable[[], bool] = lambda: False,
    **options: Any,
) -> list[Member]:
    """Make runs that differ in their seeds, and continue those that are not complete.

    Members are `openmm-sier run box --resume --seed N` with files named after `out` and `pressure_tensor`, to which
    "-seedN" is added.
    Without a scheduler they run in parallel on this machine. With one they run on its workers, which need this package
    and the same files under the same names.

    Args:
        box: coordinates.
        seeds: of the members.
        workers: number of parallel runs on this machine; None for one on each core.
        scheduler: address of a scheduler of Dask, such as `tcp://node7:8786`.
        retries: number of times that a member is restarted after its process or worker died.
        watch: function of the members, called periodically.
        stop: function that returns whether to stop members, called periodically. They complete a step and their files.
        options: of `openmm-sier run` by name, with underscores; lists for options with several values.

    Returns:
        The members with their final states. A member that failed does not end the others.

    Raises:
        RunsError: a seed is given twice, the scheduler does not answer or went away, or Dask failed.
        ModuleNotFoundError: Dask is not installed.
    """
    if twice := sorted(seed for seed, times in Counter(seeds).items() if times > 1):
        raise RunsError(f"the seed {twice[0]} is given twice: give each run a seed of its own")
    out = Path(options.pop("out", None) or f"{Path(box).stem}.dcd")
    members = [Member(seed, named(out, seed)) for seed in seeds]
    lines = {member.seed: command_of(box, member, options) for member in members}
    # It parses command lines, whose module imports this one.
    from openmm_sier.cli.many.complete import is_complete, settings_in

    watch = watch or (lambda _: None)
    # To parse a line takes ten times as long as all else.
    shared = settings_in(lines[seeds[0]]) if members else None
    for number, member in enumerate(members):
        if shared is not None and not stop() and is_complete(shared.model_copy(update=own_options(member, options))):
            member.state = "complete"
            _update_step(member)
        if number % WATCHED == 0:
            watch(members)
    watch(members)
    if any(member.state != "complete" for member in members):
        with _dask_errors(), _client(scheduler, workers) as client:
            _Runs(client, members, retries, watch, stop).carry_out(lines, _threads(scheduler, workers))
    return members


def named(path: Path, seed: int) -> Path:
    """Return the name of a member's file."""
    return path.with_name(f"{path.stem}-seed{seed}{path.suffix}")


def command_of(box: str | os.PathLike[str], member: Member, options: dict[str, Any]) -> list[str]:
    """Return the command line of a member, word by word."""
    first = {"seed": member.seed, "out": member.out, "resume": True}
    chosen = first | options | own_options(member, options)
    words = [word for name, value in chosen.items() if value is not None for word in arguments(name, value)]
    return ["run", argument(box), *words]


def own_options(member: Member, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a member that differ from those of the others, for options of `run_many`."""
    own: dict[str, Any] = {"seed": member.seed, "out": member.out}
    if tensors := options.get("pressure_tensor"):
        own["pressure_tensor"] = named(Path(tensors), member.seed)
    return own


# --- the pool, which is Dask's ---


def _dask() -> Any:
    try:
        import distributed
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("many runs need Dask; install it with: pip install 'openmm-sier[many]'") from error
    return distributed


@contextmanager
def _client(scheduler: str | None, workers: int | None) -> Iterator[Client]:
    """Connect to a scheduler, or start one in this process, whose workers are threads that watch processes."""
    distributed = _dask()
    if scheduler is not None:
        try:
            client = distributed.Client(scheduler, timeout=PATIENCE, set_as_default=False)
        except (OSError, ValueError) as error:
            raise RunsError(f"the scheduler {scheduler} does not answer: {' '.join(str(error).split())}") from error
        with _closing(client):
            yield client
        return
    cluster = distributed.LocalCluster(
        n_workers=workers or cores(),
        threads_per_worker=1,
        processes=False,
        # By default workers listen on all networks, and the usual port may be in use.
        dashboard_address=OWN_MACHINE,
        worker_dashboard_address=OWN_MACHINE,
        # Threads have no memory of their own to be watched.
        memory_limit=0,
        silence_logs=50,
    )
    with _closing(cluster), _closing(distributed.Client(cluster, set_as_default=False)) as client:
        yield client


@contextmanager
def _closing(opened: Any) -> Iterator[Any]:
    """Close a client or a cluster, and ignore errors, such as those of a lost connection."""
    try:
        yield opened
    finally:
        with suppress(Exception, CancelledError):
            opened.close(timeout=PATIENCE)


@contextmanager
def _dask_errors() -> Iterator[None]:
    """Turn errors of Dask into a `RunsError`; runs lose nothing by them."""
    try:
        yield
    except (RunsError, ModuleNotFoundError):
        raise
    except (Exception, CancelledError) as error:
        message = " ".join(str(error).split())
        raise RunsError(f"Dask ended the runs: {type(error).__name__} {message}".rstrip()) from error


def _threads(scheduler: str | None, workers: int | None) -> int | None:
    """Return the number of threads of each member on this machine; None for workers of a scheduler."""
    return None if scheduler else max(1, cores() // (workers or cores()))


class _Runs:
    """Members that run.

    Attributes:
        members: those that have not ended, by their futures.
    """

    def __init__(
        self, client: Client, members: Sequence[Member], retries: int, watch: Watch, stop: Callable[[], bool]
    ) -> None:
        self._client = client
        self._all = members
        self._retries = retries
        self._watch = watch
        self._stop = stop
        self.members: dict[Future, Member] = {}

    def carry_out(self, lines: dict[int, list[str]], threads: int | None) -> None:
        """Execute the command line of each seed, until all have ended or are stopped."""
        stop = _dask().Event(f"openmm-sier-stop-{uuid.uuid4().hex}", client=self._client)
        for member in [member for member in self._all if member.state != "complete"]:
            task = (lines[member.seed], os.getcwd(), threads, stop.name)
            future = self._client.submit(carry_out, *task, pure=False, retries=self._retries)
            self.members[future] = member
        try:
            self._wait(None)
            if self.members:
                stop.set()
                self._wait(time.monotonic() + LAST_STEP)
                for member in self.members.values():
                    member.state = "stopped"
        finally:
            self._watch(self._all)

    def _wait(self, until: float | None) -> None:
        """Collect members that have ended, until all have, until a time, or else until a stop is requested."""
        while self.members:
            for future in [future for future in self.members if future.status != "pending"]:
                _collect(future, self.members.pop(future), self._client)
            _refuse_absence(self._client)
            for member in self.members.values():
                _update_step(member)
            self._watch(self._all)
            if time.monotonic() > until if until else self._stop():
                return
            time.sleep(REFRESH)


def _collect(future: Future, member: Member, client: Client) -> None:
    """Store the final state of a member."""
    if future.status in ("cancelled", "lost"):
        raise _gone(client)
    _update_step(member)
    if future.status == "error":
        member.state, member.error = "failed", " ".join(str(future.exception()).split())
        return
    ended = future.result()
    member.error, member.warnings = ended.error, ended.warnings
    by_signal = ended.code > 128
    member.state = "complete" if ended.code == 0 else "stopped" if by_signal else "failed"


def _refuse_absence(client: Client) -> None:
    if client.status != "running":
        raise _gone(client)


def _gone(client: Client) -> RunsError:
    address = client.scheduler.address if client.scheduler is not None else "of Dask"
    return RunsError(f"the scheduler {address} went away")


def _update_step(member: Member) -> None:
    """Read the last step of a member from its log."""
    with suppress(OSError, ValueError):
        step = last_step(member.log)
        if member.state == "waiting" and step != member.step:
            member.state = "running"
        member.step = step


# --- on a worker ---


def carry_out(line: Sequence[str], directory: str, threads: int | None, stop: str) -> Ended:
    """Execute a command line in a separate process, which ends with the worker, and watch it.

    Args:
        line: words after `openmm-sier`.
        directory: of the files.
        threads: of the process; None for OPENMM_CPU_THREADS of the worker, or one.
        stop: name of the event that ends all members.

    Raises:
        DiedError: the process was killed, and can be restarted.
        distributed.Reschedule: the worker ends before the process, which another one continues.
    """
    distributed = _dask()
    if not os.path.isdir(directory):
        where = f"the worker on {os.uname().nodename} has no directory {directory}"
        return Ended(1, f"{where}: workers must see the files of the runs under the same names")
    worker, asked = distributed.get_worker(), distributed.Event(stop)
    if asked.is_set():
        return Ended(STOPPED)
    environment = {**os.environ, "OPENMM_CPU_THREADS": str(threads or os.environ.get("OPENMM_CPU_THREADS", 1))}
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", "openmm_sier.cli.many.member", *line],
            cwd=directory,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=errors,
            # Ctrl-C in the terminal must not reach members.
            start_new_session=True,
        )
        pipe = process.stdin
        assert pipe is not None
        with process:
            is_leaving = False
            while (code := process.poll()) is None:
                is_leaving = worker.status != distributed.core.Status.running
                if is_leaving or asked.is_set():
                    # Then the process completes its step and ends.
                    pipe.close()
                time.sleep(LOOK)
        complaint, notes = _lines(errors), _lines(output)
    if code and is_leaving:
        raise distributed.Reschedule
    if code < 0 and asked.is_set():
        # Before its first step the signal ends a process at once.
        return Ended(STOPPED)
    if code < 0:
        raise DiedError(f"its process was killed by {signal.Signals(-code).name}, also after a restart")
    warnings = tuple(text for text in notes if text.startswith("warning: "))
    return Ended(code, complaint[-1].removeprefix("openmm-sier: ") if complaint and code else "", warnings)


def _lines(file: Any) -> list[str]:
    file.seek(0)
    text: str = file.read().decode(errors="replace")
    return text.splitlines()
