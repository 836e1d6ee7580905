"""Hybrid Monte Carlo samples exactly at steps so long that half of the trials are rejected."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest

from openmm_sier.dynamics import metropolis, operators
from openmm_sier.dynamics.barostat import MonteCarloVolumeMove
from openmm_sier.dynamics.bodies import BodyState, NotFiniteError, RigidBodies, Species
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.metropolis import HybridMonteCarlo, NoEnergyError, SampledState, reversal_error
from openmm_sier.dynamics.schemes import SIER2, SIER4G, Scheme
from openmm_sier.dynamics.stages import DRIFT, KICK
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck
from openmm_sier.measure.statistics import mean_and_error

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

    FIELD = 3.0  # In kT for each dipole.

    def __init__(self, n=6):
        masses = np.array([16.0, 1.0, 2.0])
        sites = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [-0.02, 0.09, 0.0]])
        self.bodies = RigidBodies([Species.from_coordinates(np.arange(3 * n).reshape(n, 3), masses, sites)], 3 * n)
        self.axis = np.array([0.6, 0.0, 0.8])

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
    """A chain of trials: how they are made, and how many steps each has."""

    model: Wells
    scheme: Scheme
    h: float
    steps: int = 3
    friction: float = math.inf
    at_rest: bool = False

    @property
    def operations(self):
        found = operators.body_operators(self.model.bodies, operators.CachedForces(self.model.forces))
        return metropolis.at_rest(self.model.bodies, found) if self.at_rest else found

    @property
    def advance(self):
        return operators.stepper(self.scheme, self.operations, self.h)

    @property
    def step(self):
        bath, bodies = self.bath, self.model.bodies
        refresh = metropolis.refreshment(bath.operator(bodies), bodies, self.at_rest)
        sampler = HybridMonteCarlo(bath, refresh, lambda: self.steps)
        return sampler.stepper(bodies, self.advance, self.model.potential, self.h)

    @property
    def bath(self):
        return OrnsteinUhlenbeck(TEMPERATURE, self.friction, self.friction, seed=17)

    def samples(self, trials, start=None):
        """The states after each of so many trials."""
        step, state = self.step, start or self.model.start()
        for _ in range(trials):
            for _ in range(self.steps):
                state = step(state)
            yield state
