"""The costly steps of all bodies in loops that Numba compiles and threads share."""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numpy import ndarray

from openmm_sier.dynamics.backend import numba_loops
from openmm_sier.dynamics.backend.numba_compile import compiled
from openmm_sier.dynamics.backend.numpy_backend import Kinds, NumpyBackend, Pair, rotated
from openmm_sier.dynamics.backend.sites import Sites
from openmm_sier.dynamics.backend.threads import shared

_compiled = cache(compiled)


@cache
def _shared(loop: Any) -> Callable[..., int]:
    return shared(_compiled(loop))


def _rotate_far(rates: ndarray, part: slice, A: ndarray, L: ndarray, h: float, far: ndarray, new: ndarray) -> None:
    left = part.start + np.flatnonzero(far[part])
    new[:, :, left] = rotated(rates, A[:, :, left], L[:, left], h, left)


class NumbaBackend(NumpyBackend):
    """Do what `NumpyBackend` does, compiled. Bodies that turn too far for the series in a step are left to NumPy."""

    name = "Numba"

    def drift(
        self, kinds: Kinds, q: ndarray, p: ndarray, A: ndarray, L: ndarray, h: float, inverse_masses: ndarray
    ) -> Pair:
        new_q, new_A, far = np.empty(q.shape), np.empty(A.shape), np.empty(A.shape[2], dtype=bool)
        for rates, part in kinds:
            if rates is None:
                new_A[:, :, part] = A[:, :, part]
                _shared(numba_loops.advance)(part, q, p, h, inverse_masses, new_q)
            elif _shared(numba_loops.drift)(part, q, p, A, L, h, rates, inverse_masses, new_q, new_A, far):
                _rotate_far(rates, part, A, L, h, far, new_A)
        return new_q, new_A

    def _rotate_kind(self, rates: ndarray, part: slice, A: ndarray, L: ndarray, h: float, new: ndarray) -> None:
        if rates.ndim > 1:
            super()._rotate_kind(rates, part, A, L, h, new)
            return
        far = np.empty(A.shape[2], dtype=bool)
        if _shared(numba_loops.rotate)(part, A, L, h, rates, new, far):
            _rotate_far(rates, part, A, L, h, far, new)

    def kick(self, p: ndarray, L: ndarray, F: ndarray, tau: ndarray, h: float, q: ndarray, at: ndarray) -> Pair:
        new_p, new_L, every = np.empty(p.shape), np.empty(p.shape), slice(0, p.shape[1])
        if at is q:
            _shared(numba_loops.kick)(every, p, L, F, tau, h, new_p, new_L)
        else:
            _shared(numba_loops.kick_elsewhere)(every, p, L, F, tau, h, q, at, new_p, new_L)
        return new_p, new_L

    def bathe(
        self, p: ndarray, A: ndarray, L: ndarray, kept: tuple[float, float], kicks: Pair, inverses: Pair
    ) -> tuple[ndarray, ndarray, ndarray]:
        new_p, new_L, gained, every = np.empty(p.shape), np.empty(p.shape), np.empty(p.shape[1]), slice(0, p.shape[1])
        _shared(numba_loops.bathe)(every, p, A, L, *kept, *kicks, *inverses, new_p, new_L, gained)
        return new_p, new_L, gained

    def displace(self, q: ndarray, A: ndarray, F: ndarray, tau: ndarray, shift: float, inverses: Pair) -> Pair:
        new_q, new_A, every = np.empty(q.shape), np.empty(A.shape), slice(0, q.shape[1])
        _shared(numba_loops.displace)(every, q, A, F, tau, shift, *inverses, new_q, new_A)
        return new_q, new_A

    def place(self, sites: Sites, q: ndarray, A: ndarray, positions: ndarray) -> bool:
        return not _shared(numba_loops.place)(sites.part, sites.part.start, q, A, sites.places, sites.atoms, positions)

    def move(self, sites: Sites, p: ndarray, A: ndarray, L: ndarray, inverses: Pair, velocities: ndarray) -> None:
        part, places, atoms = sites.part, sites.places, sites.atoms
        _shared(numba_loops.move)(part, part.start, p, A, L, *inverses, places, atoms, velocities)

    def collect(
        self, sites: Sites, vectors: ndarray, A: ndarray, weights: ndarray, total: ndarray, moment: ndarray
    ) -> bool:
        part, places, atoms = sites.part, sites.places, sites.atoms
        return not _shared(numba_loops.collect)(part, part.start, vectors, A, places, weights, atoms, total, moment)

    def turn_groups(self, edges: ndarray, part: ndarray, m: ndarray, q: ndarray, at: ndarray, F: ndarray) -> None:
        _compiled(numba_loops.turn_groups)(edges, part, m, q, at, F)

    def execute(self, function: Callable[..., Any], *arguments: Any) -> Any:
        return _compiled(function)(*arguments)
