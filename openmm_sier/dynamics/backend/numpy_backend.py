"""The steps of all bodies executed by NumPy.

With small sets of bodies the number of calls determines the cost, so that few calls are made: sites are sums of
principal axes, and only products with small constant matrices depend on the number of sites.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy import ndarray

from openmm_sier.dynamics.backend import graph_arrays, star_loops
from openmm_sier.dynamics.backend.constraint_tables import Graphs, Stars
from openmm_sier.dynamics.backend.formulas import (
    LINE,
    angular_velocity,
    body_frame,
    combine,
    cross,
    displacing_rotation,
    rotation_matrix,
    spin,
)
from openmm_sier.dynamics.backend.sites import Sites
from openmm_sier.dynamics.backend.top import Top

#: Bodies that are rotated at a time, so that temporaries stay in cache.
ROTATED = 4096

#: Bodies whose sites are handled at a time, few enough that no linear algebra library starts threads.
PLACED = 2048


@dataclass(frozen=True, eq=False)
class Rotor:
    """A free-rotation map as backends execute it.

    Each function takes L~ in the frame of descending rates (inverse moments), these rates, and a time. It gives the
    quaternion of the body frame's rotation; the first two also tell whether it is right.

    Attributes:
        of_body: elementwise and without branches, compiled for one body.
        of_arrays: the same for arrays of bodies.
        beyond: for arrays of the bodies that the others cannot handle.
    """

    of_body: Callable
    of_arrays: Callable
    beyond: Callable


class NumpyBackend:
    """The operations on all bodies, which return new arrays unless stated otherwise.

    Centres q, momenta p, angular momenta L, forces F and torques tau are (3, n), attitudes A (3, 3, n), inverse masses
    (n,), inverse moments (3, n).
    """

    name = "NumPy"

    # --- free motion ---

    def rotate(self, rotor: Rotor, top: Top, A: ndarray, L: ndarray, h: float) -> ndarray:
        """Attitudes after a free rotation.

        Raises:
            ValueError: an attitude or angular momentum is not finite.
        """
        new = np.empty(A.shape)
        self._rotate(rotor, top, A, L, h, new, range(A.shape[2]))
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
        """Centres and attitudes after free motion; `kinds` says which bodies have which moments.

        Raises:
            ValueError: an attitude or angular momentum is not finite.
        """
        new = np.empty(A.shape)
        for top, part in kinds:
            self._rotate(rotor, top, A[:, :, part], L[:, part], h, new[:, :, part], range(part.start, part.stop))
        return q + (h * inverse_masses) * p, new

    def _rotate(
        self, rotor: Rotor, top: Top, A: ndarray, L: ndarray, h: float, new: ndarray, numbers: Sequence[int]
    ) -> None:
        """Write new attitudes; the numbers of the bodies are for messages."""
        if not top.turns:
            new[:] = A
            return
        for start in range(0, A.shape[2], ROTATED):
            block = slice(start, start + ROTATED)
            turned = _rotated(rotor, top.part(block), A[:, :, block], L[:, block], h, numbers[block])
            for i, row in enumerate(turned):
                new[i, :, block] = row

    # --- kicks ---

    def kick(self, p: ndarray, L: ndarray, F: ndarray, tau: ndarray, h: float) -> tuple[ndarray, ndarray]:
        """Momenta and angular momenta after forces and torques have acted for a time."""
        return p + h * F, L + h * tau

    def kick_from(
        self, p: ndarray, L: ndarray, F: ndarray, tau: ndarray, arm: ndarray, h: float
    ) -> tuple[ndarray, ndarray]:
        """The same by forces that act at a distance `arm`, (3, n), from the centres."""
        return p + h * F, L + h * (tau + np.stack(cross(arm, F)))

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
        """Centres and attitudes of bodies displaced by `shift` times their accelerations."""
        x, y, z = A
        rows = displacing_rotation(x, y, z, tau, inverse_moments, shift)
        return q + (shift * inverse_masses) * F, np.stack([combine(row, x, y, z) for row in rows])

    def turn_groups(self, edges: ndarray, part: ndarray, m: ndarray, q: ndarray, torques: ndarray, F: ndarray) -> None:
        """Add to forces, (3, n), those that turn groups of points rigidly and exert the torques of their members.

        Args:
            edges: of the groups in `part`, (g + 1,).
            part: columns of the points, (m,), group by group.
            m: their masses, (m,).
            q: positions, (3, n).
            torques: (3, n).
            F: forces, (3, n), changed.
        """
        starts, group = edges[:-1], np.repeat(np.arange(len(edges) - 1), np.diff(edges))
        x, y, z = (row - (np.add.reduceat(m * row, starts) / np.add.reduceat(m, starts))[group] for row in q[:, part])
        products = m * np.array([x * x, y * y, z * z, x * y, y * z, z * x])
        torque = np.add.reduceat(torques[:, part], starts, axis=1)
        turned, determinant, half = spin(np.add.reduceat(products, starts, axis=1), torque)
        line = determinant <= LINE * half**3
        rates = np.where(line, torque / half, np.array(turned) / np.where(line, 1.0, determinant))
        F[:, part] += m * np.array(cross(rates[:, group], (x, y, z)))

    # --- atoms ---

    def place(self, kinds: Sequence[Sites], q: ndarray, A: ndarray, positions: ndarray) -> bool:
        """Write the positions (N, 3) of atoms; returns whether they are finite."""
        for sites in kinds:
            for block, columns in _blocks(sites):
                for column, arm in zip(columns, _products(sites.places.T, A[:, :, block]), strict=True):
                    positions[column] = (q[:, block] + arm).T
        return _finite(q)

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
        """Write the velocities (N, 3) of atoms."""
        v, omega = p * inverse_masses, angular_velocity(A, L, inverse_moments)
        for sites in kinds:
            for block, columns in _blocks(sites):
                for column, arm in zip(columns, _products(sites.places.T, A[:, :, block]), strict=True):
                    velocities[column] = (v[:, block] + np.stack(cross(omega[:, block], arm))).T

    def collect(
        self, kinds: Sequence[Sites], vectors: ndarray, A: ndarray, weights: Sequence[ndarray]
    ) -> tuple[ndarray, ndarray, bool]:
        """Sums (3, n) over atoms of weighted vectors (N, 3), sums of their moments, and whether these are finite.

        The weights are those of the sites of each kind. With sites r = sum_a s_a A_a the moment sum_j r_j x f_j is
        sum_a A_a x M_a, M_a = sum_j s_aj f_j.
        """
        total, moment = np.empty((3, A.shape[2])), np.zeros((3, A.shape[2]))
        for sites, weight in zip(kinds, weights, strict=True):
            axes, coordinates = sites.extents
            factors = weight * coordinates
            for block, columns in _blocks(sites):
                on_sites = np.empty((len(columns), *total[:, block].shape))
                for values, column in zip(on_sites, columns, strict=True):
                    values[:] = vectors[column].T
                sums = _products(factors, on_sites)
                total[:, block] = sums[0]
                if axes:
                    # outer[x, y] = sum_a A_ax M_ay
                    outer = sum(A[axis][:, None, block] * M for axis, M in zip(axes, sums[1:], strict=True))
                    for x, y, z in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
                        np.subtract(outer[y, z], outer[z, y], out=moment[x, block])
        return total, moment, _finite(total) and _finite(moment)

    # --- constraints ---

    def project_stars(self, stars: Stars, q: ndarray, p: ndarray, new_p: ndarray) -> None:
        """Write the momenta, or forces, (3, n), of stars without what acts along their bonds."""
        star_loops.project_star(q, p, stars, star_loops.scratch_of_all(*stars.leaves.shape), new_p)

    def displace_stars(self, stars: Stars, q: ndarray, force: ndarray, shift: float, new_q: ndarray) -> int:
        """Write positions (3, n) moved by shift M^-1 force and put back along the bonds at q.

        Returns:
            The first star that has none, or -1.
        """
        scratch = star_loops.scratch_of_all(*stars.leaves.shape)
        with np.errstate(all="ignore"):
            if star_loops.displace_star(q, force, shift, stars, scratch, new_q):
                return -1
            return star_loops.displace_stars(q, force, shift, *stars, new_q)

    def drift_stars(
        self, stars: Stars, q: ndarray, p: ndarray, times: ndarray, total: float, new_q: ndarray, new_p: ndarray
    ) -> int:
        """Write positions and momenta (3, n) after RATTLE steps of some times with a sum that is not 0.

        Returns:
            The first star without a solution, or -1.
        """
        scratch = star_loops.scratch_of_all(*stars.leaves.shape)
        with np.errstate(all="ignore"):
            if star_loops.drift_star(q, p, times, total, stars, scratch, new_q, new_p):
                return -1
            return star_loops.drift_stars(q, p, times, total, *stars, new_q, new_p)

    def project_graphs(self, graphs: Graphs, q: ndarray, p: ndarray, new_p: ndarray) -> None:
        """As `project_stars`, for all other components of the constraints."""
        x, v = graph_arrays.taken(graphs, q, p)
        graph_arrays.put_momenta(graphs, p, graph_arrays.project(graphs, x, v), new_p)

    def displace_graphs(self, graphs: Graphs, q: ndarray, force: ndarray, shift: float, new_q: ndarray) -> int:
        """As `displace_stars`, for all other components."""
        x, v = graph_arrays.taken(graphs, q, force)
        with np.errstate(all="ignore"):
            x, _, failed = graph_arrays.constrain(graphs, x, shift * v, 1.0)
        graph_arrays.put_positions(graphs, q, x, new_q)
        return failed

    def drift_graphs(
        self, graphs: Graphs, q: ndarray, p: ndarray, times: ndarray, total: float, new_q: ndarray, new_p: ndarray
    ) -> int:
        """As `drift_stars`, for all other components."""
        x, v = graph_arrays.taken(graphs, q, p)
        with np.errstate(all="ignore"):
            for d in times:
                x, v, failed = graph_arrays.constrain(graphs, x, v, d)
                if failed >= 0:
                    return failed
        graph_arrays.put_positions(graphs, q, x, new_q)
        graph_arrays.put_momenta(graphs, p, graph_arrays.project(graphs, x, v), new_p)
        return -1


def _rotated(rotor: Rotor, top: Top, A: ndarray, L: ndarray, h: float, numbers: Sequence[int]) -> list[ndarray]:
    """Rows of the new attitudes, each (3, n)."""
    with np.errstate(all="ignore"):
        body_L = top.sort(body_frame(A, L))
        turn, reached = rotor.of_arrays(body_L, top.rates, h)
    if not reached.all():
        far = np.flatnonzero(~reached)
        for name, values in (("angular momentum", L[None, :, far]), ("attitude", A[:, :, far])):
            finite = np.isfinite(values).all(axis=(0, 1))
            if not finite.all():
                raise ValueError(f"the {name} of body {numbers[far[finite.argmin()]]} is not finite")
        rates = np.broadcast_to(top.rates.reshape(3, -1), L.shape)[:, far]
        turn = np.stack(turn)
        turn[:, far] = rotor.beyond(np.stack(body_L)[:, far], rates, h)
    rows = rotation_matrix(turn[0], *top.unsort(*turn[1:]))
    return [combine(row, A[0], A[1], A[2]) for row in rows]


def _finite(vectors: ndarray) -> bool:
    """Whether all components (3, n) are finite, as their sum shows if it does not overflow; einsum does not warn."""
    return math.isfinite(np.einsum("ij->", vectors)) or bool(np.isfinite(vectors).all())


def _products(factors: ndarray, vectors: ndarray) -> ndarray:
    """Sums of vectors (k, 3, n) with factors (j, k), as (j, 3, n)."""
    return (factors @ vectors.reshape(vectors.shape[0], -1)).reshape(-1, *vectors.shape[1:])


def _blocks(sites: Sites) -> Iterator[tuple[slice, list]]:
    """Slices of bodies, and for each site what picks their atoms out of an array of particles."""
    part, n = sites.part, sites.atoms.shape[0]
    if n <= PLACED:
        yield part, sites.columns
        return
    for start in range(0, n, PLACED):
        stop = min(start + PLACED, n)
        columns = [_part(column, slice(start, stop)) for column in sites.columns]
        yield slice(part.start + start, part.start + stop), columns


def _part(column: slice | ndarray, block: slice) -> slice | ndarray:
    """What picks the atoms of some of the bodies."""
    if isinstance(column, slice):
        step = column.step or 1
        return slice(column.start + step * block.start, column.start + step * (block.stop - 1) + 1, step)
    return column[block]
