"""Threads that share compiled loops over many bodies, and the cores there are for them."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import Any

#: Least number of bodies for a thread, since starting one takes as long as some ten thousand bodies in a light loop.
SHARE = 32768

#: The values that `use` has set, the number of threads (None for that of the environment) and the least number of
#: bodies for each.
_used: tuple[int | None, int] = (None, SHARE)


def count() -> int:
    """Number of threads for a long loop: `cores()`, or OPENMM_CPU_THREADS, as OpenMM reads it."""
    return _used[0] or _available()


def cores() -> int:
    """Cores that this process is bound to, which in a batch job are fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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
