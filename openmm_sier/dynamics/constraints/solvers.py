"""The two ways to solve constraints: by loops that Numba compiles, and by NumPy.

Both write into arrays of the whole state, and return the columns of the first component that they could not solve, or
None.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np

from openmm_sier.dynamics.backend import constraint_loops, star_loops
from openmm_sier.dynamics.backend.graph_arrays import GraphArrays
from openmm_sier.dynamics.backend.graph_loops import GRAPH_CLOSE
from openmm_sier.dynamics.constraints.graph import Graphs, Stars


class NumbaSolver:
    """Compiled loops: Newton's iteration for each star, sparse elimination for graphs."""

    def __init__(self, stars: Sequence[Stars], graphs: Graphs | None):
        self._stars, self._graphs = stars, graphs

    def project(self, q: np.ndarray, p: np.ndarray, new_p: np.ndarray) -> None:
        """Write tangent momenta, (3, n), of all constrained bodies."""
        for stars in self._stars:
            _compiled(stars).project_stars(q, p, *stars, new_p)
        if (graphs := self._graphs) is not None:
            loops = constraint_loops.compiled_graphs()
            loops.project_graphs(q, p, graphs.atoms, graphs.starts, graphs.tables, new_p)

    def displace(self, q: np.ndarray, force: np.ndarray, shift: float, new_q: np.ndarray) -> np.ndarray | None:
        """Write positions, (3, n), moved by shift M^-1 force and back onto the constraints."""
        for stars in self._stars:
            failed = _compiled(stars).displace_stars(q, force, shift, *stars, new_q)
            if failed >= 0:
                return _columns(stars, failed)
        if (graphs := self._graphs) is None:
            return None
        loops = constraint_loops.compiled_graphs()
        failed = loops.displace_graphs(q, force, shift, graphs.atoms, graphs.starts, graphs.tables, new_q)
        return graphs.component(failed) if failed >= 0 else None

    def drift(
        self, q: np.ndarray, p: np.ndarray, times: np.ndarray, total: float, new_q: np.ndarray, new_p: np.ndarray
    ) -> np.ndarray | None:
        """Write positions and momenta, (3, n), after RATTLE steps of some times with a sum that is not 0."""
        for stars in self._stars:
            failed = _compiled(stars).drift_stars(q, p, times, total, *stars, new_q, new_p)
            if failed >= 0:
                return _columns(stars, failed)
        if (graphs := self._graphs) is None:
            return None
        loops = constraint_loops.compiled_graphs()
        failed = loops.drift_graphs(q, p, times, graphs.atoms, graphs.starts, graphs.tables, new_q, new_p)
        return graphs.component(failed) if failed >= 0 else None


class NumpySolver:
    """NumPy: all stars of one size at once, and conjugate gradients for all graphs at once.

    It has the methods of `NumbaSolver`.
    """

    def __init__(self, stars: Sequence[Stars], graphs: Graphs | None):
        self._stars, self._graphs = stars, graphs
        if graphs is not None:
            self._arrays = GraphArrays(graphs.ends, graphs.squares, graphs.inverse_masses)
            low, high = graphs.starts[:, 0], graphs.starts[:, 1]
            # Positions are relative to the first atom of each component.
            self._firsts = np.repeat(graphs.atoms[low], high - low)

    def project(self, q: np.ndarray, p: np.ndarray, new_p: np.ndarray) -> None:
        for stars in self._stars:
            star_loops.project_star(q, p, stars, _scratch(stars), new_p)
        if self._graphs is not None:
            x, v = self._taken(self._graphs, q, p)
            _put_momenta(self._graphs, p, self._arrays.project(x, v), new_p)

    def displace(self, q: np.ndarray, force: np.ndarray, shift: float, new_q: np.ndarray) -> np.ndarray | None:
        with np.errstate(all="ignore"):
            for stars in self._stars:
                if not star_loops.displace_star(q, force, shift, stars, _scratch(stars), new_q):
                    return _columns(stars, star_loops.displace_stars(q, force, shift, *stars, new_q))
            if (graphs := self._graphs) is None:
                return None
            x, v = self._taken(graphs, q, force)
            x, _, residuals = self._arrays.constrain(x, shift * v, 1.0)
        new_q[:, graphs.atoms] = q[:, self._firsts] + x
        return _unsolved(graphs, residuals)

    def drift(
        self, q: np.ndarray, p: np.ndarray, times: np.ndarray, total: float, new_q: np.ndarray, new_p: np.ndarray
    ) -> np.ndarray | None:
        with np.errstate(all="ignore"):
            for stars in self._stars:
                if not star_loops.drift_star(q, p, times, total, stars, _scratch(stars), new_q, new_p):
                    return _columns(stars, star_loops.drift_stars(q, p, times, total, *stars, new_q, new_p))
            if (graphs := self._graphs) is None:
                return None
            x, v = self._taken(graphs, q, p)
            for d in times:
                x, v, residuals = self._arrays.constrain(x, v, d)
                if (failed := _unsolved(graphs, residuals)) is not None:
                    return failed
        new_q[:, graphs.atoms] = q[:, self._firsts] + x
        _put_momenta(graphs, p, self._arrays.project(x, v), new_p)
        return None

    def _taken(self, graphs: Graphs, q: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return q[:, graphs.atoms] - q[:, self._firsts], p[:, graphs.atoms] * graphs.inverse_masses


def _compiled(stars: Stars) -> SimpleNamespace:
    return constraint_loops.compiled_stars(len(stars.leaves))


def _columns(stars: Stars, number: int) -> np.ndarray:
    return np.array([stars.centres[number], *stars.leaves[:, number]])


def _scratch(stars: Stars) -> tuple[np.ndarray, ...]:
    """Arrays to work in for all stars at once, as `star_loops.scratch_of` makes for one."""
    k, m = stars.leaves.shape
    vectors, numbers = np.empty((3, k, 3, m)), np.empty((3, k, m))
    return (*vectors, *numbers, np.empty((k, k, m)))


def _unsolved(graphs: Graphs, residuals: np.ndarray) -> np.ndarray | None:
    worst = int(residuals.argmax())
    if residuals[worst] < GRAPH_CLOSE:
        return None
    return graphs.component(int(np.searchsorted(graphs.starts[:, 3], worst, side="right")))


def _put_momenta(graphs: Graphs, p: np.ndarray, v: np.ndarray, new_p: np.ndarray) -> None:
    """Write momenta; the first atom of each component takes the remainder, which conserves the total to rounding."""
    new = v / graphs.inverse_masses
    low = graphs.starts[:, 0]
    new[:, low] += np.add.reduceat(p[:, graphs.atoms] - new, low, axis=1)
    new_p[:, graphs.atoms] = new
