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

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial

import numpy as np
from numpy.typing import ArrayLike

from openmm_sier.dynamics import kernels, operators
from openmm_sier.dynamics.bodies import BodySet, BodyState
from openmm_sier.dynamics.constraints import Constraints
from openmm_sier.dynamics.constraints.geodesic import SUZUKI
from openmm_sier.dynamics.operators import AFTER_STEP, CachedForces, Operator, Rotation
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.stages import DRIFT, DRIFT_FROM_BATH, DRIFT_TO_BATH, GRADIENT_KICK, KICK
from openmm_sier.dynamics.tally import Tally
from openmm_sier.dynamics.thermostat import Thermostat


def constrained_operators(
    bodies: BodySet,
    forces: CachedForces,
    constraints: Constraints,
    rotation: Rotation = exact,
    groups: ArrayLike | None = None,
    composition: Sequence[float] = SUZUKI,
) -> dict[str, Operator]:
    """Return the operators of all schemes without a heat bath, for bodies with constraints between them.

    Args:
        bodies: all bodies; those that are constrained are points.
        forces: forces and torques on them.
        constraints: in the numbering of the bodies.
        rotation: free-rotation map of the rigid bodies.
        groups: of `DisplacedForces`; None: one for each connected component of the constraints.
        composition: RATTLE steps as fractions of a drift, see `constraints.geodesic`.
    """
    drift = constrained_drift(operators.drift(bodies, rotation), constraints, composition)
    return {
        KICK: operators.kick(bodies, forces),
        GRADIENT_KICK: constrained_gradient_kick(bodies, forces, constraints, groups),
        **operators.drifts(drift),
        AFTER_STEP: projection(constraints),
    }


def projection(constraints: Constraints) -> Operator:
    """Return an operator that projects momenta onto the tangent space."""
    if not len(constraints.pairs):
        return lambda state: state

    def apply(state: BodyState) -> BodyState:
        p = constraints.project(state.q, state.p)
        return BodyState(state.q, p, state.A, state.L)

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
        return replace(warmed, p=p)

    return apply


def bath_operator(bath: Thermostat, bodies: BodySet, tally: Tally) -> Operator:
    """Return a bath as an operator on bodies, with or without constraints between them.

    Args:
        bath: the heat bath.
        bodies: all bodies.
        tally: source of random numbers, which counts heat and draws.
    """
    operator, constraints = bath.operator(bodies, tally), bodies.constraints
    return constrained_bath(operator, constraints, tally) if len(constraints.pairs) else operator


def constrained_gradient_kick(
    bodies: BodySet, forces: CachedForces, constraints: Constraints, groups: ArrayLike | None = None
) -> Operator:
    """Return the gradient kick of bodies with constraints; see the module and `operators.kick`.

    The operator raises ConstraintError if no positions near the displaced ones satisfy the constraints.
    """
    displaced = DisplacedForces(constraints, groups)
    grouped = np.flatnonzero(displaced.grouped)
    columns = constraints.members
    inverses = bodies.inverse_masses, bodies.inverse_moments

    def apply(state: BodyState, h: float, shift: float) -> BodyState:
        F, tau = forces(state)
        q, A = np.empty(state.q.shape), np.empty(state.A.shape)
        kernels.bodies.displace(bodies.n, state.q, state.A, F, tau, shift, *inverses, q, A)
        q[:, columns] = constraints.displaced(state.q, F, shift)[:, columns]
        F, tau = forces.compute(q, A)
        F = displaced(state.q, q, F)
        p, L = np.empty(state.p.shape), np.empty(state.L.shape)
        kernels.bodies.kick(bodies.n, state.p, state.L, F, tau, h, state.q, q, p, L)
        L[:, grouped] = state.L[:, grouped]
        return BodyState(state.q, p, state.A, L)

    return apply


class DisplacedForces:
    """Forces at displaced positions, which satisfy all constraints between members of a group of points.

    Where a group lies on a line or is a single point, errors of its torque are of second order in the displacement.

    Attributes:
        grouped: which bodies are in a group, (n,). Torques act on the others about their centres.
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
        self.grouped = groups >= 0
        self._columns = columns[np.argsort(group[columns], kind="stable")]
        starts = np.flatnonzero(np.diff(group[self._columns], prepend=-1))
        self._edges = np.append(starts, len(self._columns))
        self._masses = constraints.masses[self._columns]

    def __call__(self, q: np.ndarray, at: np.ndarray, F: np.ndarray) -> np.ndarray:
        """Return the forces, (3, n), of the gradient kick on bodies at q with forces F, from displaced positions.

        They exert the torque of the displaced forces on each group, and must be projected at q.
        """
        F = self._constraints.project(at, F)
        if len(self._columns):
            kernels.constraints.turn_groups(self._edges, self._columns, self._masses, q, at, F)
        return F


# --- drifts ---


def constrained_drift(drift: Operator, constraints: Constraints, composition: Sequence[float] = SUZUKI) -> Operator:
    """Return the drift of all bodies: constrained ones follow geodesics by a composition of RATTLE steps.

    The operator raises ConstraintError if momenta are far too large for the time.
    """
    if not len(constraints.pairs):
        return drift

    def apply(state: BodyState, h: float) -> BodyState:
        q, p = constraints.drift(state.q, state.p, h, composition)
        free = drift(state, h)
        return BodyState(q, p, free.A, free.L)

    return apply


#: (bodies, time) -> bodies.
Advance = Callable[[BodyState, float], BodyState]


def nested_drift(drift: Operator, members: ArrayLike, within: Advance) -> Operator:
    """Return the drift of all bodies, in which some move under fast forces.

    The outer scheme then splits off the slow forces alone, H = (T + V_fast) + V_slow. Both flows are symmetric, and
    the composite has the order of the outer scheme if the inner steps have it and are proportional to the outer ones.
    Rigid bodies among the members turn freely between the fast kicks, as they do between the slow ones elsewhere.

    A gradient kick of the outer scheme is unchanged: its bracket [V_slow, [T + V_fast, V_slow]] has no term from
    V_fast, which commutes with V_slow.

    The fast force at the end of a drift is reused at the start of the next one, if positions and attitudes are still
    the same arrays, as they are after kicks and baths.

    Args:
        drift: of all bodies, under the constraints of those that are not members.
        members: columns of the bodies on which fast forces act, (m,), ascending, with all bodies that are constrained
            to one of them.
        within: motion of the members under their constraints, such as `equal_steps`.
    """
    columns = as_slice(np.asarray(members))
    #: Positions and attitudes of all bodies at the end of the last drift, and the same of the members.
    last: list[np.ndarray] = []

    def places(state: BodyState) -> tuple[np.ndarray, np.ndarray]:
        if last and last[0] is state.q and last[1] is state.A:
            return last[2], last[3]
        return state.q[:, columns].copy(), state.A[:, :, columns].copy()

    def apply(state: BodyState, h: float) -> BodyState:
        member_q, member_A = places(state)
        start = BodyState(member_q, state.p[:, columns].copy(), member_A, state.L[:, columns].copy())
        member_state = within(start, h)
        others = drift(state, h)
        A = others.A.copy() if others.A is state.A else others.A
        new_state = BodyState(others.q, others.p.copy(), A, others.L.copy())
        new_state.q[:, columns], new_state.p[:, columns] = member_state.q, member_state.p
        new_state.A[:, :, columns], new_state.L[:, columns] = member_state.A, member_state.L
        last[:] = new_state.q, new_state.A, member_state.q, member_state.A
        return new_state

    return apply


def as_slice(indices: np.ndarray) -> slice | np.ndarray:
    """Return indices, (k,), as a slice if their spacing is even, since a slice of an array is no copy."""
    if indices.size == 1:
        return slice(int(indices[0]), int(indices[0]) + 1)
    step = int(indices[1] - indices[0]) if indices.size else 0
    if step > 0 and np.all(np.diff(indices) == step):
        return slice(int(indices[0]), int(indices[-1]) + 1, step)
    return indices


def equal_steps(inner: Scheme, within: Mapping[str, Operator], longest: float) -> Advance:
    """Return motion under fast forces by the least number of equal steps of a palindrome.

    Take SIER4G as the inner scheme, with one step for a drift of up to 3 fs, two for the highest accuracy. Energy error
    of two free chains of three CH2 (constrained C-H, springs up to 1100/cm), in drifts of 3 fs over 1.2 ps at 300 K:

    | inner scheme, steps a drift | fast forces | rms(H), kJ/mol |
    |---|---|---|
    | SIER2, 2, 4, 8 or 12 | 2, 4, 8 or 12 | 0.11, 0.027, 0.0065, 0.0029 |
    | SIER4, 1 or 2 | 4 or 8 | 0.0016, 0.0001 |
    | SIER4G, 1 or 2 | 3 or 6 | 0.0013, 0.0001 |
    | the same with plain `RATTLE` | 3 or 6 | 0.0018, 0.0005, and drifts by 0.0012, 0.0003 /ps |

    Args:
        inner: scheme of the steps.
        within: its operators, see `constrained_operators`.
        longest: upper bound of the steps, ps.

    Raises:
        ValueError: `longest` is not positive, or an operator of the scheme is not in `within`.
    """
    _check_longest(longest)
    during_steps = {name: operator for name, operator in within.items() if name != AFTER_STEP}
    stepper = cache(partial(operators.stepper, inner, during_steps))
    stepper(longest)  # Fail here, not at the first step, if an operator is missing.

    def move(bodies: BodyState, h: float) -> BodyState:
        count = inner_steps(h, longest)
        step = stepper(h / count)
        for _ in range(count):
            bodies = step(bodies)
        return bodies

    return move


def steps_around_bath(within: Mapping[str, Operator], longest: float) -> dict[str, Advance]:
    """Return motion under fast forces by leapfrog steps, with the bath in the middle of one of them.

    The drifts to the bath and from it, together one drift, are an odd number of equal steps, each a whole kick and a
    drift. So the bath stands between two half drifts, as in `Scheme.with_bath`, and harmonic motion under fast forces
    has the right averages at the end of the drifts, however long the inner steps are. With a bath between steps of
    velocity Verlet the variance of the positions of a mode would be too large by a share (omega h)^2/4: 12 % for a bond
    of 19 fs and steps of 2 fs.

    Momenta at the end lag behind by half an inner kick of the fast forces, and by half a kick of the others.

    Args:
        within: operators of the members, see `constrained_operators`.
        longest: upper bound of the steps, ps.

    Returns:
        Motion of the members, by the names of the drifts to a bath and from one.

    Raises:
        ValueError: `longest` is not positive.
    """
    _check_longest(longest)
    kick, drift = within[KICK], within[DRIFT]

    def leapfrog(bodies: BodyState, e: float, steps: int) -> BodyState:
        for _ in range(steps):
            bodies = drift(kick(bodies, e), e)
        return bodies

    def to_bath(bodies: BodyState, h: float) -> BodyState:
        count = steps_with_bath(2 * h, longest)
        e = 2 * h / count
        return drift(kick(leapfrog(bodies, e, count // 2), e), e / 2)

    def from_bath(bodies: BodyState, h: float) -> BodyState:
        count = steps_with_bath(2 * h, longest)
        e = 2 * h / count
        return leapfrog(drift(bodies, e / 2), e, count // 2)

    return {DRIFT_TO_BATH: to_bath, DRIFT_FROM_BATH: from_bath}


def _check_longest(longest: float) -> None:
    if not longest > 0:
        raise ValueError(f"the longest inner step must be positive, got {longest}")


def inner_steps(h: float, longest: float) -> int:
    """Return the number of inner steps into which a drift for the time h is divided, the same for h and -h."""
    return max(1, math.ceil(abs(h) / longest * (1 - 1e-12)))


def steps_with_bath(h: float, longest: float) -> int:
    """Return the number of inner steps with a bath in the middle of one, which is odd."""
    return 2 * (inner_steps(h, longest) // 2) + 1
