"""The steps of all bodies in loops that Numba compiles and threads share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy import ndarray

from openmm_sier.dynamics.backend import graph_loops, numba_loops, star_loops
from openmm_sier.dynamics.backend.constraint_tables import Graphs, Stars
from openmm_sier.dynamics.backend.numba_compile import compiled
from openmm_sier.dynamics.backend.numpy_backend import NumpyBackend, Rotor
from openmm_sier.dynamics.backend.sites import Sites
from openmm_sier.dynamics.backend.threads import shared
from openmm_sier.dynamics.backend.top import Top


@cache
def _loop(name: str, rotor: Rotor | None = None) -> Callable[..., Any]:
    """A loop of `numba_loops`, compiled; one that rotates calls the formulas of a rotor."""
    replaced = {} if rotor is None else {numba_loops.rotate_body: rotor.of_body}
    return shared(compiled(getattr(numba_loops, name), replaced))


@cache
def _star_loop(name: str, leaves: int) -> Callable[..., Any]:
    return compiled(getattr(star_loops, name), star_loops.compiled_for(leaves))


@cache
def _graph_loop(name: str) -> Callable[..., Any]:
    return compiled(getattr(graph_loops, name), {})


def _all(vectors: ndarray) -> slice:
    return slice(0, vectors.shape[1])


class NumbaBackend(NumpyBackend):
    """What `NumpyBackend` does, in compiled loops. Bodies that a rotor's formula cannot handle are left to NumPy."""

    name = "Numba"

    def rotate(self, rotor: Rotor, top: Top, A: ndarray, L: ndarray, h: float) -> ndarray:
        if not (top.shared and top.turns):
            return super().rotate(rotor, top, A, L, h)
        new, far = np.empty(A.shape), np.empty(A.shape[2], dtype=bool)
        if _loop("rotate", rotor)(_all(L), A, L, h, top.frame, new, far):
            self._rotate_far(rotor, top, _all(L), A, L, h, new, far)
        return new

    def drift(
        self,
        rotor: Rotor,
        kinds: Sequence[tuple[Top, slice]],
        q: ndarray,
        p: ndarray,
        A: ndarray,
        L: ndarray,
        h: float,
        inverse_masses: ndarray,
    ) -> tuple[ndarray, ndarray]:
        new_q, new_A, far = np.empty(q.shape), np.empty(A.shape), np.empty(q.shape[1], dtype=bool)
        loop = _loop("drift", rotor)
        for top, part in kinds:
            if loop(part, q, p, A, L, h, inverse_masses, top.frame, new_q, new_A, far):
                self._rotate_far(rotor, top, part, A, L, h, new_A, far)
        return new_q, new_A

    def _rotate_far(
        self, rotor: Rotor, top: Top, part: slice, A: ndarray, L: ndarray, h: float, new: ndarray, far: ndarray
    ) -> None:
        """Write the new attitudes of the bodies of a slice that the loop left aside."""
        left = part.start + np.flatnonzero(far[part])
        turned = np.empty((3, 3, left.size))
        self._rotate(rotor, top, A[:, :, left], L[:, left], h, turned, left)
        new[:, :, left] = turned

    def kick(self, p: ndarray, L: ndarray, F: ndarray, tau: ndarray, h: float) -> tuple[ndarray, ndarray]:
        new_p, new_L = np.empty(p.shape), np.empty(p.shape)
        _loop("kick")(_all(p), p, L, F, tau, h, new_p, new_L)
        return new_p, new_L

    def kick_from(
        self, p: ndarray, L: ndarray, F: ndarray, tau: ndarray, arm: ndarray, h: float
    ) -> tuple[ndarray, ndarray]:
        new_p, new_L = np.empty(p.shape), np.empty(p.shape)
        _loop("kick_from")(_all(p), p, L, F, tau, arm, h, new_p, new_L)
        return new_p, new_L

    def displace(
        self,
        q: ndarray,
        A: ndarray,
        F: ndarray,
        tau: ndarray,
        shift: float,
        inverse_masses: ndarray,
        inverse_moments: ndarray,
    ) -> tuple[ndarray, ndarray]:
        new_q, new_A = np.empty(q.shape), np.empty(A.shape)
        _loop("displace")(_all(q), q, A, F, tau, shift, inverse_masses, inverse_moments, new_q, new_A)
        return new_q, new_A

    def turn_groups(self, edges: ndarray, part: ndarray, m: ndarray, q: ndarray, torques: ndarray, F: ndarray) -> None:
        _loop("turn_groups")(slice(0, len(edges) - 1), edges, part, m, q, torques, F)

    def place(self, kinds: Sequence[Sites], q: ndarray, A: ndarray, positions: ndarray) -> bool:
        loop = _loop("place")
        return not sum(loop(s.part, s.part.start, q, A, s.places, s.atoms, positions) for s in kinds)

    def move(
        self,
        kinds: Sequence[Sites],
        p: ndarray,
        A: ndarray,
        L: ndarray,
        inverse_masses: ndarray,
        inverse_moments: ndarray,
        velocities: ndarray,
    ) -> None:
        loop, bodies = _loop("move"), (p, A, L, inverse_masses, inverse_moments)
        for s in kinds:
            loop(s.part, s.part.start, *bodies, s.places, s.atoms, velocities)

    def collect(
        self, kinds: Sequence[Sites], vectors: ndarray, A: ndarray, weights: Sequence[ndarray]
    ) -> tuple[ndarray, ndarray, bool]:
        total, moment = np.empty((3, A.shape[2])), np.empty((3, A.shape[2]))
        loop, broken = _loop("collect"), 0
        for s, weight in zip(kinds, weights, strict=True):
            broken += loop(s.part, s.part.start, vectors, A, s.places, weight, s.atoms, total, moment)
        return total, moment, not broken

    def project_stars(self, stars: Stars, q: ndarray, p: ndarray, new_p: ndarray) -> None:
        _star_loop("project_stars", len(stars.leaves))(q, p, *stars, new_p)

    def displace_stars(self, stars: Stars, q: ndarray, force: ndarray, shift: float, new_q: ndarray) -> int:
        return _star_loop("displace_stars", len(stars.leaves))(q, force, shift, *stars, new_q)

    def drift_stars(
        self, stars: Stars, q: ndarray, p: ndarray, times: ndarray, total: float, new_q: ndarray, new_p: ndarray
    ) -> int:
        return _star_loop("drift_stars", len(stars.leaves))(q, p, times, total, *stars, new_q, new_p)

    def project_graphs(self, graphs: Graphs, q: ndarray, p: ndarray, new_p: ndarray) -> None:
        _graph_loop("project_graphs")(q, p, *graphs.compiled_arguments, new_p)

    def displace_graphs(self, graphs: Graphs, q: ndarray, force: ndarray, shift: float, new_q: ndarray) -> int:
        return _graph_loop("displace_graphs")(q, force, shift, *graphs.compiled_arguments, new_q)

    def drift_graphs(
        self, graphs: Graphs, q: ndarray, p: ndarray, times: ndarray, total: float, new_q: ndarray, new_p: ndarray
    ) -> int:
        return _graph_loop("drift_graphs")(q, p, times, *graphs.compiled_arguments, new_q, new_p)
