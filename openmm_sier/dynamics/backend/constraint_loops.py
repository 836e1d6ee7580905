"""The loops over constraints, compiled by Numba."""

from __future__ import annotations

import hashlib
import os
import sys
from functools import cache
from importlib import util
from inspect import getsource
from types import FunctionType, ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from openmm_sier.dynamics.backend import graph_loops, star_loops

#: Sums and products may be contracted, but not reordered, so that NumPy and Numba agree to rounding.
OPTIONS: dict[str, Any] = {"fastmath": {"contract", "nsz"}, "error_model": "numpy", "nogil": True}


def available() -> bool:
    """Whether Numba is installed and allowed: the environment variable OPENMM_SIER_NUMBA=0 disables it."""
    return os.environ.get("OPENMM_SIER_NUMBA", "1") != "0" and util.find_spec("numba") is not None


@cache
def compiled_stars(leaves: int) -> SimpleNamespace:
    """The `LOOPS` of `star_loops`, compiled for stars of this many leaves."""

    def largest(value: float) -> float:
        return value

    def leaves_of(array: np.ndarray) -> int:
        return leaves

    return _compiled(star_loops, (largest, leaves_of), f"of_{leaves}")


@cache
def compiled_graphs() -> SimpleNamespace:
    """The `LOOPS` of `graph_loops`, compiled."""
    return _compiled(graph_loops, (), "of_graphs")


def _compiled(module: ModuleType, special: tuple[Any, ...], suffix: str) -> SimpleNamespace:
    """The compiled loops of a module, in which some functions are replaced.

    Every function that is compiled gets a name of its own: code from the cache on disk is linked by names, and
    functions of one name that were compiled for different stars, in different processes, would be confused.
    """
    import numba

    constants = {name: value for name, value in vars(module).items() if name.isupper() and not isinstance(value, tuple)}
    namespace: dict[str, Any] = {"np": np, "__builtins__": __builtins__, **constants}
    # The cache watches only the file of a loop, so that the names carry a digest of this file.
    digest = hashlib.sha256(getsource(sys.modules[__name__]).encode()).hexdigest()[:12]

    def clone(function: FunctionType, own: dict[str, Any]) -> FunctionType:
        copy = FunctionType(function.__code__, own, function.__name__, function.__defaults__, function.__closure__)
        copy.__module__, copy.__qualname__ = function.__module__, f"{function.__name__}_{suffix}_{digest}"
        return copy

    for function in (*special, *module.HELPERS):
        namespace[function.__name__] = numba.njit(clone(function, namespace), **OPTIONS)
    found = SimpleNamespace()
    for loop in module.LOOPS:
        try:
            function = numba.njit(clone(loop, namespace), cache=True, **OPTIONS)
        except RuntimeError:  # There is no directory where compiled code could be kept.
            function = numba.njit(clone(loop, namespace), **OPTIONS)
        setattr(found, loop.__name__, function)
    return found
