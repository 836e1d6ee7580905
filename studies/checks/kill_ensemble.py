#!/usr/bin/env python3
"""Ensembles whose workers are killed at random, beside an undisturbed serial run: files must be identical.

    python -m studies.checks.kill_ensemble [--members 24] [--kills 10] [--on pool dask] [--out DIR] [--time 0.4]
        [--throughput]

The undisturbed run is one process after another, with one thread of OpenMM each. `--throughput` also runs the members
without kills on two processes, and one after another with all threads of the machine, whose files may differ in the
last bits. Then the same members run on two processes of this machine, and on two workers of a dask LocalCluster, while
every few seconds a member's process, or a whole worker of dask, is killed.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from time import perf_counter

from openmm_sier.measure.ensemble import WORKER, EnsembleError, Member, Outcome, ensemble
from openmm_sier.measure.forcefields import shipped_box

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


def undisturbed(members: Sequence[Member], place: Path, processes: int, threads: int) -> None:
    begun = perf_counter()
    ensemble(members, place, processes=processes, threads=threads)
    used = f"{processes} at a time, {threads} threads each"
    print(f"{len(members)} members, {used}: {perf_counter() - begun:.0f} s", flush=True)


def files(place: Path) -> dict[Path, bytes]:
    return {p.relative_to(place): p.read_bytes() for p in sorted(place.rglob("run.*")) if p.suffix in (".csv", ".dcd")}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--box", type=Path, default=None, help="default: 512 molecules of TIP3P")
    parser.add_argument("--members", type=int, default=24)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--time", type=float, default=0.4, help="ps")
    parser.add_argument("--on", nargs="+", default=["pool", "dask"], choices=("pool", "dask"))
    parser.add_argument("--out", type=Path)
    parser.add_argument("--throughput", action="store_true", help="time undisturbed runs by processes and threads")
    options = parser.parse_args()
    out = (options.out or Path(tempfile.mkdtemp())).resolve()
    members = members_of((options.box or shipped_box()).resolve(), options.members, options.time)
    undisturbed(members, out / "quiet", 1, 1)
    if options.throughput:
        undisturbed(members, out / "pool-undisturbed", 2, 1)
        undisturbed(members, out / "threads", 1, os.cpu_count() or 1)
    expected, wrong = files(out / "quiet"), 0
    for name in options.on:
        begun = perf_counter()
        try:
            outcomes, killed = {"pool": on_pool, "dask": on_dask}[name](members, out / name, options.kills)
        except EnsembleError as error:
            print(f"{name}: {error}")
            return 1
        same = files(out / name) == expected
        wrong += not same
        print(
            f"{name}: {perf_counter() - begun:.0f} s, {killed} kills, {sum(o.restarts for o in outcomes)} restarts; "
            f"files {'are the same to the byte' if same else 'DIFFER'}",
            flush=True,
        )
    if options.out is None:
        shutil.rmtree(out)
    return wrong


if __name__ == "__main__":
    sys.exit(main())
