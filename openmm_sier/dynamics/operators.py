"""Operators of splitting schemes, and the calls that make a step.

An operator is a function (state, time) -> state. It returns a new state that shares unchanged arrays: a kick keeps the
arrays q and A themselves. `CachedForces` recognizes them, and so reuses the force at the end of a step at the start of
the next one without any bookkeeping.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from openmm_sier.dynamics import kernels
from openmm_sier.dynamics.bodies import BodySet, BodyState, Pair
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.rotation.axes import axes_of, not_finite
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.stages import BATH, DRIFT, DRIFT_FROM_BATH, DRIFT_TO_BATH, GRADIENT_KICK, KICK

#: (state, time) -> state; a gradient kick also takes its displacement per acceleration.
Operator = Callable[..., BodyState]

#: Name of an operator that, where there is one, ends every step whatever the scheme. It takes the state alone.
AFTER_STEP = "after step"


class StageCall(NamedTuple):
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


class CachedForces:
    """Forces and torques that are recomputed only for new arrays of positions or attitudes.

    Attributes:
        compute: function (q, A) -> (F, tau), each (3, n), which caches nothing.
    """

    def __init__(self, compute: Callable[[np.ndarray, np.ndarray], Pair]):
        self.compute = compute
        self.invalidate()

    def invalidate(self) -> None:
        """Discard cached forces, after a change of the potential."""
        self._q: np.ndarray | None = None
        self._A: np.ndarray | None = None
        self._forces: Pair | None = None

    def __call__(self, state: BodyState) -> Pair:
        """Return forces and torques at a state, (F, tau).

        Raises:
            ValueError: their shape differs from that of the positions, (3, n).
        """
        if self._forces is None or state.q is not self._q or state.A is not self._A:
            # Free the memory of old forces before computing new ones.
            self._forces = None
            forces = self.compute(state.q, state.A)
            if not forces[0].shape == forces[1].shape == state.q.shape:
                shapes = f"{forces[0].shape} and {forces[1].shape}"
                raise ValueError(f"forces must have the shape {state.q.shape} of the positions, got {shapes}")
            self._q = state.q
            self._A = state.A
            self._forces = forces
        return self._forces


def body_operators(bodies: BodySet, forces: CachedForces, rotation: Rotation = exact) -> dict[str, Operator]:
    """Return the operators of schemes without a heat bath."""
    operator = kick(bodies, forces)
    return {KICK: operator, GRADIENT_KICK: operator, **drifts(drift(bodies, rotation))}


def drifts(operator: Operator) -> dict[str, Operator]:
    """Return an operator for drifts on either side of a bath and elsewhere."""
    return dict.fromkeys((DRIFT, DRIFT_TO_BATH, DRIFT_FROM_BATH), operator)


def kick(bodies: BodySet, forces: CachedForces) -> Operator:
    """Return a kick: momenta change by forces at fixed positions (van Zon and Schofield 2007, Eq. 6 (U2)).

    With a shift s it is a gradient kick, by the forces of the potential V - (s/2) (F M^-1 F + tau I^-1 tau). Its force
    F + s (grad F) M^-1 F is, to first order in s, the force at positions that are displaced by s M^-1 F, with
    bodies also turned by the lab vector s I^-1 tau. Two more terms of the torque, from rotations that do not commute
    and from the dependence of I^-1 on the orientation, cancel each other. The torque is taken about the centre before
    the displacement, tau' + (q' - q) x F', which differs in second order in s and conserves the total angular momentum
    exactly.

    The map is exactly reversible, and symplectic up to terms of the second order in s, h s^2 = O(h^5) a step.
    Sources: Chin, Phys. Lett. A 226, 344 (1997); Omelyan, J. Chem. Phys. 127, 044102 (2007) for rigid bodies.
    """
    inverses = bodies.inverse_masses, bodies.inverse_moments

    def apply(state: BodyState, h: float, shift: float = 0.0) -> BodyState:
        F, tau = forces(state)
        q = state.q
        if shift:
            q, A = np.empty(state.q.shape), np.empty(state.A.shape)
            kernels.bodies.displace(bodies.n, state.q, state.A, F, tau, shift, *inverses, q, A)
            F, tau = forces.compute(q, A)
        p, L = np.empty(state.p.shape), np.empty(state.L.shape)
        kernels.bodies.kick(bodies.n, state.p, state.L, F, tau, h, state.q, q, p, L)
        return BodyState(state.q, p, state.A, L)

    return apply


def drift(bodies: BodySet, rotation: Rotation = exact) -> Operator:
    """Return the free motion of bodies (van Zon and Schofield 2007, Eq. 5 (U1)) with any free-rotation map.

    The operator raises ValueError for a state with another number of bodies.
    """
    in_order = all((np.diff(species.moments) >= 0).all() for species in bodies.species)
    if rotation is not exact or not in_order:
        return _drift_by(bodies, rotation)
    rates = np.array([axes_of(species.moments).rates for species in bodies.species]).reshape(-1, 3)
    edges = np.array([0, *(columns.stop for columns in bodies.columns)], dtype=np.int64)
    tables = edges, rates, bodies.inverse_masses
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
            if species.moments.any():
                A[:, :, columns], L[:, columns] = rotation(A[:, :, columns], L[:, columns], species.moments, h)
        return BodyState(state.q + (h * bodies.inverse_masses) * state.p, state.p, A, L)

    return apply


def calls(scheme: Scheme, operators: Mapping[str, Operator], h: float) -> list[StageCall]:
    """Return the operators of a step of length h, one for each of the scheme's stages, with their times.

    Args:
        scheme: the scheme.
        operators: operators by name.
        h: length of the step, ps.

    Raises:
        ValueError: an operator of the scheme is not in `operators`.
    """
    if missing := [name for name in scheme.operators if name not in operators]:
        raise ValueError(f"nothing executes the operator '{missing[0]}' of the scheme {scheme.name}")
    result = [StageCall(operators[stage.operator], stage.times(h), stage.operator == BATH) for stage in scheme.stages]
    if AFTER_STEP in operators:
        result.append(StageCall(operators[AFTER_STEP], (), False))
    return result


def stepper(scheme: Scheme, operators: Mapping[str, Operator], h: float) -> Stepper:
    """Return a function that makes a step by `calls`, without changing the given state."""
    stages = calls(scheme, operators, h)

    def step(state: BodyState) -> BodyState:
        for operator, times, _ in stages:
            state = operator(state, *times)
        return state

    return step
