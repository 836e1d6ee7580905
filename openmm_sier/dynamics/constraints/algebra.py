"""Distance constraints between point bodies: projections, moves on the constraint manifold, and its geodesics.

The constraints g_c = (|x_i - x_j|^2 - l^2) / 2 = 0 have gradients G whose row c is the bond vector at i and its
negative at j. Momenta are tangent to the manifold where G M^-1 p = 0. The projection

    P p = p - G^T (G M^-1 G^T)^-1 G M^-1 p

is orthogonal in the metric M^-1, and turns a force into the one that acts on the constrained motion. Forces along bonds
are central and act on pairs, so that nothing here changes the total momentum or the total angular momentum.

Geodesics are composed of RATTLE steps (Andersen, J. Comput. Phys. 52, 24 (1983)): the atoms move freely for a time d,
are brought back along the gradients at the start, x' = x + d M^-1 (p + G(x)^T mu), and the momenta p + G(x)^T mu are
projected at the end if needed. This map is symmetric and symplectic, since all equations are solved to rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from openmm_sier.dynamics import kernels
from openmm_sier.dynamics.constraints.graph import couplings, independent, joined
from openmm_sier.dynamics.constraints.table import ConstraintTable
from openmm_sier.dynamics.index_ranges import distinct

#: Maximum number of atoms of a component named in a message.
NAMED = 8


class ConstraintError(ValueError):
    """Constraints that cannot be satisfied."""


class Constraints:
    """Distances held fixed between point bodies, in columns of a state's arrays.

    Attributes:
        pairs: (c, 2), each pair once.
        lengths: (c,), nm.
        masses: of all n bodies, (n,), dalton.
        members: the columns that are constrained, ascending.
        groups: for each column the smallest column of its connected component, -1 if it is not constrained, (n,).
    """

    def __init__(
        self, pairs: ArrayLike, lengths: ArrayLike, masses: ArrayLike, describe: Callable[[int], str] | None = None
    ):
        """
        Args:
            pairs: (c, 2), columns of the state, each pair once.
            lengths: (c,), nm.
            masses: of all bodies, (n,), dalton, positive.
            describe: gives the name of a body in messages.

        Raises:
            ConstraintError: a pair joins a body to itself or occurs twice, or a length is not positive.
        """
        self.masses = np.array(masses, dtype=float)
        self._describe = describe or (lambda body: f"body {body}")
        self.pairs = np.array(pairs, dtype=np.int64).reshape(-1, 2)
        self.lengths = np.array(lengths, dtype=float)
        _, first = np.unique(np.sort(self.pairs, axis=1) @ [len(self.masses), 1], return_index=True)
        is_first = np.zeros(len(self.pairs), dtype=bool)
        is_first[first] = True
        sensible = (self.pairs[:, 0] != self.pairs[:, 1]) & (self.lengths > 0) & (self.lengths < np.inf) & is_first
        if not sensible.all():
            raise ConstraintError(
                f"the constraint of {self._name(*self.pairs[sensible.argmin()])} joins a body to itself, is there "
                f"twice, or has no positive length, got {self.lengths[sensible.argmin()]} nm: remove it, or set its "
                "length"
            )
        self.members = distinct(self.pairs)
        self.groups = np.full(len(self.masses), -1)
        self._first = joined(len(self.masses), self.pairs)[self.members]
        self.groups[self.members] = self._first

    def _name(self, *bodies: int) -> str:
        named = ", ".join(self._describe(int(body)) for body in bodies[:NAMED])
        return named if len(bodies) <= NAMED else f"{named} and {len(bodies) - NAMED} more"

    @cached_property
    def _table(self) -> ConstraintTable:
        """Constraints in the form used by kernels."""
        pairs, masses = np.searchsorted(self.members, self.pairs), self.masses[self.members]
        rows, columns, weights = couplings(pairs, 1 / masses)
        ends = np.ascontiguousarray(pairs.T)
        squares = self.lengths**2
        largest = int(np.bincount(self.groups[self.pairs[:, 0]]).max(initial=0))
        return ConstraintTable(self.members, self._first, ends, squares, 1 / masses, rows, columns, weights, largest)

    def restricted(self, bodies: ArrayLike) -> Constraints:
        """Return the constraints in the numbering of a subset of the bodies, which must not split a component.

        Args:
            bodies: ascending columns of this state, (m,), that become the columns 0 .. m-1.

        Raises:
            ConstraintError: a constraint joins a body of the subset to another.
        """
        bodies = np.asarray(bodies)
        number = np.full(len(self.masses), -1)
        number[bodies] = np.arange(len(bodies))
        ends = number[self.pairs]
        cut = np.flatnonzero((ends < 0).any(axis=1) & (ends >= 0).any(axis=1))
        if len(cut):
            raise ConstraintError(
                f"the constraint of {self._name(*self.pairs[cut[0]])} joins the subset to another body"
            )
        is_inside = (ends >= 0).all(axis=1)
        return Constraints(
            ends[is_inside],
            self.lengths[is_inside],
            self.masses[bodies],
            lambda body: self._describe(int(bodies[body])),
        )

    def without(self, bodies: ArrayLike) -> Constraints:
        """Return the constraints, in the same numbering, except those of a set of bodies, which splits no component."""
        kept = ~np.isin(self.pairs, bodies).any(axis=1)
        return Constraints(self.pairs[kept], self.lengths[kept], self.masses, self._describe)

    # --- degrees of freedom ---

    def rank(self, q: np.ndarray | None = None) -> int:
        """Return the number of independent constraints, each of which removes one degree of freedom.

        Args:
            q: positions, (3, n); None gives the rank at almost all positions.

        Raises:
            ConstraintError: the rank at q is smaller, as for a cage in a plane or three constrained atoms on a line.
                Constrained motion is undefined there. The message names the atoms.
        """
        if not len(self.pairs):
            return 0
        generic = self._ranks(np.random.default_rng(1).normal(size=(3, len(self.masses))))
        if q is not None and len(lower := np.flatnonzero(self._ranks(q) < generic)):
            raise ConstraintError(
                f"the constraints of {self._name(*np.flatnonzero(self.groups == lower[0]))} do not determine how "
                "these atoms move, since the atoms are in a plane or on a line. Put them into one rigid body, or "
                "remove constraints and make some of the atoms virtual sites"
            )
        return int(generic.sum())

    def _ranks(self, q: np.ndarray) -> np.ndarray:
        """Return the rank of the component that begins with each column, (n,), at positions (3, n)."""
        return np.bincount(self.groups[self.pairs[:, 0]], independent(self._table, q), len(self.masses))

    # --- the algebra ---

    # Arrays are made contiguous, since Numba would compile everything once more for another layout.

    def project(self, q: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Return momenta or forces, (3, n), tangent to the constraints at q; those of free bodies do not change."""
        q, p = np.ascontiguousarray(q), np.ascontiguousarray(p)
        new_p = p.copy()
        if len(self.pairs):
            kernels.constraints.project(self._table, q, p, new_p)
        return new_p

    def displaced(self, q: np.ndarray, force: np.ndarray, shift: float) -> np.ndarray:
        """Move positions (3, n) by shift M^-1 force, and constrained bodies back along the gradients at q.

        Raises:
            ConstraintError: there are no such positions.
        """
        q, push = np.ascontiguousarray(q), shift * np.ascontiguousarray(force)
        new_q = q + push / self.masses
        if len(self.pairs):
            self._refuse(kernels.constraints.displace(self._table, q, push, new_q))
        return new_q

    def satisfied(self, q: np.ndarray) -> np.ndarray:
        """Return positions (3, n) near q that satisfy the constraints to rounding.

        Raises:
            ConstraintError: there are none, since the constraints contradict each other, or q is far from them.
        """
        return self.displaced(q, np.zeros_like(q), 0.0)

    def drift(
        self, q: np.ndarray, p: np.ndarray, t: float, fractions: Sequence[float] = (1.0,)
    ) -> tuple[np.ndarray, np.ndarray]:
        """Move bodies freely for the time t: along straight lines, and along geodesics if constrained.

        Args:
            q, p: (3, n); q satisfies the constraints. The components of p along the bonds have no effect.
            t: ps, of either sign.
            fractions: of t for each RATTLE step, with the sum 1; see `openmm_sier.dynamics.constraints.geodesic`.

        Returns:
            (q, p), new arrays; p is not projected, see `project`.

        Raises:
            ConstraintError: a RATTLE step has no solution nearby: momenta are far too large for t.
        """
        q, p = np.ascontiguousarray(q), np.ascontiguousarray(p)
        new_q, new_p = q + (t / self.masses) * p, p.copy()
        if t != 0 and len(self.pairs):
            times = t * np.asarray(fractions, dtype=float)
            self._refuse(kernels.constraints.drift(self._table, q, p, times, new_q, new_p))
        return new_q, new_p

    def _refuse(self, failed: int) -> None:
        """Raise an error for a constraint without a solution; -1 means none."""
        if failed >= 0:
            bodies = np.flatnonzero(self.groups == self.groups[self.pairs[failed, 0]])
            raise ConstraintError(
                f"the constraints of {self._name(*bodies)} cannot be satisfied: their solution does not converge. "
                "Atoms are far from their places (do they overlap? minimize first), move too fast for the step (a long "
                "straight chain needs a shorter one), or the constraints contradict each other"
            )
