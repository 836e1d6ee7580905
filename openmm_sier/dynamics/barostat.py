"""Constant pressure: Monte Carlo moves of the volume, in which molecules keep their shape and orientation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from openmm_sier.dynamics.bodies import RigidBodies, molecule_of_atoms
from openmm_sier.dynamics.noise import generator

#: Largest change of ln V, times the square root of the number of molecules. In these units ln V fluctuates by 1 in an
#: ideal gas and by 0.25 in water, where half of the moves are accepted.
LARGEST_MOVE = 0.5


class MonteCarloVolumeMove(NamedTuple):
    """A move of the volume by the method of OpenMM's MonteCarloBarostat.

    Unlike OpenMM's it remembers nothing of earlier ones: moves have a fixed largest size, and their random numbers are
    a function of a seed and of the number of draws so far. So a restart is bit-identical.

    Source: Chow and Ferguson, Comput. Phys. Commun. 91, 283 (1995), with ln V for V.

    Attributes:
        molecules: number of molecules, each of which is moved as a whole.
        growth: change of ln V.
        chance: random number in [0, 1) that decides.
    """

    molecules: int
    growth: float
    chance: float

    @classmethod
    def drawn(cls, seed: int, draw: int, molecules: int) -> MonteCarloVolumeMove:
        """A move to be tried; seed and draw fix the random numbers."""
        place, chance = generator(seed, draw, stream=1).random(2)
        return cls(molecules, LARGEST_MOVE / math.sqrt(molecules) * (2 * place - 1), chance)

    @property
    def factor(self) -> float:
        """By which edges of the box and centres of molecules are multiplied."""
        return math.exp(self.growth / 3)

    def is_accepted(self, gain: float, pressure: float, volume: float, thermal: float) -> bool:
        """The Metropolis rule for a move in ln V, in which the centres of n molecules are scaled with the box.

        Args:
            gain: change of the potential energy, kJ/mol.
            pressure: kJ/mol/nm^3.
            volume: before the move, nm^3.
            thermal: kT, kJ/mol.
        """
        work = pressure * volume * math.expm1(self.growth)
        cost = gain + work - (self.molecules + 1) * thermal * self.growth
        return bool(cost <= -thermal * math.log(1 - self.chance))


class MoleculeCentres:
    """For each body the centre of mass of its molecule.

    Attributes:
        count: number of molecules.
    """

    def __init__(self, bodies: RigidBodies, molecules: Sequence[Sequence[int]]):
        """
        Args:
            bodies: rigid and point bodies. One that joins several molecules belongs to the first.
            molecules: particle indices of what is moved as a whole.
        """
        first = np.concatenate([species.atoms[:, 0] for species in bodies.species])
        owner = molecule_of_atoms(molecules, bodies.n_particles)[first]
        self._owner = np.unique(owner, return_inverse=True)[1]
        self._weights = bodies.masses / np.bincount(self._owner, bodies.masses)[self._owner]
        self.count = int(self._owner.max()) + 1

    def __call__(self, q: np.ndarray) -> np.ndarray:
        """Centres, (3, n), at centres of bodies (3, n)."""
        return np.stack([np.bincount(self._owner, self._weights * x)[self._owner] for x in q])
