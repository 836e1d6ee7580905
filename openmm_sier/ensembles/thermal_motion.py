"""The part of all motion that is heat, and its kinetic energy, which ensembles draw as a whole."""

import math
from dataclasses import dataclass

import numpy as np

from openmm_sier.engines.protocol import Engine


@dataclass(frozen=True)
class ThermalMotion:
    """The motion that is heat, whose kinetic energy can be changed.

    Where the total momentum is conserved, the motion of the centre of mass is no heat and stays as it is.

    Attributes:
        engine: whose velocities it changes.
        freedoms: number of degrees of freedom that share the heat; need not be a whole number.
        centre: velocity of the centre of mass that is no heat, (3,), nm/ps.
    """

    engine: Engine
    freedoms: float
    centre: np.ndarray

    @classmethod
    def of(cls, engine: Engine, conserved: bool) -> "ThermalMotion":
        """Return the thermal motion of now; `conserved` tells whether the total momentum is conserved."""
        freedoms = engine.degrees_of_freedom(conserved)
        # Without masses there is no centre.
        centre = engine.centre_velocity() if conserved and freedoms > 0 else np.zeros(3)
        return cls(engine, freedoms, centre)

    @property
    def energy(self) -> float:
        """Return its kinetic energy, kJ/mol."""
        return self.engine.kinetic_energy() - 0.5 * self.engine.moving.mass * float(self.centre @ self.centre)

    def scale(self, factor: float) -> None:
        """Multiply its velocities by a factor. The energy that they gain is heat of the tally."""
        self.engine.scale_velocities(factor, self.centre)

    def scale_to(self, energy: float) -> None:
        """Scale its velocities so that they have a kinetic energy, kJ/mol."""
        self.scale(math.sqrt(energy / self.energy))
