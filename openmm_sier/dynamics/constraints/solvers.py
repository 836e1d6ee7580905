"""The solution of all constraints of a system by the backend in use: stars of each size, then graphs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from numpy import ndarray

from openmm_sier.dynamics import backend
from openmm_sier.dynamics.backend.constraint_tables import Graphs, Stars


class Solver:
    """Writes the columns of constrained bodies into arrays of the whole state.

    Methods that may fail return the columns of the first component that has no solution, or None.
    """

    def __init__(self, stars: Sequence[Stars], graphs: Graphs | None):
        self._stars, self._graphs = stars, () if graphs is None else (graphs,)

    def project(self, q: ndarray, p: ndarray, new_p: ndarray) -> None:
        """Write tangent momenta, (3, n), of all constrained bodies."""
        execute = backend.active()
        for stars in self._stars:
            execute.project_stars(stars, q, p, new_p)
        for graphs in self._graphs:
            execute.project_graphs(graphs, q, p, new_p)

    def displace(self, q: ndarray, force: ndarray, shift: float, new_q: ndarray) -> ndarray | None:
        """Write positions, (3, n), moved by shift M^-1 force and back onto the constraints."""
        execute = backend.active()
        return self._unsolved(execute.displace_stars, execute.displace_graphs, q, force, shift, new_q)

    def drift(
        self, q: ndarray, p: ndarray, times: ndarray, total: float, new_q: ndarray, new_p: ndarray
    ) -> ndarray | None:
        """Write positions and momenta, (3, n), after RATTLE steps of some times with a sum that is not 0."""
        execute = backend.active()
        return self._unsolved(execute.drift_stars, execute.drift_graphs, q, p, times, total, new_q, new_p)

    def _unsolved(
        self, solve_stars: Callable[..., int], solve_graphs: Callable[..., int], *arguments: Any
    ) -> ndarray | None:
        for stars in self._stars:
            if (failed := solve_stars(stars, *arguments)) >= 0:
                return stars.component(failed)
        for graphs in self._graphs:
            if (failed := solve_graphs(graphs, *arguments)) >= 0:
                return graphs.component(failed)
        return None
