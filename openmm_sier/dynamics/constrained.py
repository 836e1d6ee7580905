"""The operators of a splitting scheme for point bodies with distance constraints, alongside rigid bodies.

The phase space is that of positions on the constraint manifold with momenta tangent to it; `Constraints` has the
algebra. Within a step, momenta that differ only along the bonds represent the same phase point, since a drift removes
that part. They are projected once, after the step. A scheme's operators are those of flat space:

- kick: the flow of the potential alone. Momenta change by h F(q), as for free points.
- drift: the flow of the kinetic energy alone, a geodesic.
- gradient kick: the flow of the modified potential V - (s/2) |P F|^2, with |f|^2 = f M^-1 f.

Let a = M^-1 P F be the constrained acceleration. On a Riemannian manifold the derivative of |grad V|^2 / 2 along a
tangent w is <nabla_w grad V, grad V>, and since the Hessian of a function is symmetric this is <nabla_a grad V, w>. So
the modified force is P F + s nabla_a (P F), with nabla the covariant derivative: P(q) d/ds of the tangent force P F
along any curve on the manifold that starts at q with velocity a. To first order in s this is

    P(q) P(q_s) F(q_s),    q_s: q + s M^-1 F brought back onto the constraints along their gradients at q,

which removes the components of F along them.

Projecting at q_s is essential: P(q) F(q_s) lacks the curvature term P (dP/ds) F, and the scheme falls to second order.
As in flat space the map is reversible, and symplectic up to terms of the order h s^2 = O(h^5) a step.

The algebra of kicks is unchanged too: kicks commute, and T is quadratic in the momenta, so that [V, [V, [V, T]]] = 0.
Schemes have the order that `Scheme.order` derives, provided that the geodesic has this order too.

Forces at displaced points exert a torque about the points before displacement that differs in second order in s from
that about the displaced ones. `DisplacedForces` corrects for this by a rigid rotation of each group of atoms, so that
the total angular momentum is exact.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from openmm_sier.dynamics import kernels, operators
from openmm_sier.dynamics.bodies import BodySet, BodyState
from openmm_sier.dynamics.constraints import Constraints
from openmm_sier.dynamics.indices import as_slice
from openmm_sier.dynamics.operators import Forces, Operator, Rotation, Table, always
from openmm_sier.dynamics.plan import Drift, Inner, Kick, Operation, Project
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.tally import Tally
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck

#: Makes the operator of a drift in a step, ps.
Drifts = Callable[[Drift, float], Operator]


def constrained_operators(
    bodies: BodySet,
    forces: Forces,
    constraints: Constraints,
    rotation: Rotation = exact,
    groups: ArrayLike | None = None,
) -> dict[type[Operation], Any]:
    """Return the table of all schemes without a heat bath, for bodies with constraints between them.

    Args:
        bodies: all bodies; those that are constrained are points.
        forces: forces and torques on them.
        constraints: in the numbering of the bodies.
        rotation: free-rotation map of the rigid bodies.
        groups: of `DisplacedForces`; None: one for each connected component of the constraints.
    """
    return {
        Kick: always(operators.kick(bodies, forces, DisplacedForces(constraints, groups))),
        Drift: constrained_drifts(operators.drift(bodies, rotation), constraints),
        Project: always(projection(constraints)),
    }


def projection(constraints: Constraints) -> Operator:
    """Return an operator that projects momenta onto the tangent space."""
    if not len(constraints.pairs):
        return lambda state: state

    def apply(state: BodyState) -> BodyState:
        p = constraints.project(state.q, state.p)
        return BodyState(state.q, p, state.A, state.L, state.cache)

    return apply


# --- kicks ---


def constrained_bath(bath: Operator, constraints: Constraints, tally: Tally) -> Operator:
    """Return an Ornstein-Uhlenbeck process with projected noise, so that constrained momenta are exactly thermal.

    Let P be the projection, and k_B T M the covariance of the noise. The covariance of the projected noise is
    k_B T P M P^T = k_B T P M, as in the Boltzmann distribution on the tangent space. Old momenta are projected too,
    since the heat is the gain in kinetic energy of the tangent momenta; it corrects the heat that the bath has counted
    in `tally`.
    """
    tangent = projection(constraints)

    def apply(state: BodyState, h: float) -> BodyState:
        warmed = bath(tangent(state), h)
        p = constraints.project(state.q, warmed.p)
        columns = constraints.members
        removed = 0.5 * float(((warmed.p[:, columns] ** 2 - p[:, columns] ** 2) / constraints.masses[columns]).sum())
        tally.heat -= removed
        return BodyState(warmed.q, p, warmed.A, warmed.L, warmed.cache)

    return apply


def bath_operator(bath: OrnsteinUhlenbeck, bodies: BodySet, tally: Tally) -> Operator:
    """Return a bath as an operator on bodies, with or without constraints between them.

    Args:
        bath: the heat bath.
        bodies: all bodies.
        tally: source of random numbers, which counts heat and draws.
    """
    operator, constraints = bath.operator(bodies, tally), bodies.constraints
    return constrained_bath(operator, constraints, tally) if len(constraints.pairs) else operator


class DisplacedForces:
    """Forces at displaced positions, which satisfy all constraints between members of a group of points.

    Where a group lies on a line or is a single point, errors of its torque are of second order in the displacement.

    Attributes:
        without_torque: columns of the bodies that are in a group. Torques act on the others about their centres.
    """

    def __init__(self, constraints: Constraints, groups: ArrayLike | None):
        """
        Args:
            constraints: in the numbering of the bodies.
            groups: number of each point's group, (n,); -1 without a group. None: one group for each connected component
                of the constraints.
        """
        groups = constraints.groups if groups is None else np.asarray(groups)
        numbers, group, size = np.unique(groups, return_inverse=True, return_counts=True)
        columns = np.flatnonzero((numbers[group] >= 0) & (size[group] > 1))
        self._constraints = constraints
        self.without_torque = np.flatnonzero(groups >= 0)
        self._columns = columns[np.argsort(group[columns], kind="stable")]
        starts = np.flatnonzero(np.diff(group[self._columns], prepend=-1))
        self._edges = np.append(starts, len(self._columns))
        self._masses = constraints.masses[self._columns]

    def satisfy(self, q: np.ndarray, F: np.ndarray, shift: float, displaced: np.ndarray) -> None:
        """Bring displaced positions onto the constraints; see `operators.Displacement`.

        Raises:
            ConstraintError: no positions near the displaced ones satisfy the constraints.
        """
        columns = self._constraints.members
        displaced[:, columns] = self._constraints.displaced(q, F, shift)[:, columns]

    def __call__(self, q: np.ndarray, at: np.ndarray, F: np.ndarray) -> np.ndarray:
        """Return the forces, (3, n), of the gradient kick on bodies at q with forces F, from displaced positions.

        They exert the torque of the displaced forces on each group, and must be projected at q.
        """
        F = self._constraints.project(at, F)
        if len(self._columns):
            kernels.constraints.turn_groups(self._edges, self._columns, self._masses, q, at, F)
        return F


# --- drifts ---


def constrained_drifts(drift: Operator, constraints: Constraints) -> Drifts:
    """Return the entry of a table for drifts of all bodies, of which constrained ones follow geodesics.

    The operators raise ConstraintError if momenta are far too large for the time.
    """
    if not len(constraints.pairs):
        return always(drift)

    def operator(operation: Drift, step: float) -> Operator:
        def apply(state: BodyState, h: float) -> BodyState:
            q, p = constraints.drift(state.q, state.p, h, operation.weights)
            free = drift(state, h)
            return BodyState(q, p, free.A, free.L)

        return apply

    return operator


def inner_drifts(drifts: Drifts, members: ArrayLike, within: Table) -> Callable[[Inner, float], Operator]:
    """Return the entry of a table for drifts in which some bodies move under fast forces.

    Rigid bodies among the members turn freely between the fast kicks, as they do between the slow ones elsewhere. The
    fast force at the end of a drift serves the start of the next one, since the cache of the state has the members.

    Args:
        drifts: entry for drifts of all bodies, under the constraints of those that are not members.
        members: columns of the bodies on which fast forces act, (m,), ascending, with all bodies that are constrained
            to one of them.
        within: table of the members alone, under their constraints.
    """
    columns = as_slice(np.asarray(members))

    def start_of(state: BodyState) -> BodyState:
        p, L = state.p[:, columns].copy(), state.L[:, columns].copy()
        last = state.cache.members
        if last is not None:
            return BodyState(last.q, p, last.A, L, last.cache)
        return BodyState(state.q[:, columns].copy(), p, state.A[:, :, columns].copy(), L)

    def operator(operation: Inner, step: float) -> Operator:
        drift = drifts(operation.drift, step)
        inner_step = operators.calls(operation.operations, within, operation.inner_step(step))

        def apply(state: BodyState, h: float) -> BodyState:
            moved = operators.advance(inner_step, start_of(state))
            others = drift(state, h)
            A = others.A.copy() if others.A is state.A else others.A
            end = BodyState(others.q, others.p.copy(), A, others.L.copy())
            end.q[:, columns], end.p[:, columns] = moved.q, moved.p
            end.A[:, :, columns], end.L[:, columns] = moved.A, moved.L
            end.cache.members = moved
            return end

        return apply

    return operator
