"""The operators of a splitting scheme, and the loop that executes any scheme.

An operator is a function (state, time) -> state. It returns a new state and shares the arrays that it leaves
alone: a kick keeps the very arrays q and A. `CachedForces` recognizes them, and so the force at the end of a step
serves the start of the next without anyone keeping book of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from openmm_sier import rotor
from openmm_sier.bodies import BodyState, RigidBodies
from openmm_sier.schemes import Scheme

Operator = Callable[[BodyState, float], BodyState]

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
            self.evaluations += 1
            self._value = self._compute(state.q, state.A)
            self._where = (state.q, state.A)
        return self._value


def kick(forces: CachedForces) -> Operator:
    """Momenta change by forces at fixed positions (van Zon and Schofield 2007, Eq. U2)."""

    def apply(state: BodyState, h: float) -> BodyState:
        F, tau = forces(state)
        return replace(state, p=state.p + h * F, L=state.L + h * tau)

    return apply


def drift(bodies: RigidBodies, rotation: Rotation = rotor.exact) -> Operator:
    """Free motion of the bodies (van Zon and Schofield 2007, Eq. U1) with any free-rotation map."""
    inverse_masses = 1 / bodies.masses

    def apply(state: BodyState, h: float) -> BodyState:
        q = state.q + (h * inverse_masses) * state.p
        if len(bodies.species) == 1:
            A, L = rotation(state.A, state.L, bodies.species[0].moments, h)
            return replace(state, q=q, A=A, L=L)
        A, L = state.A.copy(), state.L.copy()
        for species, part in zip(bodies.species, bodies.parts, strict=True):
            if species.moments.any():
                A[:, :, part], L[:, part] = rotation(A[:, :, part], L[:, part], species.moments, h)
        return replace(state, q=q, A=A, L=L)

    return apply


def step(scheme: Scheme, operators: Mapping[str, Operator], state: BodyState, h: float) -> BodyState:
    """The state after one step of length h, by the scheme's stages in order.

    Args:
        scheme: what to execute.
        operators: for each operator name of the scheme what executes it.
        state: the phase point at the start; it is left as it was.
        h: length of the step, ps.
    """
    for name, fraction in scheme.stages:
        state = operators[name](state, fraction * h)
    return state
