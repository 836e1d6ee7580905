"""The loops of `openmm_sier.dynamics.backend.loops` and the formulas of `kernels` compiled by Numba, run by threads.

Numba is an extra (`openmm-sier[fast]`). Where it is installed it is used; the environment variable OPENMM_SIER_NUMBA=0
keeps it out. Compiled code is cached on disk, in NUMBA_CACHE_DIR if that is set.
"""

from __future__ import annotations

import hashlib
import os
import sys
import threading
import time
from contextlib import contextmanager, suppress
from functools import cache
from importlib import util
from inspect import getsource
from itertools import pairwise
from types import FunctionType, SimpleNamespace
from typing import Any

import numpy as np

from openmm_sier.dynamics.backend import elliptic, kernels, loops

#: Sums and products may be contracted, but not reordered: NumPy and Numba agree to rounding.
OPTIONS: dict[str, Any] = {"fastmath": {"contract", "nsz"}, "error_model": "numpy", "nogil": True}

#: Least number of bodies for a thread: to start one takes as long as some ten thousand bodies in a light loop do.
SHARE = 32768

#: Whether compiled code may be used.
_allowed = os.environ.get("OPENMM_SIER_NUMBA", "1") != "0"

#: Whether one thread has to do.
_alone = False


def executor() -> SimpleNamespace | None:
    """The compiled loops over bodies, or None where NumPy is to execute the kernels."""
    return _loops() if _allowed else None


@contextmanager
def disabled():
    """Within this NumPy executes the kernels."""
    global _allowed
    before, _allowed = _allowed, False
    try:
        yield
    finally:
        _allowed = before


@contextmanager
def single_threaded():
    """Within this one thread executes the compiled loops, however many bodies there are."""
    global _alone
    before, _alone = _alone, True
    try:
        yield
    finally:
        _alone = before


@cache
def _loops() -> SimpleNamespace | None:
    if util.find_spec("numba") is None:
        return None
    import numba

    namespace: dict = {"np": np, "TILE": loops.TILE, "ROWS": loops.ROWS, "SMALL_ANGLE": kernels.SMALL_ANGLE}
    for function in kernels.ELEMENTWISE:
        namespace[function.__name__] = numba.njit(_with_globals(function, namespace), forceinline=True, **OPTIONS)
    for helper in loops.HELPERS:
        namespace[helper.__name__] = numba.njit(_with_globals(helper, namespace), **OPTIONS)
    # The cache on disk knows of the loops' own file alone, so that their names tell of all else that they depend on.
    sources = "".join(getsource(module) for module in (kernels, elliptic, sys.modules[__name__]))
    digest = hashlib.sha256(sources.encode()).hexdigest()[:12]
    compiled = SimpleNamespace()
    for loop in loops.LOOPS:
        clone = _with_globals(loop, namespace)
        clone.__qualname__ = f"{loop.__name__}_{digest}"
        setattr(compiled, loop.__name__, _threaded(_cached(clone)))
    return compiled


def _cached(function):
    """The function compiled, and kept on disk where a directory for it can be written."""
    import numba

    try:
        return numba.njit(function, cache=True, **OPTIONS)
    except RuntimeError:
        return numba.njit(function, **OPTIONS)


def _threaded(loop):
    """The loop over a slice of the bodies, which several threads share where it is long, and sum what they return."""

    def run(part, *arguments):
        start, stop = part.start, part.stop
        n = stop - start
        if n < 2 * SHARE or (count := min(threads(), n // SHARE)) < 2:
            return loop(start, stop, *arguments)
        edges = [start + n * i // count for i in range(count + 1)]
        return _Team(loop, arguments).run(list(pairwise(edges)))

    return run


class _Team:
    """Threads that share one loop.

    They write to arrays that the caller goes on to use: however `run` is left, none is at work then. And none outlives
    the call, so that a forked process does not wait for threads that it does not have.
    """

    def __init__(self, loop, arguments):
        self._loop, self._arguments = loop, arguments
        self._abandoned = False
        self._busy: list = []
        self._errors: list[BaseException] = []
        self._results: list = []

    def run(self, spans):
        own, *others = spans
        workers = [threading.Thread(target=self._work, args=(span,), daemon=True) for span in others]
        try:
            for worker in workers:
                worker.start()
            self._results.append(self._loop(*own, *self._arguments))
            for worker in workers:
                worker.join()
        except BaseException:
            self._abandoned = True
            self._wait()
            raise
        if self._errors:
            raise self._errors[0]
        return sum(result or 0 for result in self._results)

    def _work(self, span) -> None:
        # In this order: either the thread sees that it has been abandoned, or `_wait` sees that it is busy.
        self._busy.append(span)
        try:
            if not self._abandoned:
                self._results.append(self._loop(*span, *self._arguments))
        except BaseException as error:
            self._errors.append(error)
        finally:
            self._busy.remove(span)

    def _wait(self) -> None:
        while self._busy:
            # Further interrupts change nothing: the first is on its way out.
            with suppress(BaseException):
                time.sleep(1e-4)


def threads() -> int:
    """How many share a loop over many bodies: the cores of this process, or OPENMM_CPU_THREADS, as OpenMM reads it."""
    return 1 if _alone else _available_threads()


@cache
def _available_threads() -> int:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        return max(1, int(os.environ["OPENMM_CPU_THREADS"]))
    except (KeyError, ValueError):
        return cores


def _with_globals(function, namespace):
    """The function, calling what stands in another namespace."""
    clone = FunctionType(function.__code__, namespace, function.__name__, function.__defaults__)
    clone.__module__, clone.__qualname__ = function.__module__, function.__qualname__
    return clone
