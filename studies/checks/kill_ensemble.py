"""Ensembles whose workers are killed at random, beside an undisturbed serial run: files must be identical.

    python -m studies.checks.kill_ensemble [--members 24] [--kills 10] [--on pool dask] [--out DIR] [--time 0.4]
        [--throughput]

The undisturbed run is one process after another, with one thread of OpenMM each. `--throughput` also runs the members
without kills on two processes, and one after another with all threads of the machine, whose files may differ in the
last bits. Then the same members run on two processes of this machine, and on two workers of a dask LocalCluster, while
every few seconds a member's process, or a whole worker of dask, is killed.
"""

from __future__ import annotations

import os
import random
import signal
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Literal

from openmm_sier.cli.pool import WORKER, Member, Outcome, ensemble
from openmm_sier.dynamics.backend.threads import cores
from studies.command import BoxSettings, command
from studies.report import SILENT, Report

OPTIONS = "--scheme sier2 --dt 2 --ensemble nvt --platform CPU --equilibrate 0.02 --every 0.04 --checkpoint-every 0.04"


def members_of(box: Path, number: int, time: float) -> list[Member]:
    """Runs that differ in their seeds."""
    common = ("run", str(box), *OPTIONS.split(), "--report-every", "0.02", "--time", str(time))
    return [Member(f"seed{seed}", (*common, "--seed", str(seed)), time) for seed in range(1, number + 1)]


def processes_in(place: Path) -> list[int]:
    """The processes of members of an ensemble."""
    found = []
    for entry in Path("/proc").iterdir():
        with suppress(OSError):
            is_member = entry.name.isdigit() and WORKER in (entry / "cmdline").read_text()
            if is_member and Path(os.readlink(entry / "cwd")).is_relative_to(place):
                found.append(int(entry.name))
    return found


class Killer:
    """Kills processes at random moments until it has done so often enough."""

    def __init__(self, victims: Callable[[], list[int]], kills: int, seed: int):
        self._victims, self._kills, self._random = victims, kills, random.Random(seed)
        self._over = threading.Event()
        self.done = 0
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Killer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        while self.done < self._kills and not self._over.wait(self._random.uniform(1, 6)):
            if victims := self._victims():
                with suppress(ProcessLookupError):
                    os.kill(self._random.choice(victims), signal.SIGKILL)
                    self.done += 1


def on_pool(members: Sequence[Member], place: Path, kills: int) -> tuple[list[Outcome], int]:
    with Killer(lambda: processes_in(place), kills, 1) as killer:
        return ensemble(members, place, processes=2), killer.done


def on_dask(members: Sequence[Member], place: Path, kills: int) -> tuple[list[Outcome], int]:
    import dask
    from distributed import Client, LocalCluster

    dask.config.set({"distributed.scheduler.allowed-failures": kills + 1})
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster, Client(cluster) as client:

        def victims() -> list[int]:
            # A worker that has just been killed does not answer.
            with suppress(OSError):
                return [*client.run(os.getpid, on_error="ignore").values(), *processes_in(place)]
            return processes_in(place)

        with Killer(victims, kills, 2) as killer:
            return ensemble(members, place, client.get_executor(pure=False), threads=1), killer.done


def undisturbed(members: Sequence[Member], place: Path, processes: int, threads: int, report: Report) -> None:
    begun = perf_counter()
    ensemble(members, place, processes=processes, threads=threads)
    used = f"{processes} at a time, {threads} threads each"
    report.note(f"{len(members)} members, {used}: {perf_counter() - begun:.0f} s")


def files(place: Path) -> dict[Path, bytes]:
    return {p.relative_to(place): p.read_bytes() for p in sorted(place.rglob("run.*")) if p.suffix in (".csv", ".dcd")}


@dataclass(frozen=True)
class KillSettings(BoxSettings):
    """What is run and killed.

    Attributes:
        members: their number, which differ in their seeds.
        kills: how many.
        time: of each member, ps.
        on: where members run that are killed.
        throughput: whether undisturbed runs are timed by processes and threads too.
    """

    members: int = 24
    kills: int = 10
    time: float = 0.4
    on: tuple[Literal["pool", "dask"], ...] = ("pool", "dask")
    throughput: bool = False


def study(settings: KillSettings, report: Report = SILENT) -> None:
    """Run, kill and compare.

    Raises:
        EnsembleError: a member failed.
        ValueError: files differ.
    """
    place = settings.out.resolve()
    members = members_of(settings.box.resolve(), settings.members, settings.time)
    undisturbed(members, place / "quiet", 1, 1, report)
    if settings.throughput:
        undisturbed(members, place / "pool-undisturbed", 2, 1, report)
        undisturbed(members, place / "threads", 1, cores(), report)
    expected = files(place / "quiet")
    for name in settings.on:
        begun = perf_counter()
        outcomes, killed = {"pool": on_pool, "dask": on_dask}[name](members, place / name, settings.kills)
        restarts = sum(outcome.restarts for outcome in outcomes)
        report.note(f"{name}: {perf_counter() - begun:.0f} s, {killed} kills, {restarts} restarts")
        if files(place / name) != expected:
            raise ValueError(f"files of {name} differ from those of the undisturbed run")
        report.note(f"{name}: files are the same to the byte")


main = command(KillSettings, study, __doc__, __name__)
