"""The costly steps of all bodies in loops that Numba compiles and threads share."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numpy import ndarray

from openmm_sier.dynamics.backend import numba_loops
from openmm_sier.dynamics.backend.numba_compile import compiled
from openmm_sier.dynamics.backend.numpy_backend import NumpyBackend, rotated
from openmm_sier.dynamics.backend.threads import shared

_compiled = cache(compiled)


class NumbaBackend(NumpyBackend):
    """What `NumpyBackend` does, compiled. Bodies that turn too far for the series in a step are left to NumPy."""

    name = "Numba"

    def _rotate_kind(self, rates: ndarray, part: slice, A: ndarray, L: ndarray, h: float, new: ndarray) -> None:
        if rates.ndim > 1:
            super()._rotate_kind(rates, part, A, L, h, new)
            return
        far = np.empty(A.shape[2], dtype=bool)
        if shared(_compiled(numba_loops.rotate))(part, A, L, h, rates, new, far):
            left = part.start + np.flatnonzero(far[part])
            new[:, :, left] = rotated(rates, A[:, :, left], L[:, left], h, left)

    def execute(self, function: Callable[..., Any], *arguments: Any) -> Any:
        return _compiled(function)(*arguments)
