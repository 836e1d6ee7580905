"""The loops over constraints, compiled by Numba."""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import cache
from importlib import util
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from openmm_sier.dynamics.backend import graph_loops, star_loops
from openmm_sier.dynamics.backend.numba_compile import compiled


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

    return _compiled(star_loops, {star_loops.largest: largest, star_loops.leaves_of: leaves_of})


@cache
def compiled_graphs() -> SimpleNamespace:
    """The `LOOPS` of `graph_loops`, compiled."""
    return _compiled(graph_loops, {})


def _compiled(module: ModuleType, replaced: Mapping[Any, Any]) -> SimpleNamespace:
    return SimpleNamespace(**{loop.__name__: compiled(loop, replaced) for loop in module.LOOPS})
