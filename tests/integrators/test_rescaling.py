"""Stochastic velocity rescaling: beside a frozen atom, unchanged quantities, its bookkeeping."""

import numpy as np
import openmm
import pytest
from openmm import unit
from scipy import stats

from openmm_sier import SIER2, SIER4G, SIERIntegrator, SIERThermostatIntegrator
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.ensembles import VelocityRescaling
from tests.support.restarts import assert_same
from tests.support.seeded import seeded
from tests.support.systems import rotors
from tests.support.waters import context_at, energies, phase_point

TEMPERATURE = 297.0
both_engines = pytest.mark.parametrize("engine", ["exact", "native"])


def integrator(h=0.002, rate=5.0, every=4, scheme=SIER2, seed=7, engine="auto", **options):
    bath = VelocityRescaling(TEMPERATURE, rate, every, **options)
    return seeded(SIERThermostatIntegrator(bath, h, scheme, engine=engine), seed)


# --- the distribution -------------------------------------------------------------------------------------------------


@both_engines
def test_beside_a_frozen_atom_the_centre_of_mass_has_its_heat(engine):
    """With a high rate each scaling draws a kinetic energy that is independent of the last one.

    Of 6 + 7 degrees of freedom none is conserved. One less shifts the mean by 7.7 %, and 600 samples allow 6.4 %, which
    is four standard errors. A right sampler fails the test of its whole distribution with a probability of 1e-9.
    """
    system, positions = rotors(frozen=True)
    freedoms = 13
    result = integrator(rate=1e6, every=1, engine=engine)
    context = context_at(system, result, (positions, np.zeros_like(positions)))
    context.setVelocitiesToTemperature(TEMPERATURE, 3)
    masses = np.array([system.getParticleMass(i).value_in_unit(unit.dalton) for i in range(system.getNumParticles())])
    outcome = []
    for _ in range(600):
        result.step(1)
        v = phase_point(context)[1]
        outcome.append((masses @ (v**2).sum(axis=1)) / (GAS_CONSTANT * TEMPERATURE))
    assert stats.kstest(outcome, stats.chi2(freedoms).cdf).pvalue > 1e-9
    assert np.mean(outcome) == pytest.approx(freedoms, rel=4 * np.sqrt(2 / freedoms / 600))


# --- what it leaves alone ---------------------------------------------------------------------------------------------


@both_engines
def test_with_a_rate_of_zero_it_is_the_nve_trajectory_bit_for_bit(cluster, engine):
    _, system, point = cluster
    ends = []
    for made in (integrator(rate=0.0, engine=engine), SIERIntegrator(0.002, SIER2, engine=engine)):
        context = context_at(system, made, point, steps=20)
        ends.append(phase_point(context))
    assert_same(*ends)


@both_engines
def test_energy_less_heat_and_the_total_momentum_are_conserved(cluster, engine):
    """The energy by as much as at constant energy, some 1e-5 kJ/mol by SIER4G at 1 fs; the heat is 50 kJ/mol.

    What counts begins after a step, which has moved the atoms onto their constraints.
    """
    _, system, point = cluster
    result = integrator(h=0.001, rate=50.0, every=3, scheme=SIER4G, engine=engine)
    point = point[0], 0.5 * point[1] + np.array([0.3, 0.0, -0.1])
    context = context_at(system, result, point)
    masses = np.array([system.getParticleMass(i).value_in_unit(unit.dalton) for i in range(system.getNumParticles())])
    momentum = masses @ point[1]
    result.step(1)
    start = sum(energies(context))
    result.step(60)
    heat = result.getHeat().value_in_unit(unit.kilojoule_per_mole)
    assert abs(heat) > 10
    # The native engine conserves momentum as far as it solves the constraints.
    assert np.abs(masses @ phase_point(context)[1] - momentum).max() < 1e-5
    assert sum(energies(context)) - heat == pytest.approx(start, abs=1e-3)


# --- what users set, and what is refused ------------------------------------------------------------------------------


def test_settings_can_be_read_and_changed():
    result = integrator(pressure=2 * unit.bar, interval=6)
    result.setTemperature(310 * unit.kelvin)
    copy = openmm.XmlSerializer.clone(result)
    for each in (result, copy):
        assert isinstance(each, SIERThermostatIntegrator)
        assert each.getTemperature() == 310 * unit.kelvin
        assert each.getPressure() == 2 * unit.bar
        assert each.getBarostatInterval() == 6
        assert each.scheme == SIER2


@both_engines
def test_velocities_that_are_all_zero_are_refused(engine):
    system, positions = rotors()
    result = integrator(every=1, engine=engine)
    context = context_at(system, result, (positions, np.zeros_like(positions)))
    with pytest.raises(openmm.OpenMMException, match="setVelocitiesToTemperature"):
        result.step(1)
    assert context.getStepCount() == 0
