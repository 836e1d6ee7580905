"""Models of which hybrid Monte Carlo's averages are known, and chains of trials of them."""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass, replace

import numpy as np

from openmm_sier.dynamics import metropolis, operators
from openmm_sier.dynamics.bodies import BodyState, NotFiniteError, RigidBodies
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.metropolis import HybridMonteCarlo
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.species import Species
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck

TEMPERATURE = 300.0
KT = GAS_CONSTANT * TEMPERATURE


class Wells:
    """Points in harmonic wells of several frequencies: V = sum of k q^2/2."""

    def __init__(self, n=6, farthest=math.inf):
        self.springs = 1000.0 * np.arange(1, n + 1)
        self.bodies = RigidBodies([Species(np.arange(n)[:, None], np.ones(1), np.zeros((3, 1)), np.zeros(3))], n)
        self.farthest = farthest

    def forces(self, q, A):
        if not (self.energies(q) <= self.farthest).all():
            raise NotFiniteError(np.where(self.energies(q) <= self.farthest, q, np.nan))
        return -self.springs * q, np.zeros_like(q)

    def energies(self, q):
        """k q^2/kT of each coordinate, whose square root has a normal distribution of unit variance."""
        return self.springs * q**2 / KT

    def potential(self, state):
        return 0.5 * KT * float(self.energies(state.q).sum())

    def start(self):
        n = self.bodies.n
        zero = np.zeros((3, n))
        return BodyState(zero, zero.copy(), np.repeat(np.eye(3)[:, :, None], n, axis=2), zero.copy())

    def observed(self, state):
        return self.energies(state.q)


class Dipoles(Wells):
    """Asymmetric bodies with a dipole along an axis that is none of their own, in a field along z."""

    FIELD = 10.0  # In kT for each dipole.

    def __init__(self, n=6):
        masses = np.array([16.0, 1.0, 2.0])
        sites = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [-0.02, 0.09, 0.0]])
        self.bodies = RigidBodies([Species.from_coordinates(np.arange(3 * n).reshape(n, 3), masses, sites)], 3 * n)
        self.axis = np.array([0.6, 0.0, 0.8])

    def start(self):
        along_the_field = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
        return replace(super().start(), A=np.repeat(along_the_field[:, :, None], self.bodies.n, axis=2))

    def directions(self, A):
        return np.einsum("k,kxn->xn", self.axis, A)

    def forces(self, q, A):
        x, y, _ = self.directions(A)
        return np.zeros_like(q), self.FIELD * KT * np.stack([y, -x, np.zeros_like(x)])

    def potential(self, state):
        return -self.FIELD * KT * float(self.directions(state.A)[2].sum())

    def observed(self, state):
        return self.directions(state.A)[2]


@dataclass(frozen=True)
class Chain:
    """A chain of trials: how they are made, and the numbers of steps that they have by turns.

    A mode of which a trajectory is just half a period long never leaves its energy. Trajectories of several lengths
    leave no such mode.
    """

    model: Wells
    scheme: Scheme
    h: float
    steps: tuple[int, ...] = (2, 3, 4)
    friction: float = math.inf
    at_rest: bool = False
    rotation: operators.Rotation = exact
    seed: int = 17

    @property
    def operations(self):
        found = operators.body_operators(self.model.bodies, operators.CachedForces(self.model.forces), self.rotation)
        return metropolis.at_rest(self.model.bodies, found) if self.at_rest else found

    @property
    def advance(self):
        return operators.stepper(self.scheme, self.operations, self.h)

    @property
    def step(self):
        bath, bodies = self.bath, self.model.bodies
        refresh = metropolis.refreshment(bath.operator(bodies), bodies, self.at_rest)
        sampler = HybridMonteCarlo(bath, refresh, functools.partial(next, itertools.cycle(self.steps)))
        return sampler.stepper(bodies, self.advance, self.model.potential, self.h)

    @property
    def bath(self):
        return OrnsteinUhlenbeck(TEMPERATURE, self.friction, self.friction, self.seed)

    def samples(self, trials, start=None):
        """The states after each of so many trials."""
        step, state = self.step, start or self.model.start()
        for _ in range(trials):
            state = whole_trial(step, state)
            yield state


def whole_trial(step, state):
    """The sample at the end of a trial."""
    state = step(state)
    while state.trial is not None:
        state = step(state)
    return state
