"""The costly steps of all bodies executed by NumPy."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy import ndarray

from openmm_sier.dynamics.backend import formulas, long_steps
from openmm_sier.dynamics.backend.elliptic import shortest_series
from openmm_sier.dynamics.backend.short_steps import free_rotation
from openmm_sier.dynamics.backend.sites import Sites

#: Bodies that are rotated at a time, so that temporaries stay in cache.
ROTATED = 4096


#: Two arrays of bodies, of what moves and what turns them: centres and attitudes, momenta and angular momenta, forces
#: and torques, or inverse masses, (n,), and inverse moments, (3, n).
Pair = tuple[ndarray, ndarray]


class Kinds:
    """Hold what turns bodies, kind by kind.

    Attributes:
        rates: inverse moments, descending, of each kind of body, (m, 3), or, of a single kind whose bodies differ,
            (1, 3, n). They are three equal ones for lines, and zeros for points.
        edges: the first body of each kind, and the end of the last one, (m + 1,).
        parts: for each kind its rates, None for points, and its bodies.
    """

    def __init__(self, rates: ndarray, edges: Sequence[int]) -> None:
        self.rates, self.edges = rates, np.array(edges, dtype=np.int64)
        parts = map(slice, edges[:-1], edges[1:])
        self.parts = [(own if own.any() else None, part) for own, part in zip(rates, parts, strict=True)]


class NumpyBackend:
    """Execution of formulas that are written for scalars and for arrays alike."""

    name = "NumPy"

    def drift(
        self, kinds: Kinds, q: ndarray, p: ndarray, A: ndarray, L: ndarray, h: float, inverse_masses: ndarray
    ) -> Pair:
        """Move bodies at q with momenta p, (3, n), freely for a time h; return centres and attitudes (3, 3, n).

        Args and errors: as of `rotate`; inverse masses are (n,).
        """
        return q + (h * inverse_masses) * p, self.rotate(kinds, A, L, h)

    def rotate(self, kinds: Kinds, A: ndarray, L: ndarray, h: float) -> ndarray:
        """Return attitudes (3, 3, n) after the exact free rotation of bodies for a time h.

        Args:
            kinds: their inverse moments.
            A: attitudes, (3, 3, n).
            L: angular momenta, (3, n).
            h: time.

        Raises:
            ValueError: an attitude or angular momentum is not finite.
        """
        new = np.empty(A.shape)
        for rates, part in kinds.parts:
            if rates is None:
                new[:, :, part] = A[:, :, part]
            else:
                self._rotate_kind(rates, part, A, L, h, new)
        return new

    def _rotate_kind(self, rates: ndarray, part: slice, A: ndarray, L: ndarray, h: float, new: ndarray) -> None:
        """Write the new attitudes of the bodies of a slice."""
        for start in range(part.start, part.stop, ROTATED):
            block = slice(start, min(start + ROTATED, part.stop))
            own = rates if rates.ndim == 1 else rates[:, block]
            new[:, :, block] = rotated(own, A[:, :, block], L[:, block], h, range(block.start, block.stop))

    def kick(self, p: ndarray, L: ndarray, F: ndarray, tau: ndarray, h: float, q: ndarray, at: ndarray) -> Pair:
        """Return momenta and angular momenta about q after a time h of forces at other points and torques about these.

        All arrays are (3, n).
        """
        torque = tau if at is q else tau + formulas.cross(at - q, F)
        return p + h * F, L + h * torque

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
        """Return momenta and angular momenta after a bath, and the kinetic energy that each body gained, (n,).

        Args:
            p, L: (3, n).
            A: attitudes, (3, 3, n).
            kept: factors of momenta and of angular momenta.
            widths: standard deviations of what momenta gain, and angular momenta in the principal frames, (6, n).
            noise: standard normal numbers, (6, n).
            inverses: of masses and moments.
        """
        inverse_masses, inverse_moments = inverses
        gains, along = widths * noise, formulas.body_frame(A, L)
        kicks, twists = gains[:3], gains[3:]
        new_p, new_along = kept[0] * p + kicks, kept[1] * along + twists
        new_L = kept[1] * L + formulas.combine(twists, A[0], A[1], A[2])
        gained = (new_p * new_p - p * p).sum(axis=0) * inverse_masses
        gained += ((new_along * new_along - along * along) * inverse_moments).sum(axis=0)
        return new_p, new_L, 0.5 * gained

    def displace(self, q: ndarray, A: ndarray, F: ndarray, tau: ndarray, shift: float, inverses: Pair) -> Pair:
        """Return centres and attitudes of bodies displaced by `shift` times their accelerations.

        Args:
            q, F, tau: centres, forces and torques, (3, n).
            A: attitudes, (3, 3, n).
            shift: half the square of a time.
            inverses: of masses and moments.
        """
        inverse_masses, inverse_moments = inverses
        rows = formulas.displacing_rotation(A[0], A[1], A[2], tau, inverse_moments, shift)
        return q + (shift * inverse_masses) * F, formulas.turned(rows, A)

    def place(self, sites: Sites, q: ndarray, A: ndarray, positions: ndarray) -> bool:
        """Write the positions (N, 3) of the atoms of bodies; returns whether all are finite."""
        with np.errstate(invalid="ignore"):
            for alike in sites.alike:
                for column, arm in alike.arms(A):
                    positions[column] = (q[:, alike.part] + arm).T
        return bool(np.isfinite(q).all() and np.isfinite(A).all())

    def move(self, sites: Sites, p: ndarray, A: ndarray, L: ndarray, inverses: Pair, velocities: ndarray) -> None:
        """Write the velocities (N, 3) of the atoms of bodies with momenta and angular momenta, (3, n)."""
        inverse_masses, inverse_moments = inverses
        for alike in sites.alike:
            part = alike.part
            omega = formulas.angular_velocity(A[:, :, part], L[:, part], inverse_moments[:, part])
            v = p[:, part] * inverse_masses[part]
            for column, arm in alike.arms(A):
                velocities[column] = (v + formulas.cross(omega, arm)).T

    def collect(
        self, sites: Sites, vectors: ndarray, A: ndarray, weights: ndarray, total: ndarray, moment: ndarray
    ) -> bool:
        """Write sums (3, n) over the atoms of weighted vectors (N, 3), and of their moments; whether all are finite.

        The weights are those of `sites.places`, (k,).
        """
        for alike, own in zip(sites.alike, sites.by_set(weights), strict=True):
            sums, moments = np.zeros((2, 3, len(alike.atoms)))
            with np.errstate(invalid="ignore"):
                for weight, (column, arm) in zip(own, alike.arms(A), strict=True):
                    weighted = np.ascontiguousarray(vectors[column].T)
                    weighted *= weight
                    sums += weighted
                    moments += formulas.cross(arm, weighted)
            total[:, alike.part], moment[:, alike.part] = sums, moments
        return bool(np.isfinite(total).all() and np.isfinite(moment).all())

    def turn_groups(self, edges: ndarray, part: ndarray, m: ndarray, q: ndarray, at: ndarray, F: ndarray) -> None:
        """Add forces (3, n) that turn each group of points rigidly, and exert the torques of displaced forces.

        There is no such rotation about a line that the whole group lies on, and the torque of a single point is lost.

        Args:
            edges: where each group begins in `part`, and where the last one ends.
            part: columns of the members, group by group, (k,).
            m: their masses, (k,).
            q, at: the points, and where the forces act, (3, n).
            F: (3, n), changed.
        """
        starts, group = edges[:-1], np.repeat(np.arange(len(edges) - 1), np.diff(edges))
        x, y, z = (row - (np.add.reduceat(m * row, starts) / np.add.reduceat(m, starts))[group] for row in q[:, part])
        products = m * np.array([x * x, y * y, z * z, x * y, y * z, z * x])
        torque = np.add.reduceat(formulas.cross(at[:, part] - q[:, part], F[:, part]), starts, axis=1)
        turns, determinant, half = formulas.spin(np.add.reduceat(products, starts, axis=1), torque)
        line = determinant <= formulas.LINE * half**3
        rates = np.where(line, torque / half, np.array(turns) / np.where(line, 1.0, determinant))
        F[:, part] += m * np.array(formulas.cross(rates[:, group], (x, y, z)))

    def execute(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function of `constraint_solver`."""
        with np.errstate(all="ignore"):
            return function(*arguments)


def rotated(rates: ndarray, A: ndarray, L: ndarray, h: float, numbers: Sequence[int] | ndarray) -> ndarray:
    """Return new attitudes, (3, 3, n), of bodies whose numbers are for messages; rates are (3,) or (3, n)."""
    with np.errstate(all="ignore"):
        body_L = formulas.body_frame(A, L)
        any_angle = long_steps.sine_cosine, long_steps.PHASE_CAP
        turn, _, reached = free_rotation(body_L, rates, h, shortest_series, *any_angle)
    if not reached.all():
        far = np.flatnonzero(~reached)
        for name, values in (("angular momentum", L[None, :, far]), ("attitude", A[:, :, far])):
            finite = np.isfinite(values).all(axis=(0, 1))
            if not finite.all():
                raise ValueError(f"the {name} of body {numbers[far[finite.argmin()]]} is not finite")
        turn = np.stack(turn)
        turn[:, far] = long_steps.turn(body_L[:, far], np.broadcast_to(rates.reshape(3, -1), L.shape)[:, far], h)
    return formulas.turned(formulas.rotation_matrix(*turn), A)
