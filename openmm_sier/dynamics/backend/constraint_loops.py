"""The loops over constraints, compiled by Numba where it is to be used."""

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

#: Sums and products may be contracted, but not reordered: NumPy and Numba agree to rounding.
OPTIONS: dict[str, Any] = {"fastmath": {"contract", "nsz"}, "error_model": "numpy", "nogil": True}


def available() -> bool:
    """Whether Numba is installed and allowed: the environment variable OPENMM_SIER_NUMBA=0 keeps it out."""
    return os.environ.get("OPENMM_SIER_NUMBA", "1") != "0" and util.find_spec("numba") is not None


@cache
def compiled_stars(leaves: int) -> SimpleNamespace:
    """The `LOOPS` of `star_loops`, compiled for stars of so many leaves."""
    import numba

    def itself(value):
        return value

    def number(array):
        return leaves

    special = {"largest": numba.njit(itself, **OPTIONS), "leaves_of": numba.njit(number, **OPTIONS)}
    return _compiled(star_loops, special, f"of_{leaves}")


@cache
def compiled_graphs() -> SimpleNamespace:
    """The `LOOPS` of `graph_loops`, compiled."""
    return _compiled(graph_loops, {}, "")


def _compiled(module: ModuleType, special: dict[str, Any], suffix: str) -> SimpleNamespace:
    import numba

    constants = {name: value for name, value in vars(module).items() if name.isupper() and not isinstance(value, tuple)}
    namespace: dict[str, Any] = {"np": np, "__builtins__": __builtins__, **constants, **special}
    for helper in module.HELPERS:
        namespace[helper.__name__] = numba.njit(_with_globals(helper, namespace), **OPTIONS)
    # The cache on disk knows of the file of a loop alone, so that the names tell of all else.
    digest = hashlib.sha256(getsource(sys.modules[__name__]).encode()).hexdigest()[:12]
    found = SimpleNamespace()
    for loop in module.LOOPS:
        clone = _with_globals(loop, namespace)
        clone.__qualname__ = f"{loop.__name__}_{suffix}_{digest}"
        try:
            function = numba.njit(clone, cache=True, **OPTIONS)
        except RuntimeError:  # There is no directory where compiled code could be kept.
            function = numba.njit(clone, **OPTIONS)
        setattr(found, loop.__name__, function)
    return found


def _with_globals(function, namespace):
    """The function, calling what stands in another namespace."""
    clone = FunctionType(function.__code__, namespace, function.__name__, function.__defaults__)
    clone.__module__, clone.__qualname__ = function.__module__, function.__qualname__
    return clone
