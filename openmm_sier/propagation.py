"""The operators of a splitting scheme, and the loop that executes any scheme.

An operator is a function (state, time) -> state. It returns a new state and shares the arrays that it leaves
alone: a kick keeps the very arrays q and A. `CachedForces` recognizes them, and so the force at the end of a step
serves the start of the next without anyone keeping book of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from openmm_sier import kernels, rotor
from openmm_sier.bodies import BodyState, RigidBodies
from openmm_sier.compiled import executor
from openmm_sier.schemes import DRIFT, GRADIENT_KICK, KICK, Scheme

#: (state, time) -> state; a gradient kick takes its displacement per acceleration besides, a pair two times.
Operator = Callable[..., BodyState]

#: Operators by name, and by two names those that execute two stages which follow each other.
Operators = Mapping[Any, Operator]

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
        """Forces and torques elsewhere, which are not kept."""
        self.evaluations += 1
        return self._compute(q, A)


def body_operators(bodies: RigidBodies, forces: CachedForces, rotation: Rotation = rotor.exact) -> dict:
    """`Operators` for all schemes without a heat bath."""
    found: dict = {
        KICK: kick(forces),
        GRADIENT_KICK: gradient_kick(bodies, forces),
        DRIFT: drift(bodies, rotation),
    }
    if rotation is rotor.exact:
        found[KICK, DRIFT] = kick_and_drift(bodies, forces)
    return found


def kick(forces: CachedForces) -> Operator:
    """Momenta change by forces at fixed positions (van Zon and Schofield 2007, Eq. U2)."""

    def apply(state: BodyState, h: float) -> BodyState:
        F, tau = forces(state)
        if (loops := executor()) is None:
            p, L = state.p + h * F, state.L + h * tau
        else:
            p, L = np.empty_like(state.p), np.empty_like(state.L)
            loops.kick(slice(0, p.shape[1]), state.p, state.L, F, tau, h, p, L)
        return BodyState(state.q, p, state.A, L, state.heat, state.draws)

    return apply


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
        arm = (shift * bodies.inverse_masses) * F
        i, j, k = (-0.5 * shift) * bodies.inverse_moments * rotor.body_frame(state.A, tau)
        # The Cayley form of the rotation differs from it by a third of the cube of the angle, O(h^6).
        rows = kernels.rotation_matrix(np.ones_like(i), i, j, k)
        A = np.stack([kernels.combine(row, state.A[0], state.A[1], state.A[2]) for row in rows])
        F, tau = forces.at(state.q + arm, A)
        tau = tau + np.stack(kernels.cross(arm, F))
        return replace(state, p=state.p + h * F, L=state.L + h * tau)

    return apply


def drift(bodies: RigidBodies, rotation: Rotation = rotor.exact) -> Operator:
    """Free motion of the bodies (van Zon and Schofield 2007, Eq. U1) with any free-rotation map."""

    def apply(state: BodyState, h: float) -> BodyState:
        q = state.q + (h * bodies.inverse_masses) * state.p
        if len(bodies.species) == 1:
            A, L = rotation(state.A, state.L, bodies.species[0].moments, h)
            return BodyState(q, state.p, A, L, state.heat, state.draws)
        A, L = state.A.copy(), state.L.copy()
        for species, part in zip(bodies.species, bodies.parts, strict=True):
            if species.moments.any():
                A[:, :, part], L[:, part] = rotation(A[:, :, part], L[:, part], species.moments, h)
        return replace(state, q=q, A=A, L=L)

    return apply


def kick_and_drift(bodies: RigidBodies, forces: CachedForces) -> Operator:
    """`kick` and then `drift` by the exact rotation; where code is compiled in one loop, as calls cost most in small
    systems."""
    kicked, drifted = kick(forces), drift(bodies)
    tops = [rotor.top(species.moments) for species in bodies.species]

    def apply(state: BodyState, kick_time: float, drift_time: float) -> BodyState:
        if (loops := executor()) is None:
            return drifted(kicked(state, kick_time), drift_time)
        wrench, times = forces(state), (kick_time, drift_time)
        before = state.q, state.p, state.A, state.L
        q, p, A, L = after = [np.empty_like(values) for values in before]
        far = np.empty(bodies.n, dtype=bool)
        for top, part in zip(tops, bodies.parts, strict=True):
            loops.advance(
                part, before, wrench, times, bodies.inverse_masses, top.frame, rotor.COMPILED_RULE, tuple(after), far
            )
        if far.any():
            for top, part in zip(tops, bodies.parts, strict=True):
                rotor.rotate_far(top, state.A[:, :, part], L[:, part], drift_time, A[:, :, part], far[part])
        return BodyState(q, p, A, L, state.heat, state.draws)

    return apply


def stepper(scheme: Scheme, operators: Operators, h: float) -> Stepper:
    """What makes a step of length h, by the scheme's stages in order. It leaves the state that it is given as it was.

    Args:
        scheme: what to execute.
        operators: for each operator name of the scheme what executes it; one for a pair of names is preferred.
        h: length of the step, ps.
    """
    calls: list[tuple[Operator, list[float]]] = []
    stages = list(scheme.stages)
    while stages:
        names = tuple(stage.operator for stage in stages[:2])
        operator = operators.get(names) or operators[names[0]]
        done = 2 if names in operators else 1
        calls.append((operator, [time for stage in stages[:done] for time in stage.times(h)]))
        del stages[:done]

    def step(state: BodyState) -> BodyState:
        for operator, times in calls:
            state = operator(state, *times)
        return state

    return step
