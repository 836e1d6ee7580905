"""Heat baths within steps, and the exact Ornstein-Uhlenbeck process on momenta and body-frame angular momenta."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from openmm_sier.dynamics import kernels
from openmm_sier.dynamics.bodies import BodySet, BodyState
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.operators import Operator
from openmm_sier.dynamics.tally import Tally


@dataclass(frozen=True)
class Thermostat(ABC):
    """Heat bath within the steps of a scheme: an operator that changes only momenta.

    Attributes:
        temperature: temperature, K.
        friction: friction of translation, 1/ps.
        rotational_friction: friction of rotation, 1/ps.
    """

    temperature: float
    friction: float
    rotational_friction: float

    @abstractmethod
    def operator(self, bodies: BodySet, tally: Tally) -> Operator:
        """Return the thermostat as an operator of a splitting scheme.

        Args:
            bodies: bodies on which it acts.
            tally: source of random numbers, which counts heat and draws.
        """

    def velocity(self, time: str, friction: str, thermal: str) -> str:
        """Return the new value of a velocity v of a mass m, as an expression of OpenMM's CustomIntegrator.

        It is evaluated for each degree of freedom separately, and velocities are constrained before and after it.

        Args:
            time, friction, thermal: expressions of its duration, of its friction, and of kT.

        Raises:
            ValueError: there is no such expression, so that only the exact engine supports this bath.
        """
        raise ValueError(f"OpenMM cannot execute the heat bath {type(self).__name__} in a CustomIntegrator")


class OrnsteinUhlenbeck(Thermostat):
    """Langevin thermostat for rigid bodies.

    Momenta and body-frame angular momenta follow dx = -friction x dt + sqrt(2 friction k_B T M) dW with M the mass
    or the principal moment, which is solved exactly for any time (Bussi and Parrinello, Phys. Rev. E 75, 056707 (2007)
    for point particles; Davidchack, Ouldridge and Tretyakov, J. Chem. Phys. 142, 144114 (2015) for rigid bodies).
    """

    def velocity(self, time: str, friction: str, thermal: str) -> str:
        return f"exp(-{friction}*{time})*v + sqrt((1 - exp(-2*{friction}*{time}))*{thermal}/m)*gaussian"

    def operator(self, bodies: BodySet, tally: Tally) -> Operator:
        thermal = GAS_CONSTANT * self.temperature
        spreads = np.sqrt(thermal * np.broadcast_to(bodies.masses, (3, bodies.n))), np.sqrt(thermal * bodies.moments)
        inverses = bodies.inverse_masses, bodies.inverse_moments

        @lru_cache(maxsize=4)
        def factors(h: float) -> tuple[tuple[float, float], np.ndarray]:
            """Return the factors of momenta and angular momenta in a time h, and the standard deviations of noise."""
            damping, width = decay(self.friction, h)
            rotational_damping, rotational_width = decay(self.rotational_friction, h)
            return (damping, rotational_damping), np.concatenate([width * spreads[0], rotational_width * spreads[1]])

        def apply(state: BodyState, h: float) -> BodyState:
            noise = tally.noise().standard_normal((6, bodies.n))
            damping, widths = factors(h)
            p, L = np.empty(state.p.shape), np.empty(state.L.shape)
            moving = state.p, state.A, state.L
            gain = kernels.bodies.bathe(bodies.n, *moving, *damping, widths, noise, *inverses, p, L)
            tally.draws += 1
            tally.heat += gain
            return BodyState(state.q, p, state.A, L, state.cache)

        return apply


def decay(friction: float, h: float) -> tuple[float, float]:
    """Return the factor of a momentum in a time h, and the standard deviation of noise over the thermal one."""
    return math.exp(-friction * abs(h)), math.sqrt(-math.expm1(-2 * friction * abs(h)))
