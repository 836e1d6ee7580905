"""Operators of splitting schemes, and the calls that make a step.

An operator is a function (state, time) -> state. It returns a new state that shares unchanged arrays, and where
positions and attitudes stay the cache of forces too (`BodyState.cache`). So the force at the end of a step serves
the start of the next one without any bookkeeping.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from openmm_sier.dynamics import kernels
from openmm_sier.dynamics.bodies import BodySet, BodyState, Pair
from openmm_sier.dynamics.indices import runs
from openmm_sier.dynamics.plan import Bath, Drift, Kick, Operation, Project, expanded, plan_step
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.rotation.axes import axes_of, not_finite
from openmm_sier.dynamics.schemes import Scheme

#: (state, time) -> state; a gradient kick also takes its displacement per acceleration.
Operator = Callable[..., BodyState]

#: Forces and torques, each (3, n), on bodies with centres (3, n) and attitudes (3, 3, n).
Forces = Callable[[np.ndarray, np.ndarray], Pair]

#: For each class of operations a function (operation, step in ps) -> operator.
Table = Mapping[type[Operation], Callable[[Any, float], Operator]]


class OperatorCall(NamedTuple):
    """A call of an operator in a step.

    Attributes:
        operator: the operator.
        times: its arguments besides the state.
        is_bath: whether it is a heat bath.
    """

    operator: Operator
    times: tuple[float, ...]
    is_bath: bool


#: A function that makes a whole step.
Stepper = Callable[[BodyState], BodyState]


class Rotation(Protocol):
    """Free-rotation map, such as `openmm_sier.dynamics.rotation.exact`; any function with these arguments."""

    def __call__(self, A: np.ndarray, L: np.ndarray, moments: Any, time: float, /) -> tuple[np.ndarray, np.ndarray]:
        """Return attitudes and angular momenta after a time.

        Args:
            A: attitude matrices, (3, 3, n).
            L: angular momenta in the lab frame, (3, n), dalton nm^2/ps.
            moments: principal moments, three numbers or arrays (n,), dalton nm^2.
            time: ps; may be negative.
        """
        ...


def always(operator: Operator) -> Callable[[Operation, float], Operator]:
    """Return the entry of a table for operations of which all have one operator."""
    return lambda operation, step: operator


def body_operators(bodies: BodySet, forces: Forces, rotation: Rotation = exact) -> dict[type[Operation], Any]:
    """Return the table of schemes without a heat bath, for bodies without constraints between them."""
    return {Kick: always(kick(bodies, forces)), Drift: always(drift(bodies, rotation))}


class Displacement(Protocol):
    """Constraints of the displaced positions of gradient kicks."""

    def satisfy(self, q: np.ndarray, F: np.ndarray, shift: float, displaced: np.ndarray) -> None:
        """Bring displaced positions onto the constraints, in place.

        Args:
            q: positions, (3, n), nm.
            F: forces there, (3, n).
            shift: displacement per acceleration, ps^2.
            displaced: displaced positions, (3, n), nm.
        """

    def __call__(self, q: np.ndarray, at: np.ndarray, F: np.ndarray) -> np.ndarray:
        """Return the forces, (3, n), of the gradient kick at q from those at displaced positions."""

    #: Columns of the bodies on which no torque acts about their centres.
    without_torque: np.ndarray


def kick(bodies: BodySet, forces: Forces, displacement: Displacement | None = None) -> Operator:
    """Return a kick: momenta change by forces at fixed positions (van Zon and Schofield 2007, Eq. 6 (U2)).

    With a shift s it is a gradient kick, by the forces of the potential V - (s/2) (F M^-1 F + tau I^-1 tau). Its force
    F + s (grad F) M^-1 F is, to first order in s, the force at positions that are displaced by s M^-1 F, with
    bodies also turned by the lab vector s I^-1 tau. Two more terms of the torque, from rotations that do not commute
    and from the dependence of I^-1 on the orientation, cancel each other. The torque is taken about the centre before
    the displacement, tau' + (q' - q) x F', which differs in second order in s and conserves the total angular momentum
    exactly.

    The map is exactly reversible, and symplectic up to terms of the second order in s, h s^2 = O(h^5) a step.
    Sources: Chin, Phys. Lett. A 226, 344 (1997); Omelyan, J. Chem. Phys. 127, 044102 (2007) for rigid bodies.

    Args:
        bodies: all bodies.
        forces: forces and torques on them.
        displacement: constraints of displaced positions; None without constraints.
    """
    inverses = bodies.inverse_masses, bodies.inverse_moments

    def apply(state: BodyState, h: float, shift: float = 0.0) -> BodyState:
        cache, q = state.cache, state.q
        if cache.forces is None:
            cache.forces = forces(q, state.A)
        F, tau = cache.forces
        if shift:
            q, A = np.empty(state.q.shape), np.empty(state.A.shape)
            kernels.bodies.displace(bodies.n, state.q, state.A, F, tau, shift, *inverses, q, A)
            if displacement is not None:
                displacement.satisfy(state.q, F, shift, q)
            F, tau = forces(q, A)
            if displacement is not None:
                F = displacement(state.q, q, F)
        p, L = np.empty(state.p.shape), np.empty(state.L.shape)
        kernels.bodies.kick(bodies.n, state.p, state.L, F, tau, h, state.q, q, p, L)
        if shift and displacement is not None:
            columns = displacement.without_torque
            L[:, columns] = state.L[:, columns]
        if shift and bodies.bearings is not None:
            # The torque about the centre has parts along axes that the torque of the displaced body had not.
            bodies.bearings.remove(p, L, state.A)
        return BodyState(state.q, p, state.A, L, state.cache)

    return apply


def drift(bodies: BodySet, rotation: Rotation = exact) -> Operator:
    """Return the free motion of bodies (van Zon and Schofield 2007, Eq. 5 (U1)) with any free-rotation map.

    The operator raises ValueError for a state with another number of bodies.
    """
    moments = bodies.rotation_moments
    in_order = bool((np.diff(moments, axis=0) >= 0).all())
    if rotation is not exact or not in_order:
        return _drift_by(bodies, rotation)
    rates = axes_of(moments).rates
    tables = runs(rates[0] > 0), rates, bodies.inverse_masses
    n, shape = bodies.n, (3, bodies.n)

    def apply(state: BodyState, h: float) -> BodyState:
        if state.q.shape != shape:
            raise ValueError(f"a state of {n} bodies must have q of shape {shape}, got {state.q.shape}")
        q, A = np.empty(shape), np.empty((3, *shape))
        if kernels.bodies.drift(n, state.q, state.p, state.A, state.L, h, *tables, q, A):
            raise not_finite(state.A, state.L)
        return BodyState(q, state.p, A, state.L)

    return apply


def _drift_by(bodies: BodySet, rotation: Rotation) -> Operator:
    """Return the free motion of bodies with a free-rotation map that NumPy applies to each species."""

    def apply(state: BodyState, h: float) -> BodyState:
        A, L = state.A.copy(), state.L.copy()
        for species, columns in zip(bodies.species, bodies.columns, strict=True):
            if species.turns.any():
                of_kind = bodies.rotation_moments[:, columns]
                A[:, :, columns], L[:, columns] = rotation(A[:, :, columns], L[:, columns], of_kind, h)
        return BodyState(state.q + (h * bodies.inverse_masses) * state.p, state.p, A, L)

    return apply


def calls(operations: Iterable[Operation], table: Table, h: float) -> list[OperatorCall]:
    """Return the calls that make a step of length h, ps.

    Raises:
        ValueError: an operation is not in the table.
    """
    result = []
    for operation in expanded(operations):
        if type(operation) not in table:
            raise ValueError(f"nothing executes the operation '{operation}'")
        operator = table[type(operation)](operation, h)
        result.append(OperatorCall(operator, operation.times(h), isinstance(operation, Bath)))
    return result


def advance(made: list[OperatorCall], state: BodyState) -> BodyState:
    """Return the state after calls, without changing the given one."""
    for operator, times, _ in made:
        state = operator(state, *times)
    return state


def stepper(scheme: Scheme, table: Table, h: float, **options: Any) -> Stepper:
    """Return a function that makes a step of a scheme, ps, by its plan without updates; `options` of `plan_step`."""
    plan = plan_step(scheme, updates=False, projects=Project in table, **options)
    made = calls(plan.operations, table, h)
    return lambda state: advance(made, state)
