"""Stochastic velocity rescaling: its distribution, unchanged quantities, its bookkeeping, and restarts."""

import numpy as np
import openmm
import pytest
from openmm import unit
from scipy import stats

from openmm_sier import SIER2, SIER4G, SIERIntegrator, SIERThermostatIntegrator
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.ensembles import VelocityRescaling
from tests.support.restarts import assert_same, everything
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
@pytest.mark.parametrize("frozen", [False, True], ids=["conserved momentum", "frozen atom"])
def test_kinetic_energy_is_canonical(engine, frozen):
    """With a high rate each scaling draws a kinetic energy that is independent of the last one.

    Of 6 + 7 degrees of freedom three belong to the centre of mass, whose motion is no heat where the momentum is
    conserved. One degree more or less shifts the mean by 10 or 7.7 %; 600 samples allow 7.3 or 6.4 %, which is four
    standard errors. A right sampler fails the test of its whole distribution for one seed in a thousand.
    """
    system, positions = rotors(frozen)
    freedoms = 13 if frozen else 10
    result = integrator(rate=1e6, every=1, engine=engine)
    context = context_at(system, result, (positions, np.zeros_like(positions)))
    context.setVelocitiesToTemperature(TEMPERATURE, 3)
    masses = np.array([system.getParticleMass(i).value_in_unit(unit.dalton) for i in range(system.getNumParticles())])
    centre, outcome = None, []
    for _ in range(600):
        result.step(1)
        v = phase_point(context)[1]
        moving = masses @ v / masses.sum()
        if not frozen:
            centre = moving if centre is None else centre
            assert np.abs(moving - centre).max() < 1e-9
            v = v - moving * (masses > 0)[:, None]
        outcome.append((masses @ (v**2).sum(axis=1)) / (GAS_CONSTANT * TEMPERATURE))
    assert stats.kstest(outcome, stats.chi2(freedoms).cdf).pvalue > 1e-3
    assert np.mean(outcome) == pytest.approx(freedoms, rel=4 * np.sqrt(2 / freedoms / 600))


def test_the_kinetic_energy_forgets_at_the_rate():
    """Its correlation is the fraction that is kept, and its variance that of the canonical ensemble.

    20,000 draws of which each keeps half have the information of some 7000; the errors are four standard ones.
    """
    bath, freedoms, kept = VelocityRescaling(TEMPERATURE, 1.0), 5.0, 0.5
    noise, energy, result = np.random.default_rng(1), 5.0, []
    for _ in range(20000):
        energy *= bath._factor(energy, freedoms, kept, noise) ** 2
        result.append(2 * energy / (GAS_CONSTANT * TEMPERATURE))
    values = np.array(result)
    assert values.mean() == pytest.approx(freedoms, rel=4 * np.sqrt(2 / freedoms / 7000))
    # The fourth central moment of this distribution makes the relative error of its variance sqrt((2 + 12/5)/n).
    assert values.var() == pytest.approx(2 * freedoms, rel=4 * np.sqrt(4.4 / 7000))
    correlation = np.corrcoef(values[:-1], values[1:])[0, 1]
    assert correlation == pytest.approx(kept, abs=4 / np.sqrt(7000))


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


# --- restarts ---------------------------------------------------------------------------------------------------------


def test_a_step_that_fails_takes_its_scaling_back(cluster):
    """A scaling and the step after it are made both or neither, so that the noise is not used twice."""
    _, system, point = cluster
    result = integrator(every=1)
    context = context_at(system, result, point, steps=1)
    before = everything(context)
    engine = result.impl.engine
    propagate = engine.propagate

    def failing(*_):
        raise KeyboardInterrupt

    engine.propagate = failing
    result.impl.session.changed()
    with pytest.raises(KeyboardInterrupt):
        result.step(1)
    assert_same(everything(context), before)
    engine.propagate = propagate
    result.step(1)
    other = integrator(every=1)
    again = context_at(system, other, point, steps=2)
    assert_same(everything(context), everything(again))


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
