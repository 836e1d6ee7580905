"""The operators of a splitting scheme, and the loop that executes any scheme.

An operator is a function (state, time) -> state. It returns a new state and shares the arrays that it leaves
alone: a kick keeps the very arrays q and A. `CachedForces` recognizes them, and so the force at the end of a step
serves the start of the next without anyone keeping book of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from openmm_sier.dynamics.backend import kernels
from openmm_sier.dynamics.backend.compiled import executor
from openmm_sier.dynamics.bodies import BodyState, RigidBodies
from openmm_sier.dynamics.rotation import rotor
from openmm_sier.dynamics.schemes import DRIFT, GRADIENT_KICK, KICK, Scheme

#: (state, time) -> state; a gradient kick takes its displacement per acceleration besides.
Operator = Callable[..., BodyState]

#: What makes a whole step.
Stepper = Callable[[BodyState], BodyState]

#: (q, A) -> (F, tau)
ForceFunction = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]

#: A free-rotation map (A, L, moments, h) -> (A, L), as `rotor.exact`.
Rotation = Callable[[np.ndarray, np.ndarray, np.ndarray, float], tuple[np.ndarray, np.ndarray]]


class CachedForces:
    """Forces and torques that are computed again only for other arrays of positions or attitudes.

    Args:
        compute: (q, A) -> (F, tau), each (3, n).

    Attributes:
        evaluations: how often `compute` was called.
    """

    def __init__(self, compute: ForceFunction):
        self._compute = compute
        self.evaluations = 0
        self.forget()

    def forget(self) -> None:
        """Compute anew next time: the potential has changed."""
        self._where: tuple = (None, None)
        self._value: tuple = ()

    def __call__(self, state: BodyState) -> tuple[np.ndarray, np.ndarray]:
        if self._where[0] is not state.q or self._where[1] is not state.A:
            self.forget()
            self._value = self.at(state.q, state.A)
            self._where = (state.q, state.A)
        return self._value

    def at(self, q, A) -> tuple[np.ndarray, np.ndarray]:
        """Forces and torques elsewhere, which are not kept.

        Raises:
            ValueError: they have not the shape (3, n) of the positions, on which compiled loops rely.
        """
        self.evaluations += 1
        F, tau = self._compute(q, A)
        if not F.shape == tau.shape == q.shape:
            raise ValueError(f"forces and torques must have the shape {q.shape} of q, got {F.shape} and {tau.shape}")
        return F, tau


def body_operators(bodies: RigidBodies, forces: CachedForces, rotation: Rotation = rotor.exact) -> dict[str, Operator]:
    """What executes all schemes without a heat bath."""
    return {KICK: kick(forces), GRADIENT_KICK: gradient_kick(bodies, forces), DRIFT: drift(bodies, rotation)}


def kick(forces: CachedForces) -> Operator:
    """Momenta change by forces at fixed positions (van Zon and Schofield 2007, Eq. U2)."""

    def apply(state: BodyState, h: float) -> BodyState:
        F, tau = forces(state)
        if (loops := executor()) is None:
            return _with_momenta(state, state.p + h * F, state.L + h * tau)
        p, L = np.empty(F.shape), np.empty(F.shape)
        loops.kick(_all(F), state.p, state.L, F, tau, h, p, L)
        return _with_momenta(state, p, L)

    return apply


def _with_momenta(state: BodyState, p, L) -> BodyState:
    return BodyState(state.q, p, state.A, L, state.heat, state.draws)


def _all(vectors) -> slice:
    """All bodies, for the compiled loops."""
    return slice(0, vectors.shape[1])


def gradient_kick(bodies: RigidBodies, forces: CachedForces) -> Operator:
    """Momenta change by the forces of the potential V - (s/2) (F M^-1 F + tau I^-1 tau).

    Its force F + s (grad F) M^-1 F is, to first order in s, the force at positions that are displaced by s M^-1 F, and
    for a body that is turned besides by the lab vector s I^-1 tau. Two more terms of the torque, from rotations that do
    not commute and from the dependence of I^-1 on the orientation, cancel each other. The torque is taken about the
    centre before the displacement, tau' + (q' - q) x F', which differs in second order in s and conserves the total
    angular momentum exactly.

    The map is exactly reversible, and symplectic up to terms of the second order in s, h s^2 = O(h^5) a step.
    Sources: Chin, Phys. Lett. A 226, 344 (1997); Omelyan, J. Chem. Phys. 127, 044102 (2007) for rigid bodies.
    """

    def apply(state: BodyState, h: float, shift: float) -> BodyState:
        F, tau = forces(state)
        q, A = _displaced(bodies, state, F, tau, shift)
        arm = q - state.q
        F, tau = forces.at(q, A)
        if (loops := executor()) is None:
            return _with_momenta(state, state.p + h * F, state.L + h * (tau + np.stack(kernels.cross(arm, F))))
        p, L = np.empty(F.shape), np.empty(F.shape)
        loops.kick_from(_all(F), state.p, state.L, F, tau, arm, h, p, L)
        return _with_momenta(state, p, L)

    return apply


def _displaced(bodies: RigidBodies, state: BodyState, F, tau, shift: float):
    """Centres and attitudes of bodies displaced by `shift` times their accelerations."""
    inverses = bodies.inverse_masses, bodies.inverse_moments
    if (loops := executor()) is not None:
        q, A = np.empty(state.q.shape), np.empty(state.A.shape)
        loops.displace(_all(q), state.q, state.A, F, tau, shift, *inverses, q, A)
        return q, A
    x, y, z = state.A
    rows = kernels.displacing_rotation(x, y, z, tau, inverses[1], shift)
    A = np.stack([kernels.combine(row, x, y, z) for row in rows])
    return state.q + (shift * inverses[0]) * F, A


def drift(bodies: RigidBodies, rotation: Rotation = rotor.exact) -> Operator:
    """Free motion of the bodies (van Zon and Schofield 2007, Eq. U1) with any free-rotation map.

    The operator raises ValueError for the state of another number of bodies.
    """
    tops = [rotor.top(species.moments) for species in bodies.species]
    pieces = [(top, top.frame, part) for top, part in zip(tops, bodies.parts, strict=True)]

    def apply(state: BodyState, h: float) -> BodyState:
        if state.q.shape != (3, bodies.n):
            raise ValueError(f"the state of {bodies.n} bodies has q of shape {(3, bodies.n)}, got {state.q.shape}")
        loops = executor() if rotation is rotor.exact else None
        if loops is None:
            A, L = _rotated(bodies, rotation, state, h)
            q = state.q + (h * bodies.inverse_masses) * state.p
            return BodyState(q, state.p, A, L, state.heat, state.draws)
        q, A, far = np.empty(state.q.shape), np.empty(state.A.shape), np.empty(bodies.n, dtype=bool)
        before = state.q, state.p, state.A, state.L
        for top, frame, part in pieces:
            if loops.drift(part, *before, h, bodies.inverse_masses, frame, rotor.COMPILED_RULE, q, A, far):
                rotor.rotate_far(top, part, state.A, state.L, h, A, far)
        return BodyState(q, state.p, A, state.L, state.heat, state.draws)

    return apply


def _rotated(bodies: RigidBodies, rotation: Rotation, state: BodyState, h: float):
    if len(bodies.species) == 1:
        return rotation(state.A, state.L, bodies.species[0].moments, h)
    A, L = state.A.copy(), state.L.copy()
    for species, part in zip(bodies.species, bodies.parts, strict=True):
        if species.moments.any():
            A[:, :, part], L[:, part] = rotation(A[:, :, part], L[:, part], species.moments, h)
    return A, L


def stepper(scheme: Scheme, operators: Mapping[str, Operator], h: float) -> Stepper:
    """What makes a step of length h, by the scheme's stages in order. It leaves the state that it is given as it was.

    Args:
        scheme: what to execute.
        operators: for each operator name of the scheme what executes it.
        h: length of the step, ps.

    Raises:
        ValueError: the scheme has an operator that is not among them.
    """
    if missing := [name for name in scheme.operators if name not in operators]:
        raise ValueError(f"nothing executes the operator '{missing[0]}' of the scheme {scheme.name}")
    calls = [(operators[stage.operator], stage.times(h)) for stage in scheme.stages]

    def step(state: BodyState) -> BodyState:
        for operator, times in calls:
            state = operator(state, *times)
        return state

    return step
