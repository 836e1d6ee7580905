"""Constant pressure: Monte Carlo moves of the volume, in which molecules keep their shape and orientation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.constraints.graph import joined
from openmm_sier.dynamics.noise import generator

#: Initial maximum change of ln V, times the square root of the number of molecules. In these units ln V fluctuates by 1
#: in an ideal gas and by 0.25 in water, where half of the moves are accepted.
FIRST_SIZE = 0.5

#: Largest change of ln V that is ever tried.
LARGEST_SIZE = 0.3

#: The size stays if so large a part of the moves is accepted, as in OpenMM's MonteCarloBarostat.
ACCEPTED = 0.25, 0.75

#: The largest factor of one change of the size.
LARGEST_CHANGE = 10.0

#: Numbers of moves after which the size is judged by those since the last time, whose number doubles each time.
#: After the last it is kept.
JUDGED = 10, 30, 70, 150, 310, 630, 1270, 2550


class MoveSize(NamedTuple):
    """Adaptive size of volume moves.

    Changing the size between moves breaks detailed balance. So the size changes ever more rarely, and not at all if
    enough moves are accepted or after the last of `JUDGED`.

    Attributes:
        largest: largest change of ln V.
        tried: number of moves so far.
        accepted: sum of the acceptance probabilities of moves since the last adaptation.
    """

    largest: float
    tried: int = 0
    accepted: float = 0.0

    @classmethod
    def first(cls, molecules: int) -> MoveSize:
        """Return the initial size of a run."""
        return cls(min(FIRST_SIZE / math.sqrt(molecules), LARGEST_SIZE))

    def after(self, probability: float) -> MoveSize:
        """Return the size after a move with the given acceptance probability."""
        tried, accepted = self.tried + 1, self.accepted + probability
        if tried not in JUDGED:
            return MoveSize(self.largest, tried, accepted)
        moves = (tried + JUDGED[0]) // 2
        return MoveSize(min(self.largest * _change(accepted / moves), LARGEST_SIZE), tried)


def _change(accepted: float) -> float:
    """Return the factor on the size of moves for an acceptance of one half, given the present acceptance.

    The acceptance of large moves is proportional to 1/size, and the rejection of small ones to the size.
    """
    least, most = ACCEPTED
    if accepted < least:
        return max(2 * accepted, 1 / LARGEST_CHANGE)
    if accepted > most:
        return min(1 / max(2 * (1 - accepted), 1 / LARGEST_CHANGE), LARGEST_CHANGE)
    return 1.0


class MonteCarloVolumeMove(NamedTuple):
    """Volume move of the method of OpenMM's MonteCarloBarostat.

    Its random numbers are a function of a seed and of the number of draws so far, so that a restart is bit-identical.

    Source: Chow and Ferguson, Comput. Phys. Commun. 91, 283 (1995), with ln V for V.

    Attributes:
        molecules: number of molecules, which move rigidly.
        growth: change of ln V.
        chance: random number in [0, 1) that decides on acceptance.
    """

    molecules: int
    growth: float
    chance: float

    @classmethod
    def drawn(cls, seed: int, draw: int, molecules: int, largest: float) -> MonteCarloVolumeMove:
        """Return a trial move with the random numbers of a seed and draw.

        Args:
            seed: seed of the run.
            draw: number of draws so far.
            molecules: number of molecules.
            largest: largest change of ln V.
        """
        place, chance = generator(seed, draw, stream=1).random(2)
        return cls(molecules, largest * (2 * place - 1), chance)

    @property
    def factor(self) -> float:
        """Factor on edges of the box and centres of molecules."""
        return math.exp(self.growth / 3)

    def probability(self, gain: float, pressure: float, volume: float, thermal: float) -> float:
        """Return the Metropolis acceptance probability of a move in ln V.

        The centres of n molecules are scaled with the box.

        Args:
            gain: change of the potential energy, kJ/mol.
            pressure: kJ/mol/nm^3.
            volume: volume before the move, nm^3.
            thermal: kT, kJ/mol.
        """
        work = pressure * volume * math.expm1(self.growth)
        cost = gain + work - (self.molecules + 1) * thermal * self.growth
        if cost <= 0:
            return 1.0
        # The energy of overlapping atoms may be NaN.
        return math.exp(-cost / thermal) if thermal and math.isfinite(cost) else 0.0

    def is_accepted(self, probability: float) -> bool:
        """Return whether a move with the given acceptance probability is accepted."""
        return 1 - self.chance <= probability


class MoleculeCentres:
    """Centres of mass of the molecules of bodies.

    Attributes:
        count: number of molecules.
    """

    def __init__(self, bodies: BodySet, molecules: Sequence[Sequence[int]]):
        """
        Args:
            bodies: rigid and point bodies. Molecules joined by a body count as one.
            molecules: particle indices of each molecule.
        """
        molecule = molecule_of_atoms(molecules, bodies.n_particles)
        of_atoms = [molecule[species.atoms] for species in bodies.species]
        components = joined(len(molecules), np.concatenate([_different(numbers) for numbers in of_atoms]))
        first = np.empty(bodies.n, dtype=np.int64)
        for numbers, columns in zip(of_atoms, bodies.columns, strict=True):
            first[columns] = numbers[:, 0]
        self._owner = np.unique(components[first], return_inverse=True)[1]
        self._weights = bodies.masses / np.bincount(self._owner, bodies.masses)[self._owner]
        self.count = int(self._owner.max()) + 1

    def __call__(self, q: np.ndarray) -> np.ndarray:
        """Return the centre of the molecule of each body, (3, n), for centres of bodies (3, n)."""
        return np.stack([np.bincount(self._owner, self._weights * x)[self._owner] for x in q])


def _different(molecules: np.ndarray) -> np.ndarray:
    """Return pairs of molecules that bodies join, from the molecules of their atoms, (m, k)."""
    pairs = np.stack([np.broadcast_to(molecules[:, :1], molecules.shape), molecules], axis=-1).reshape(-1, 2)
    return pairs[pairs[:, 0] != pairs[:, 1]]


def molecule_of_atoms(molecules: Sequence[Sequence[int]], n_particles: int) -> np.ndarray:
    """Return the molecule index of each particle, (N,).

    Args:
        molecules: particle indices of each molecule, as returned by `Context.getMolecules()`.
        n_particles: number of particles of the system.
    """
    numbers = np.zeros(n_particles, dtype=int)
    for number, atoms in enumerate(molecules):
        numbers[list(atoms)] = number
    return numbers
