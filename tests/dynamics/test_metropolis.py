"""Hybrid Monte Carlo samples exactly at steps so long that half of the trials are rejected."""

from __future__ import annotations

import math

import numpy as np
import pytest

from openmm_sier.dynamics import metropolis, operators
from openmm_sier.dynamics.bodies import BodyState, RigidBodies, Species
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.metropolis import HybridMonteCarlo, SampledState
from openmm_sier.dynamics.schemes import SIER2, SIER4G
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck

TEMPERATURE = 300.0
KT = GAS_CONSTANT * TEMPERATURE


class Wells:
    """Points in harmonic wells of several frequencies: V = sum of k q^2/2, and <k q^2> = kT for each coordinate."""

    def __init__(self, n=6):
        self.springs = 1000.0 * np.arange(1, n + 1)
        self.bodies = RigidBodies([Species(np.arange(n)[:, None], np.ones(1), np.zeros((3, 1)), np.zeros(3))], n)

    def forces(self, q, A):
        return -self.springs * q, np.zeros_like(q)

    def potential(self, state):
        return 0.5 * float((self.springs * state.q**2).sum())

    def start(self):
        n = self.bodies.n
        zero = np.zeros((3, n))
        return BodyState(zero, zero.copy(), np.repeat(np.eye(3)[:, :, None], n, axis=2), zero.copy())

    def observed(self, state):
        return self.springs * state.q**2 / KT


class Dipoles(Wells):
    """Asymmetric bodies with a dipole along an axis that is none of their own, in a field along z."""

    FIELD = 3 * KT

    def __init__(self, n=6):
        masses = np.array([16.0, 1.0, 2.0])
        sites = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [-0.02, 0.09, 0.0]])
        self.bodies = RigidBodies([Species.from_coordinates(np.arange(3 * n).reshape(n, 3), masses, sites)], 3 * n)
        self.axis = np.array([0.6, 0.0, 0.8])

    def cosines(self, A):
        return np.einsum("k,kxn->xn", self.axis, A)[2]

    def forces(self, q, A):
        x, y, _ = np.einsum("k,kxn->xn", self.axis, A)
        return np.zeros_like(q), self.FIELD * np.stack([y, -x, np.zeros_like(x)])

    def potential(self, state):
        return -self.FIELD * float(self.cosines(state.A).sum())

    def observed(self, state):
        return self.cosines(state.A)


def sampled(model, sampler, scheme, h, trials, at_rest=False):
    """What is observed after every trial, and the last state."""
    forces = operators.CachedForces(model.forces)
    advance = operators.stepper(scheme, operators.body_operators(model.bodies, forces), h)
    step = sampler.stepper(model.bodies, advance, model.potential, h, at_rest)
    state, found = model.start(), []
    for _ in range(trials):
        for _ in range(sampler.steps):
            state = step(state)
        found.append(model.observed(state))
    return np.array(found), state
