"""The heat bath: its distribution, its noise, its bookkeeping, and the integrator that has it."""

import warnings

import numpy as np
import openmm
import pytest
from openmm import unit

from openmm_sier import (
    SIER2,
    SIER4,
    SIER4G,
    SIERIntegrator,
    SIERLangevinIntegrator,
    prepare_system,
)
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.ensembles import Langevin
from tests.support.flexible import chains
from tests.support.flexible_systems import FAST, system_of
from tests.support.seeded import seeded
from tests.support.silence import silence
from tests.support.systems import assembled, with_forces
from tests.support.waters import cluster_system, context_at, energies, periodic_system, phase_point, relaxed

TEMPERATURE = 297.0


def thermostat(h=0.002, friction=1.0, scheme=SIER2, seed=11, **options):
    return seeded(SIERLangevinIntegrator(TEMPERATURE, friction, h, scheme=scheme, **options), seed)


@pytest.mark.parametrize("scheme", [SIER2, SIER4, SIER4G], ids=lambda s: s.name)
def test_without_friction_it_is_the_nve_trajectory_bit_for_bit(cluster, scheme):
    _, system, point = cluster
    ends = []
    for integrator in (thermostat(scheme=scheme, friction=0.0), SIERIntegrator(0.002, scheme)):
        context = context_at(system, integrator, point, steps=50)
        ends.append(phase_point(context))
    assert np.array_equal(ends[0][0], ends[1][0])
    assert np.array_equal(ends[0][1], ends[1][1])


def test_settings_are_those_of_openmm():
    integrator = SIERLangevinIntegrator(300 * unit.kelvin, 2 / unit.picosecond, 4 * unit.femtosecond)
    reference = openmm.LangevinMiddleIntegrator(300 * unit.kelvin, 2 / unit.picosecond, 4 * unit.femtosecond)
    for name in ("getTemperature", "getFriction", "getStepSize", "getRandomNumberSeed"):
        assert getattr(integrator, name)() == getattr(reference, name)()
    integrator.setTemperature(310)
    integrator.setFriction(3)
    assert integrator.getTemperature() == 310 * unit.kelvin
    assert integrator.getFriction() == 3 / unit.picosecond
    assert integrator.getRotationalFriction() == 3 / unit.picosecond
    integrator.setRotationalFriction(9 / unit.picosecond)
    integrator.setFriction(1)
    assert integrator.getRotationalFriction() == 9 / unit.picosecond


def test_an_integrator_that_is_given_the_ensemble_has_a_bath(cluster):
    _, system, point = cluster
    with_ensemble = seeded(SIERIntegrator(0.002, SIER2, ensemble=Langevin(TEMPERATURE, 1.0)), 11)
    ends = []
    for integrator in (thermostat(), with_ensemble):
        context = context_at(system, integrator, point, steps=5)
        ends.append(phase_point(context))
    assert np.array_equal(ends[0], ends[1])


@pytest.mark.thorough
def test_a_bath_whose_heat_is_not_counted_has_its_temperature():
    """Rotations of water with heavy hydrogens at 9 fs, whose kicks along constraints are large.

    A bath in a drift whose halves are not constrained each, as OpenMM's LangevinMiddleIntegrator has it, makes them 4 %
    too hot in several inner steps.
    """
    topology, positions, system = periodic_system()
    prepare_system(system, hydrogenMass=4)
    point = relaxed("box-59-heavy", topology, positions, system, steps=100)
    integrator = seeded(SIERLangevinIntegrator(300, 30, 0.009, engine="native", countsHeat=False), 6)
    context = context_at(system, integrator, point, "CPU", steps=50)
    results = []
    for _ in range(1500):
        integrator.step(2)
        results.append(integrator.computeTemperatures().in_kelvin())
    count = integrator.bodies.n
    # Samples are 0.5/friction, two steps, apart; 1500 of 3 count freedoms leave this error, 0.8 K, and
    # six and a half of it.
    assert np.mean([each.rotation for each in results]) == pytest.approx(
        300, abs=6.5 * 300 * (2 / 3 / count / 1500) ** 0.5 + 2
    )
    assert np.mean([each.translation for each in results]) == pytest.approx(300, abs=6)
    velocities = phase_point(context)[1]
    context.applyVelocityConstraints(1e-9)
    # OpenMM's own lengths are in single precision.
    assert np.abs(phase_point(context)[1] - velocities).max() < 1e-5


def test_noise_that_a_state_does_not_hold_draws_a_warning():
    """With the native engine a State continues in the same ensemble, a checkpoint on the same trajectory."""
    _, positions, system = cluster_system(3)
    point = positions, np.zeros_like(positions)

    def made(engine):
        integrator = seeded(SIERLangevinIntegrator(300, 5.0, 0.002, engine=engine), 4)
        return integrator, context_at(system, integrator, point)

    for engine in ("exact", "native"):
        integrator, context = made(engine)
        integrator.step(3)
        state = context.getState(positions=True, velocities=True, integratorParameters=True)
        checkpoint = context.createCheckpoint()
        integrator.step(3)
        end = phase_point(context)[0]
        other, later = made(engine)
        later.loadCheckpoint(checkpoint)
        other.step(3)
        assert np.array_equal(phase_point(later)[0], end)
        other, later = made(engine)
        if engine == "exact":
            later.setState(state)
        else:
            with pytest.warns(UserWarning, match="State does not hold the noise"):
                later.setState(state)
        other.step(3)
        assert np.array_equal(phase_point(later)[0], end) is (engine == "exact")


@pytest.mark.parametrize("engine", ["exact", "native"])
def test_energy_less_heat_is_conserved_at_whole_steps_with_fast_forces(engine):
    """Half a kick of the slow forces, and half an inner one of the fast forces, after the end of a step of SIER2."""
    points = chains()
    state = points.start(np.random.default_rng(4), 300.0)
    deviations = {"end": [], "whole": []}
    for h in (0.002, 0.001):
        integrator = seeded(SIERLangevinIntegrator(300, 2, h, SIER2, engine=engine, fastForceGroups={FAST}, substeps=2))
        context = context_at(system_of(points)[0], integrator, (state.q.T, (state.p / points.masses).T))
        results = []
        for _ in range(round(0.2 / h)):
            integrator.step(1)
            potential = energies(context)[0] - integrator.getHeat()._value
            pair = integrator.getBodyState(), integrator.getWholeStepState()
            results.append([potential + sum(integrator.bodies.kinetic_energies(each)) for each in pair])
        for name, spread in zip(deviations, np.std(results, axis=0), strict=True):
            deviations[name].append(spread)
    # First order at the end of steps and second at whole ones. Noise differs from one step length to the other, which
    # changes the amplitudes of 54 degrees of freedom by some tenth.
    assert np.log2(deviations["end"][0] / deviations["end"][1]) == pytest.approx(1, abs=0.5)
    assert np.log2(deviations["whole"][0] / deviations["whole"][1]) == pytest.approx(2, abs=0.6)
    assert deviations["whole"][1] < deviations["end"][1] / 5


def fast_bonds(count, masses, stiffness, slow):
    """System and positions of bonds of 0.1 nm in the fast group, on each of which a slow force acts too."""
    fast = openmm.HarmonicBondForce()
    fast.setForceGroup(FAST)
    for i in range(0, 2 * count, 2):
        fast.addBond(i, i + 1, 0.1, stiffness)
        slow.addBond(i, i + 1)
    system = assembled(count * masses, fast, slow)
    positions = np.repeat(np.random.default_rng(3).uniform(0, 10, (count, 3)), 2, axis=0)
    positions[1::2, 0] += 0.1
    return system, positions


@pytest.mark.parametrize("engine", ["exact", "native"])
def test_temperatures_are_those_just_after_the_bath(engine):
    """At the end of a step of 10 fs a bond of 24 fs is too hot, if slow forces pull at it; reporters do not show that.

    Of its linear map, kick (-0.05 k), leapfrog steps of 3.33 fs (k) with the bath in the middle one, the momentum at
    the end has the variance 1.21 kT and that after the bath kT (solved with `scipy.linalg.solve_discrete_lyapunov`).
    A stretch is one of six degrees of freedom.
    """
    count, mass, period = 100, 12.0, 0.024
    stiffness = (2 * np.pi / period) ** 2 * mass / 2
    slow = openmm.CustomBondForce(f"{-0.025 * stiffness}*(r-0.1)^2")
    system, positions = fast_bonds(count, (mass, mass), stiffness, slow)
    integrator = seeded(SIERLangevinIntegrator(300, 20, 0.010, SIER2, fastForceGroups={FAST}, engine=engine), 5)
    context = context_at(system, integrator, (positions, 0 * positions), steps=50)
    after_bath, at_end = [], []
    for _ in range(1000):
        integrator.step(1)
        after_bath.append(integrator.computeTemperatures().in_kelvin().flexible)
        at_end.append(2 * energies(context)[1] / (6 * count * GAS_CONSTANT))
    # 600 degrees of freedom relax at 20/ps: 1000 steps are some 100 independent samples, and the error 1.7 K.
    assert np.mean(after_bath) == pytest.approx(300, abs=7)
    assert np.mean(at_end) - np.mean(after_bath) == pytest.approx(0.21 / 6 * 300, abs=3)
    reported = integrator.computeTemperatures().in_kelvin()
    context.createCheckpoint()
    assert integrator.computeTemperatures().in_kelvin() == pytest.approx(reported, nan_ok=True)
    # Whatever the user sets counts.
    context.setVelocities(np.zeros((2 * count, 3)))
    assert integrator.computeTemperatures().in_kelvin().flexible == 0


@pytest.mark.parametrize("engine", ["exact", "native"])
def test_slow_forces_stretch_a_fast_bond_by_too_little(engine):
    """Their share of the mean extension is x/tan(x), x = pi h/T; a warning is given below 0.9."""
    count, period, h, force = 50, 0.0093, 0.004, 200.0
    stiffness = (2 * np.pi / period) ** 2 * 16 / 17
    system, positions = fast_bonds(count, (16.0, 1.0), stiffness, openmm.CustomBondForce(f"-{force}*r"))
    x = np.pi * h / period
    share = x / np.tan(x)
    integrator = seeded(SIERLangevinIntegrator(1, 20, h, SIER2, fastForceGroups={FAST}, engine=engine, substeps=6), 7)
    with pytest.warns(UserWarning, match=f"4 fs .*by only {100 * share:.0f} %"):
        context = context_at(system, integrator, (positions, 0 * positions), steps=100)
    lengths = []
    for _ in range(200):
        integrator.step(2)
        arms = np.diff(phase_point(context)[0].reshape(count, 2, 3), axis=1)
        lengths.append(np.linalg.norm(arms, axis=2).mean())
    # At 1 K a bond scatters by 0.3 of an extension of 4.7e-4 nm, so that 50 bonds, which relax at 20/ps within 200
    # samples of 8 fs, have an error of 0.01. Eleven inner steps are exact to as much.
    assert (np.mean(lengths) - 0.1) * stiffness / force == pytest.approx(share, abs=0.03)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*slow forces stretch")
        shorter = SIERLangevinIntegrator(1, 20, 0.0015, SIER2, fastForceGroups={FAST}, engine=engine)
        context_at(system, shorter, (positions, 0 * positions), steps=1)


@pytest.mark.parametrize("force", [openmm.MonteCarloBarostat(1, 350, 25), openmm.AndersenThermostat(350, 1)])
def test_a_force_at_another_temperature_draws_a_warning(force):
    _, positions, system = periodic_system()
    system = with_forces(system, force)
    name = type(force).__name__
    point = positions, 0 * positions
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=f"The {name}")
        context_at(system, SIERLangevinIntegrator(350, 1, 0.002, SIER2), point, steps=1)
        integrator = SIERLangevinIntegrator(300, 1, 0.002, SIER2)
        context = context_at(system, integrator, point)
        # No step has been made at two temperatures yet, as where the System's Force gets the right one afterwards.
        context.setParameter(type(force).Temperature(), 300)
        integrator.step(1)
    integrator.setTemperature(280)
    with pytest.warns(UserWarning, match=f"{name} has 300 K, .*280 K") as caught:
        integrator.step(1)
    assert len(caught) == 1
    integrator.setTemperature(270)
    with silence():
        integrator.step(1)
