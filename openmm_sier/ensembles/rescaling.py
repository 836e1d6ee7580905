"""Stochastic velocity rescaling: a heat bath that multiplies all velocities by one factor now and then."""

# Without this, annotations would import numpy.random, which is slow.
from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import openmm

from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.engines.protocol import Engine
from openmm_sier.ensembles.ensemble import ConstantTemperature, Move, make_number


@dataclass(frozen=True)
class VelocityRescaling(ConstantTemperature):
    """Keep a constant temperature by one factor on all velocities, drawn so that the kinetic energy is canonical.

    >>> integrator = SIERThermostatIntegrator(VelocityRescaling(300*kelvin, 1/picosecond), 4*femtoseconds)

    One factor on all velocities leaves their ratios as they are. So bodies that exchange no energy, as in an ideal gas
    or in separate wells, do not come to equilibrium with each other: use a Langevin bath for these.

    Between two scalings the motion is that at constant energy. So diffusion, viscosity and relaxation times are nearly
    those at constant energy, and a hot or cold start comes to the temperature within a few times 1/rate. Where the
    total momentum is conserved, the motion of the centre of mass stays as it is. With a rate of zero the trajectory is,
    bit for bit, that at constant energy.

    Source: Bussi, Donadio and Parrinello, J. Chem. Phys. 126, 014101 (2007), whose relaxation time tau is 1/rate.

    Attributes:
        temperature: in K.
        rate: rate at which the kinetic energy comes to its mean, 1/ps, not negative.
        every: number of steps from one scaling to the next, at least 1.
    """

    rate: float
    every: int = 10

    def __post_init__(self) -> None:
        super().__post_init__()
        make_number(self, "rate", "rate", "1/ps", least=0)
        make_number(self, "every", "every", least=1)

    @cached_property
    def moves(self) -> tuple[Move, ...]:
        return (*super().moves, Move(self.every, self._scale)) if self.rate else super().moves

    def _scale(self, engine: Engine) -> None:
        """Draw the kinetic energy anew, of which a fraction is kept."""
        kept = math.exp(-self.rate * self.every * engine.method.step)
        is_conserved = engine.conserves_momentum(self.has_friction)
        freedoms = engine.degrees_of_freedom(is_conserved)
        if freedoms > 0:
            # Where the total momentum is conserved, the motion of the centre of mass is no heat, and stays as it is.
            centre = engine.centre_velocity() if is_conserved else np.zeros(3)
            kinetic = engine.kinetic_energy() - 0.5 * float(engine.moving.moving_mass @ centre**2)
            engine.scale_velocities(self._factor(kinetic, freedoms, kept, engine.tally.noise()), centre)
        engine.tally.draws += 1

    def _factor(self, kinetic: float, freedoms: float, kept: float, noise: np.random.Generator) -> float:
        """Draw the factor on velocities, as an Ornstein-Uhlenbeck process of each would have it.

        It is the ratio of two norms, after the process and before. Along the old velocities, the new ones have a part
        that is kept and one normal deviate, and across them as many deviates as there are other degrees of freedom.
        """
        if not kinetic > 0:
            raise openmm.OpenMMException(
                "Velocities that are all zero cannot be scaled: draw them first with setVelocitiesToTemperature"
            )
        width = math.sqrt((1 - kept) * GAS_CONSTANT * self.temperature / (2 * kinetic))
        along = math.sqrt(kept) + width * noise.standard_normal()
        across = width * math.sqrt(noise.chisquare(freedoms - 1)) if freedoms > 1 else 0.0
        return math.copysign(math.hypot(along, across), along)
