"""Threads for compiled loops over many bodies, and the number of available cores."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, wraps
from typing import Any

#: Least number of bodies in a share, since starting a thread takes as long as some ten thousand bodies in a light loop.
SHARE = 32768


@cache
def count() -> int:
    """Return the number of threads for a long loop: `cores()`, or OPENMM_CPU_THREADS, as OpenMM reads it."""
    try:
        return max(1, int(os.environ["OPENMM_CPU_THREADS"]))
    except (KeyError, ValueError):
        return cores()


def cores() -> int:
    """Count the cores that this process may use, which in a batch job are fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def shared(loop: Callable[..., float]) -> Callable[..., float]:
    """Turn a loop (start, stop, ...) into one over a number of bodies, which threads share if it is long.

    The numbers that it returns are summed. However the call ends, its threads end with it: a forked process does not
    wait for threads that it does not have.
    """

    @wraps(loop)
    def run(n: int, *arguments: Any) -> float:
        if n < 2 * SHARE:
            return loop(0, n, *arguments)
        # Shares do not depend on the number of threads, so that sums have the same bits with any.
        shares = n // SHARE
        edges = [n * i // shares for i in range(shares + 1)]
        with ThreadPoolExecutor(min(count(), shares)) as pool:
            return sum(pool.map(lambda low, high: loop(low, high, *arguments), edges[:-1], edges[1:]))

    return run
