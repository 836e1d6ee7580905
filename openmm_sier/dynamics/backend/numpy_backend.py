"""The costly steps of all bodies executed by NumPy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy import ndarray

from openmm_sier.dynamics.backend import long_steps
from openmm_sier.dynamics.backend.elliptic import shortest_series
from openmm_sier.dynamics.backend.formulas import body_frame, combine, rotation_matrix
from openmm_sier.dynamics.backend.short_steps import free_rotation

#: Bodies that are rotated at a time, so that temporaries stay in cache.
ROTATED = 4096


class NumpyBackend:
    """Execution of formulas that are written for scalars and for arrays alike."""

    name = "NumPy"

    def rotate(self, kinds: Sequence[tuple[ndarray, slice]], A: ndarray, L: ndarray, h: float) -> ndarray:
        """Attitudes (3, 3, n) after the exact free rotation of bodies for a time h.

        Args:
            kinds: inverse moments, descending, of each kind of body, and which bodies are of it. They are (3,), or
                (3, n) for a single kind whose bodies differ; zeros for points, three equal ones for lines.
            A: attitudes, (3, 3, n).
            L: angular momenta, (3, n).
            h: time.

        Raises:
            ValueError: an attitude or angular momentum is not finite.
        """
        new = np.empty(A.shape)
        for rates, part in kinds:
            if rates.any():
                self._rotate_kind(rates, part, A, L, h, new)
            else:
                new[:, :, part] = A[:, :, part]
        return new

    def _rotate_kind(self, rates: ndarray, part: slice, A: ndarray, L: ndarray, h: float, new: ndarray) -> None:
        """Write the new attitudes of the bodies of a slice."""
        for start in range(part.start, part.stop, ROTATED):
            block = slice(start, min(start + ROTATED, part.stop))
            own = rates if rates.ndim == 1 else rates[:, block]
            new[:, :, block] = rotated(own, A[:, :, block], L[:, block], h, range(block.start, block.stop))

    def execute(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function of `constraint_solver`."""
        return function(*arguments)


def rotated(rates: ndarray, A: ndarray, L: ndarray, h: float, numbers: Sequence[int] | ndarray) -> ndarray:
    """New attitudes, (3, 3, n), of bodies whose numbers are for messages; rates are (3,) or (3, n)."""
    with np.errstate(all="ignore"):
        body_L = body_frame(A, L)
        turn, _, reached = free_rotation(
            body_L, rates, h, shortest_series, long_steps.sine_cosine, long_steps.PHASE_CAP
        )
    if not reached.all():
        far = np.flatnonzero(~reached)
        for name, values in (("angular momentum", L[None, :, far]), ("attitude", A[:, :, far])):
            finite = np.isfinite(values).all(axis=(0, 1))
            if not finite.all():
                raise ValueError(f"the {name} of body {numbers[far[finite.argmin()]]} is not finite")
        turn = np.stack(turn)
        turn[:, far] = long_steps.turn(body_L[:, far], np.broadcast_to(rates.reshape(3, -1), L.shape)[:, far], h)
    return np.stack([combine(row, A[0], A[1], A[2]) for row in rotation_matrix(*turn)])
