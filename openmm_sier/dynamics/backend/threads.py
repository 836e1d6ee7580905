"""Threads that share compiled loops over many bodies, and the cores there are for them."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

#: Least number of bodies for a thread, since starting one takes as long as some ten thousand bodies in a light loop.
SHARE = 32768

#: The values that `use` has set, the number of threads (None for that of the environment) and the least number of
#: bodies for each.
_used: tuple[int | None, int] = (None, SHARE)


#: On Linux, where a process reads of which control groups it is, and where these are.
OWN_GROUPS, ALL_GROUPS = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")


def count() -> int:
    """Number of threads for a long loop: `cores()`, or OPENMM_CPU_THREADS, as OpenMM reads it."""
    return _used[0] or _available()


def cores() -> int:
    """Cores that this process may use, which in a batch job or a container are fewer than the machine has.

    They are those that it is bound to, and not more than its control groups grant it time for.
    """
    bound = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, int(min((bound, *_granted()))))


def _granted() -> Iterator[float]:
    """Cores' worth of time that each of the control groups of this process grants, in both layouts of Linux."""
    try:
        groups = OWN_GROUPS.read_text().splitlines()
    except OSError:
        return
    for group in groups:
        _, controllers, path = group.split(":", 2)
        if not controllers:
            place, files = ALL_GROUPS, ["cpu.max"]
        elif "cpu" in controllers.split(","):
            place, files = ALL_GROUPS / "cpu", ["cpu.cfs_quota_us", "cpu.cfs_period_us"]
        else:
            continue
        folder = place / path.lstrip("/")
        # Each group is within the limits of those above it. In a container the path may begin elsewhere.
        for level in (folder, *folder.parents):
            with suppress(OSError, ValueError):  # There is no such file, or no limit in it.
                quota, period = map(int, " ".join((level / name).read_text() for name in files).split())
                if quota > 0:
                    yield quota / period


@contextmanager
def use(threads: int, share: int = SHARE) -> Iterator[None]:
    """Within this context `threads` threads share loops that have `share` bodies or more for each.

    >>> with use(3):
    ...     count()
    3
    """
    global _used
    before, _used = _used, (threads, share)
    try:
        yield
    finally:
        _used = before


@cache
def _available() -> int:
    try:
        return max(1, int(os.environ["OPENMM_CPU_THREADS"]))
    except (KeyError, ValueError):
        return cores()


def shared(loop: Callable[..., int]) -> Callable[..., int]:
    """Turn a loop (start, stop, ...) into one over a slice of the bodies, which threads share if it is long.

    The numbers that it returns are summed. However the call ends, its threads end with it: a forked process does not
    wait for threads that it does not have.
    """

    def run(part: slice, *arguments: Any) -> int:
        start, stop = part.start, part.stop
        n, share = stop - start, _used[1]
        if n < 2 * share or (team := min(count(), n // share)) < 2:
            return loop(start, stop, *arguments)
        edges = [start + n * i // team for i in range(team + 1)]
        with ThreadPoolExecutor(team) as pool:
            return sum(pool.map(lambda low, high: loop(low, high, *arguments), edges[:-1], edges[1:]))

    return run
