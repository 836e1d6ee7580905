"""Operators of splitting schemes, and the loop that executes a scheme.

An operator is a function (state, time) -> state. It returns a new state that shares unchanged arrays: a kick keeps the
arrays q and A themselves. `CachedForces` recognizes them, and so reuses the force at the end of a step at the start of
the next one without any bookkeeping.
"""

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np

from openmm_sier.dynamics import kernels
from openmm_sier.dynamics.bodies import BodySet, BodyState, Pair
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.rotation.axes import axes_of, not_finite
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.stages import DRIFT, DRIFT_FROM_BATH, DRIFT_TO_BATH, GRADIENT_KICK, KICK

#: (state, time) -> state; a gradient kick also takes its displacement per acceleration.
Operator = Callable[..., BodyState]

#: Name of an operator that, where there is one, ends every step whatever the scheme. It takes the state alone.
AFTER_STEP = "after step"

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


#: (state, time) -> (q, A, L).
FreeMotion = Callable[[BodyState, float], tuple[np.ndarray, ...]]


class CachedForces:
    """Forces and torques that are recomputed only for new arrays of positions or attitudes.

    Args:
        compute: (q, A) -> (F, tau), each (3, n).

    Attributes:
        evaluations: number of calls of `compute`.
    """

    def __init__(self, compute: Callable[..., tuple[np.ndarray, ...]]):
        self._compute = compute
        self.evaluations = 0
        self.invalidate()

    def invalidate(self) -> None:
        """Discard cached forces, after a change of the potential."""
        self._q: np.ndarray | None = None
        self._A: np.ndarray | None = None
        self._forces: tuple[np.ndarray, ...] = ()

    def __call__(self, state: BodyState) -> tuple[np.ndarray, ...]:
        if state.q is not self._q or state.A is not self._A:
            # Free the memory of old forces before computing new ones.
            self.invalidate()
            self._forces = self.at(state.q, state.A)
            self._q = state.q
            self._A = state.A
        return self._forces

    def at(self, q: np.ndarray, A: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return forces and torques at other positions and attitudes, without caching them.

        Raises:
            ValueError: their shape differs from that of the positions, (3, n).
        """
        self.evaluations += 1
        results = self._compute(q, A)
        for vectors in results:
            if vectors.shape != q.shape:
                shapes = " and ".join(str(result.shape) for result in results)
                raise ValueError(f"forces must have the shape {q.shape} of the positions, got {shapes}")
        return results


def body_operators(bodies: BodySet, forces: CachedForces, rotation: Rotation = exact) -> dict[str, Operator]:
    """Return the operators of schemes without a heat bath."""
    return {KICK: kick(forces), GRADIENT_KICK: gradient_kick(bodies, forces), **drifts(drift(bodies, rotation))}


def drifts(operator: Operator) -> dict[str, Operator]:
    """Return an operator for drifts on either side of a bath and elsewhere."""
    return dict.fromkeys((DRIFT, DRIFT_TO_BATH, DRIFT_FROM_BATH), operator)


def kick(forces: CachedForces) -> Operator:
    """Return a kick: momenta change by forces at fixed positions (van Zon and Schofield 2007, Eq. 6 (U2))."""

    def apply(state: BodyState, h: float) -> BodyState:
        F, tau = forces(state)
        p, L = np.empty(state.p.shape), np.empty(state.L.shape)
        kernels.bodies.kick(state.p.shape[1], state.p, state.L, F, tau, h, p, L)
        return BodyState(state.q, p, state.A, L)

    return apply


def gradient_kick(bodies: BodySet, forces: CachedForces) -> Operator:
    """Return a kick by the forces of the potential V - (s/2) (F M^-1 F + tau I^-1 tau).

    Its force F + s (grad F) M^-1 F is, to first order in s, the force at positions that are displaced by s M^-1 F, with
    bodies also turned by the lab vector s I^-1 tau. Two more terms of the torque, from rotations that do not commute
    and from the dependence of I^-1 on the orientation, cancel each other. The torque is taken about the centre before
    the displacement, tau' + (q' - q) x F', which differs in second order in s and conserves the total angular momentum
    exactly.

    The map is exactly reversible, and symplectic up to terms of the second order in s, h s^2 = O(h^5) a step.
    Sources: Chin, Phys. Lett. A 226, 344 (1997); Omelyan, J. Chem. Phys. 127, 044102 (2007) for rigid bodies.
    """

    def apply(state: BodyState, h: float, shift: float) -> BodyState:
        F, tau = forces(state)
        q, A = bodies.displaced(state.q, state.A, F, tau, shift)
        F, tau = forces.at(q, A)
        p, L = momenta_kicked_at(q, state, F, tau, h)
        return BodyState(state.q, p, state.A, L)

    return apply


def momenta_kicked_at(at: np.ndarray, state: BodyState, F: np.ndarray, tau: np.ndarray, h: float) -> Pair:
    """Return momenta and angular momenta after forces at other points, and torques about these, act for a time h.

    All arrays are (3, n); the angular momenta are about the centres of the state.
    """
    p, L = np.empty(state.p.shape), np.empty(state.L.shape)
    kernels.bodies.kick_elsewhere(at.shape[1], state.p, state.L, F, tau, h, state.q, at, p, L)
    return p, L


def drift(bodies: BodySet, rotation: Rotation = exact) -> Operator:
    """Return the free motion of bodies (van Zon and Schofield 2007, Eq. 5 (U1)) with any free-rotation map.

    The operator raises ValueError for a state with another number of bodies.
    """
    in_order = all((np.diff(species.moments) >= 0).all() for species in bodies.species)
    free_motion = _exact_drift(bodies) if rotation is exact and in_order else _drift_by(bodies, rotation)

    def apply(state: BodyState, h: float) -> BodyState:
        if state.q.shape != (3, bodies.n):
            raise ValueError(f"a state of {bodies.n} bodies must have q of shape {(3, bodies.n)}, got {state.q.shape}")
        q, A, L = free_motion(state, h)
        return BodyState(q, state.p, A, L)

    return apply


def _exact_drift(bodies: BodySet) -> FreeMotion:
    rates = np.array([axes_of(species.moments).rates for species in bodies.species]).reshape(-1, 3)
    edges = np.array([0, *(columns.stop for columns in bodies.parts)], dtype=np.int64)
    inverse_masses = bodies.inverse_masses

    def move(state: BodyState, h: float) -> tuple[np.ndarray, ...]:
        q, A = np.empty(state.q.shape), np.empty(state.A.shape)
        kinds = edges, rates
        if kernels.bodies.drift(bodies.n, state.q, state.p, state.A, state.L, h, *kinds, inverse_masses, q, A):
            raise not_finite(state.A, state.L)
        return q, A, state.L

    return move


def _drift_by(bodies: BodySet, rotation: Rotation) -> FreeMotion:
    def move(state: BodyState, h: float) -> tuple[np.ndarray, ...]:
        A, L = state.A.copy(), state.L.copy()
        for species, columns in zip(bodies.species, bodies.parts, strict=True):
            if species.moments.any():
                A[:, :, columns], L[:, columns] = rotation(A[:, :, columns], L[:, columns], species.moments, h)
        return state.q + (h * bodies.inverse_masses) * state.p, A, L

    return move


def stepper(scheme: Scheme, operators: Mapping[str, Operator], h: float) -> Stepper:
    """Return a function that makes a step of length h by the scheme's stages, without changing the given state.

    Args:
        scheme: the scheme.
        operators: operators by name.
        h: length of the step, ps.

    Raises:
        ValueError: an operator of the scheme is not in `operators`.
    """
    if missing := [name for name in scheme.operators if name not in operators]:
        raise ValueError(f"nothing executes the operator '{missing[0]}' of the scheme {scheme.name}")
    calls: list[tuple[Operator, tuple]] = [(operators[stage.operator], stage.times(h)) for stage in scheme.stages]
    if AFTER_STEP in operators:
        calls.append((operators[AFTER_STEP], ()))

    def step(state: BodyState) -> BodyState:
        for operator, times in calls:
            state = operator(state, *times)
        return state

    return step
