"""Operations on the phase point of what an engine moves, once for all engines."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from openmm_sier.dynamics.barostat import MoleculeCentres
from openmm_sier.dynamics.bodies import BodyState, RigidBodies


class Movers:
    """What an engine moves.

    Attributes:
        bodies: by whose numbers the engine knows what moves: rigid and point bodies, or the massive atoms alone.
    """

    def __init__(self, bodies: RigidBodies, molecules: Callable[[], Sequence[Sequence[int]]]):
        """
        Args:
            bodies: see above.
            molecules: gives the particle indices of each molecule when they are needed.
        """
        self.bodies, self._molecules = bodies, molecules

    @cached_property
    def centres(self) -> MoleculeCentres:
        """Centres of mass of the molecules, each of which moves as a whole with the volume."""
        return MoleculeCentres(self.bodies, self._molecules())


class PhasePoint(ABC):
    """The phase point of an engine, which it gives and takes as a `BodyState`, and operations on it.

    Attributes:
        movers: what the phase point is of.
    """

    movers: Movers

    @property
    @abstractmethod
    def point(self) -> BodyState:
        """The phase point of `movers` at the last completed step, with the heat and the draws counted so far."""

    @abstractmethod
    def change(self, operation: Callable[[BodyState], BodyState]) -> None:
        """Replace the phase point by what an operation makes of it; arrays that both share stay as they are."""

    @abstractmethod
    def _scale_box(self, factor: float) -> None:
        """Multiply the edges of the box."""

    @property
    def draws(self) -> int:
        """Number of draws of random numbers so far."""
        return self.point.draws

    @draws.setter
    def draws(self, number: int) -> None:
        self.change(lambda point: replace(point, draws=number))

    @property
    def mass(self) -> float:
        """Mass of all that moves, dalton."""
        return self.movers.bodies.mass

    @property
    def molecules(self) -> int:
        """Number of molecules, each of which moves as a whole with the volume."""
        return self.movers.centres.count

    def kinetic_energy(self) -> float:
        """Kinetic energy, kJ/mol."""
        return sum(self.movers.bodies.kinetic_energies(self.point))

    def centre_velocity(self) -> np.ndarray:
        """Velocity of the centre of mass, (3,), nm/ps."""
        return self.movers.bodies.centre_velocity(self.point.p)

    def shift_velocities(self, velocity: np.ndarray) -> None:
        """Add a velocity, (3,), nm/ps, to all that moves, and its energy to the heat."""
        self.change(lambda point: self.movers.bodies.shifted(point, velocity))

    def scale_velocities(self, factor: float) -> None:
        """Multiply all velocities by a factor, and add the energy that they gain to the heat."""
        gained = (factor**2 - 1) * self.kinetic_energy()
        self.change(lambda point: replace(point, p=factor * point.p, L=factor * point.L, heat=point.heat + gained))

    def scale(self, factor: float) -> None:
        """Multiply the edges of the box and the centres of mass of all molecules; the clock stays."""
        self._scale_box(factor)
        self.change(lambda point: replace(point, q=point.q + (factor - 1) * self.movers.centres(point.q)))

    def add_heat(self, energy: float) -> None:
        """Count energy as heat, kJ/mol."""
        self.change(lambda point: replace(point, heat=point.heat + energy))
