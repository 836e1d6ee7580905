"""Arguments of the free-rotation maps."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from openmm_sier.dynamics.backend.numpy_backend import ROTATED as BLOCK
from openmm_sier.dynamics.backend.top import Top, top


def checked(A: np.ndarray, L: np.ndarray, moments: np.ndarray, h: float) -> tuple[Top, np.ndarray, np.ndarray, float]:
    """The arguments of a free-rotation map as arrays, the moments prepared.

    Raises:
        ValueError: shapes do not fit, moments are impossible, or h is not finite.
    """
    bodies, h = top(moments), float(h)
    A, L = np.asarray(A, dtype=float), np.asarray(L, dtype=float)
    if A.ndim != 3 or A.shape[:2] != (3, 3) or L.shape != (3, A.shape[2]):
        raise ValueError(f"A must have shape (3, 3, n) and L (3, n), got {A.shape} and {L.shape}")
    if not math.isfinite(h):
        raise ValueError(f"h must be finite, got {h}")
    if not bodies.shared and bodies.rates.shape[1] != A.shape[2]:
        raise ValueError(f"moments are given for {bodies.rates.shape[1]} bodies, A and L for {A.shape[2]}")
    return bodies, A, L, h


def demand_finite(L: np.ndarray) -> None:
    """Refuse angular momenta (3, n) that are not finite.

    Raises:
        ValueError: one is not.
    """
    if not np.isfinite(L).all():
        raise ValueError(f"the angular momentum of body {np.isfinite(L).all(axis=0).argmin()} is not finite")


def blocks(bodies: Top, n: int) -> Iterator[tuple[slice, Top]]:
    """Slices of n bodies whose arrays stay in cache, and their moments."""
    for start in range(0, n, BLOCK):
        block = slice(start, start + BLOCK)
        yield block, bodies.part(block)
