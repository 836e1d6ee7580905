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


def _rotate_far(kinds: Kinds, A: ndarray, L: ndarray, h: float, far: ndarray, new: ndarray) -> None:
    for rates, part in kinds.parts:
        left = part.start + np.flatnonzero(far[part])
        if rates is not None and left.size:
            new[:, :, left] = rotated(rates, A[:, :, left], L[:, left], h, left)


class NumbaBackend(NumpyBackend):
    """Do what `NumpyBackend` does, compiled. Bodies that turn too far for the series in a step are left to NumPy."""

    name = "Numba"

    def drift(
        self, kinds: Kinds, q: ndarray, p: ndarray, A: ndarray, L: ndarray, h: float, inverse_masses: ndarray
    ) -> Pair:
        new_q, new_A, far, n = np.empty(q.shape), np.empty(A.shape), np.empty(q.shape[1], dtype=bool), q.shape[1]
        rates, edges = kinds.rates, kinds.edges
        if _shared(numba_loops.drift)(n, q, p, A, L, h, edges, rates, inverse_masses, new_q, new_A, far):
            _rotate_far(kinds, A, L, h, far, new_A)
        return new_q, new_A

    def rotate(self, kinds: Kinds, A: ndarray, L: ndarray, h: float) -> ndarray:
        if kinds.rates.ndim > 2:
            return super().rotate(kinds, A, L, h)
        new, far, n = np.empty(A.shape), np.empty(A.shape[2], dtype=bool), A.shape[2]
        if _shared(numba_loops.rotate)(n, A, L, h, kinds.edges, kinds.rates, new, far):
            _rotate_far(kinds, A, L, h, far, new)
        return new

    def kick(self, p: ndarray, L: ndarray, F: ndarray, tau: ndarray, h: float, q: ndarray, at: ndarray) -> Pair:
        new_p, new_L, n = np.empty(p.shape), np.empty(p.shape), p.shape[1]
        if at is q:
            _shared(numba_loops.kick)(n, p, L, F, tau, h, new_p, new_L)
        else:
            _shared(numba_loops.kick_elsewhere)(n, p, L, F, tau, h, q, at, new_p, new_L)
        return new_p, new_L

    def bathe(
        self,
        p: ndarray,
        A: ndarray,
        L: ndarray,
        kept: tuple[float, float],
        widths: ndarray,
        noise: ndarray,
        inverses: Pair,
    ) -> tuple[ndarray, ndarray, ndarray]:
        new_p, new_L, gained, n = np.empty(p.shape), np.empty(p.shape), np.empty(p.shape[1]), p.shape[1]
        _shared(numba_loops.bathe)(n, p, A, L, *kept, widths, noise, *inverses, new_p, new_L, gained)
        return new_p, new_L, gained

    def displace(self, q: ndarray, A: ndarray, F: ndarray, tau: ndarray, shift: float, inverses: Pair) -> Pair:
        new_q, new_A, n = np.empty(q.shape), np.empty(A.shape), q.shape[1]
        _shared(numba_loops.displace)(n, q, A, F, tau, shift, *inverses, new_q, new_A)
        return new_q, new_A

    def place(self, sites: Sites, q: ndarray, A: ndarray, positions: ndarray) -> bool:
        return not _shared(numba_loops.place)(q.shape[1], q, A, sites.sets, sites.places, sites.atoms, positions)

    def move(self, sites: Sites, p: ndarray, A: ndarray, L: ndarray, inverses: Pair, velocities: ndarray) -> None:
        sets, places, atoms = sites.sets, sites.places, sites.atoms
        _shared(numba_loops.move)(p.shape[1], p, A, L, *inverses, sets, places, atoms, velocities)

    def collect(
        self, sites: Sites, vectors: ndarray, A: ndarray, weights: ndarray, total: ndarray, moment: ndarray
    ) -> bool:
        n, sets, places, atoms = total.shape[1], sites.sets, sites.places, sites.atoms
        return not _shared(numba_loops.collect)(n, vectors, A, sets, places, weights, atoms, total, moment)

    def turn_groups(self, edges: ndarray, part: ndarray, m: ndarray, q: ndarray, at: ndarray, F: ndarray) -> None:
        _compiled(numba_loops.turn_groups)(edges, part, m, q, at, F)

    def execute(self, function: Callable[..., Any], *arguments: Any) -> Any:
        return _compiled(function)(*arguments)
