"""The thermostat: its distribution, its noise, its bookkeeping."""

import numpy as np
import pytest
from scipy import stats

from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.tally import Tally
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck
from openmm_sier.dynamics.vectors import body_frame
from tests.support import molecules

TEMPERATURE = 297.0
THERMAL = GAS_CONSTANT * TEMPERATURE

KINDS = (molecules.WATER, molecules.CARBON_DIOXIDE, molecules.METHANE, molecules.ION)


@pytest.mark.parametrize("kind", KINDS)
def test_canonical_distribution_is_reached_from_any_start(kind):
    n = 20000
    bodies, state = molecules.ensemble(kind, n)
    thermostat = OrnsteinUhlenbeck(TEMPERATURE, 5.0, 5.0).operator(bodies, Tally(1))
    for _ in range(10):
        state = thermostat(state, 1.0)  # the start is forgotten by exp(-50)
    # A part of the momenta is kept: noise of a wrong size shows here alone.
    state = thermostat(state, 0.1)
    moments = bodies.species[0].moments
    samples = [(state.p[i], bodies.species[0].mass) for i in range(3)]
    samples += [(body_frame(state.A, state.L)[i], moments[i]) for i in range(3) if moments[i] > 0]
    for values, inertia in samples:
        # A moment of a wrong axis is off by 30 % or more, 45 standard errors, and has a far smaller value. Rounding may
        # decide signs of axes, and so what noise the bodies get.
        assert stats.kstest(values / np.sqrt(THERMAL * inertia), "norm").pvalue > 1e-11
    if kind == molecules.CARBON_DIOXIDE:
        assert np.abs(body_frame(state.A, state.L)[0]).max() < 1e-12
    if kind == molecules.ION:
        assert not state.L.any()


def test_it_forgets_at_the_friction():
    n = 20000
    bodies, state = molecules.ensemble(molecules.WATER, n)
    after = OrnsteinUhlenbeck(TEMPERATURE, 2.0, 7.0).operator(bodies, Tally(2))(state, 0.1)
    # Seven standard errors are passed by one sound number of 4e11.
    error = np.sqrt(THERMAL * bodies.species[0].mass / n)
    assert np.abs(after.p.mean(axis=1) - 20.0 * np.exp(-0.2)).max() < 7 * error
    tilde = body_frame(after.A, after.L)
    errors = np.sqrt(THERMAL * bodies.species[0].moments / n)
    assert (np.abs(tilde.mean(axis=1) - np.exp(-0.7)) < 7 * errors).all()


def test_noise_depends_on_seed_and_draw_alone():
    bodies, state = molecules.ensemble(molecules.WATER, 10)
    made = {}
    for name, seed in (("one", 1), ("again", 1), ("other", 2)):
        tally = Tally(seed)
        bath = OrnsteinUhlenbeck(TEMPERATURE, 1.0, 1.0).operator(bodies, tally)
        made[name] = bath(state, 0.1).p, bath(state, 0.1).p
        assert tally.draws == 2
    assert np.array_equal(made["one"], made["again"])
    assert not np.allclose(made["one"][0], made["other"][0])
    assert not np.allclose(*made["one"])


def test_heat_is_the_kinetic_energy_that_bodies_gain():
    bodies, state = molecules.ensemble(molecules.WATER, 10)
    tally = Tally(3)
    after = OrnsteinUhlenbeck(TEMPERATURE, 1.0, 2.0).operator(bodies, tally)(state, 0.5)
    gained = sum(bodies.kinetic_energies(after)) - sum(bodies.kinetic_energies(state))
    # Sums of 60 energies of up to 1e4 kJ/mol, each rounded to 1e-16 of it.
    assert tally.heat == pytest.approx(gained, abs=1e-9)
