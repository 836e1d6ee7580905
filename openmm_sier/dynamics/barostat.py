"""Constant pressure: Monte Carlo moves of the volume, in which molecules keep their shape and orientation."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from openmm_sier.dynamics.bodies import BodyState, RigidBodies, molecule_of_atoms
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.noise import generator
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck

#: Largest change of ln V, times the square root of the number of molecules. In these units ln V fluctuates by 1 in an
#: ideal gas and by 0.25 in water, where half of the moves are accepted.
LARGEST_MOVE = 0.5

#: (centres of the bodies, factor by which the box's edges are stretched) -> potential energy, kJ/mol
Energy = Callable[[np.ndarray, float], float]

#: (state, volume in nm^3, energy) -> state and the factor by which edges are to be stretched, 1 where nothing changed
VolumeMove = Callable[[BodyState, float, Energy], tuple[BodyState, float]]


class MonteCarloVolumeMove:
    """Constant pressure by the method of OpenMM's MonteCarloBarostat.

    Unlike OpenMM's it keeps no state of its own: moves have a fixed largest size, and their random numbers are a
    function of the thermostat's seed and of the number of draws so far, which travel with the state of the bodies. So a
    restart is bit-identical.

    Source: Chow and Ferguson, Comput. Phys. Commun. 91, 283 (1995), with ln V for V.

    Attributes:
        pressure: kJ/mol/nm^3.
        interval: steps from one attempted move to the next; with hybrid Monte Carlo, trials.
    """

    def __init__(self, pressure: float, interval: int, thermostat: OrnsteinUhlenbeck):
        self.pressure = pressure
        self.interval = interval
        self._thermostat = thermostat

    def operator(self, bodies: RigidBodies, molecules: Sequence[Sequence[int]]) -> VolumeMove:
        """The move of a set of bodies.

        Args:
            bodies: the rigid and point bodies.
            molecules: particle indices of what is moved as a whole.
        """
        owner = _molecule_of(bodies, molecules)
        n = int(owner.max()) + 1
        weights = bodies.masses / np.bincount(owner, bodies.masses)[owner]
        largest = LARGEST_MOVE / math.sqrt(n)

        def move(state: BodyState, volume: float, energy: Energy) -> tuple[BodyState, float]:
            place, luck = generator(self._thermostat.seed, state.draws, stream=1).random(2)
            growth = largest * (2 * place - 1)
            factor = math.exp(growth / 3)
            centres = np.stack([np.bincount(owner, weights * x)[owner] for x in state.q])
            q = state.q + (factor - 1) * centres
            before = energy(state.q, 1.0)
            gain = energy(q, factor) - before
            kT = GAS_CONSTANT * self._thermostat.temperature
            # A move in ln V, of n centres that are scaled with the box.
            cost = gain + self.pressure * volume * math.expm1(growth) - (n + 1) * kT * growth
            state = replace(state, draws=state.draws + 1)
            if not cost <= -kT * math.log(1 - luck):
                return state, 1.0
            return replace(state, q=q, heat=state.heat + gain), factor

        return move


def _molecule_of(bodies: RigidBodies, molecules: Sequence[Sequence[int]]) -> np.ndarray:
    """For each body the number of its molecule, without gaps. A body that joins several belongs to the first."""
    first = np.concatenate([species.atoms[:, 0] for species in bodies.species])
    return np.unique(molecule_of_atoms(molecules, bodies.n_particles)[first], return_inverse=True)[1]
