"""The heat bath within steps: the exact Ornstein-Uhlenbeck process on momenta and body-frame angular momenta."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from openmm_sier.dynamics import kernels
from openmm_sier.dynamics.bodies import BodySet, BodyState
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.friction import Friction, frictions_of, refuse_uneven_friction
from openmm_sier.dynamics.operators import Operator
from openmm_sier.dynamics.tally import Tally

#: Arguments of a kernel that depend on the time, ps.
Arguments = Callable[[float], tuple[Any, ...]]


@dataclass(frozen=True)
class OrnsteinUhlenbeck:
    """Langevin thermostat for rigid bodies, an operator that changes only momenta.

    Momenta and body-frame angular momenta follow dx = -friction x dt + sqrt(2 friction k_B T M) dW with M the mass
    or the principal moment, which is solved exactly for any time (Bussi and Parrinello, Phys. Rev. E 75, 056707 (2007)
    for point particles; Davidchack, Ouldridge and Tretyakov, J. Chem. Phys. 142, 144114 (2015) for rigid bodies).
    Attitudes do not change in it, so that it is also exact for momenta along the principal axes, each with a friction
    of its own.

    Attributes:
        temperature: temperature, K.
        friction: friction of translation, 1/ps.
        rotational_friction: friction of rotation, 1/ps.
    """

    temperature: float
    friction: Friction
    rotational_friction: Friction

    @property
    def shared_frictions(self) -> tuple[float, float] | None:
        """Return the frictions of translation and rotation of all bodies, 1/ps; None if types have their own."""
        if isinstance(self.friction, Mapping) or isinstance(self.rotational_friction, Mapping):
            return None
        return self.friction, self.rotational_friction

    @property
    def common_friction(self) -> float | None:
        """Return the friction of all motion of all bodies, 1/ps; None if there is none."""
        shared = self.shared_frictions
        return shared[0] if shared is not None and shared[0] == shared[1] else None

    def frictions(self, bodies: BodySet) -> np.ndarray:
        """Return frictions of translation along the axes of each body, and of rotation about them, (6, n), 1/ps.

        Raises:
            ValueError: the frictions are not those of the bodies' types, or differ where a constraint joins bodies.
        """
        along = frictions_of("frictionCoeff", self.friction, bodies)
        about = frictions_of("rotationalFriction", self.rotational_friction, bodies)
        refuse_uneven_friction("frictionCoeff", along, bodies)
        return np.concatenate([along, about])

    def velocity(self, time: str, friction: str, thermal: str) -> str:
        """Return the new value of a velocity v of a mass m, as an expression of OpenMM's CustomIntegrator.

        It is evaluated for each degree of freedom separately, and velocities are constrained before and after it.

        Args:
            time, friction, thermal: expressions of its duration, of its friction, and of kT.
        """
        return f"exp(-{friction}*{time})*v + sqrt((1 - exp(-2*{friction}*{time}))*{thermal}/m)*gaussian"

    def operator(self, bodies: BodySet, tally: Tally) -> Operator:
        """Return the thermostat as an operator of a splitting scheme.

        Args:
            bodies: bodies on which it acts.
            tally: source of random numbers, which counts heat and draws.
        """
        shared, inverses = self.shared_frictions, (bodies.inverse_masses, bodies.inverse_moments)
        if shared is None:
            kernel, arguments = kernels.bodies.bathe_by_axes, self._arguments_by_axes(bodies)
        else:
            kernel, arguments = kernels.bodies.bathe, self._shared_arguments(*shared, bodies)

        def apply(state: BodyState, h: float) -> BodyState:
            noise = tally.noise().standard_normal((6, bodies.n))
            p, L = np.empty(state.p.shape), np.empty(state.L.shape)
            gain = kernel(bodies.n, state.p, state.A, state.L, *arguments(h), noise, *inverses, p, L)
            tally.draws += 1
            tally.heat += gain
            return BodyState(state.q, p, state.A, L, state.cache)

        return apply

    def _shared_arguments(self, friction: float, rotational_friction: float, bodies: BodySet) -> Arguments:
        """Return those of a kernel for frictions that all bodies share: factors of momenta, and widths of noise."""
        thermal = GAS_CONSTANT * self.temperature
        spreads = np.sqrt(thermal * bodies.moving_masses), np.sqrt(thermal * bodies.moments * bodies.turns)

        @lru_cache(maxsize=4)
        def arguments(h: float) -> tuple[Any, ...]:
            damping, width = decay(friction, h)
            rotational_damping, rotational_width = decay(rotational_friction, h)
            widths = np.concatenate([width * spreads[0], rotational_width * spreads[1]])
            return damping, rotational_damping, widths

        return arguments

    def _arguments_by_axes(self, bodies: BodySet) -> Arguments:
        """Return those of a kernel for frictions along and about the axes of each body."""
        thermal = GAS_CONSTANT * self.temperature
        spreads = np.sqrt(thermal * np.concatenate([bodies.masses[None], bodies.moments * bodies.turns]))
        frictions, translates = self.frictions(bodies), bodies.translates
        return lambda h: (abs(h), frictions, spreads, translates)


def decay(friction: float, h: float) -> tuple[float, float]:
    """Return the factor of a momentum in a time h, and the standard deviation of noise over the thermal one."""
    return math.exp(-friction * abs(h)), math.sqrt(-math.expm1(-2 * friction * abs(h)))
