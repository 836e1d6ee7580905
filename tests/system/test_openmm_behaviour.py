"""What OpenMM promises of any integrator, run once with one of its own, as a control, and with ours."""

from __future__ import annotations

import io
import random

import numpy as np
import openmm
import pytest
from openmm import app, unit

from openmm_sier import SIER2, SIER2Integrator, SIER4Integrator, SIERLangevinIntegrator
from openmm_sier.engines.snapshot import read_vectors
from tests.support.waters import array, cluster_system, context_at, periodic_system, phase_point, platform, relaxed

mdtraj = pytest.importorskip("mdtraj")


def seeded(integrator):
    integrator.setRandomNumberSeed(8)
    return integrator


INTEGRATORS = {
    "LangevinMiddle": lambda: seeded(openmm.LangevinMiddleIntegrator(297.0, 1.0, 0.001)),
    "SIER4": lambda: SIER4Integrator(0.001),
    "SIERLangevin": lambda: seeded(SIERLangevinIntegrator(297.0, 1.0, 0.001, scheme=SIER2)),
}
every_integrator = pytest.mark.parametrize("make", INTEGRATORS.values(), ids=INTEGRATORS.keys())
THERMOSTATS = {name: INTEGRATORS[name] for name in ("LangevinMiddle", "SIERLangevin")}
every_thermostat = pytest.mark.parametrize("make", THERMOSTATS.values(), ids=THERMOSTATS.keys())


@pytest.fixture(scope="module")
def box():
    topology, positions, system = periodic_system(molecules=64)
    for number, force in enumerate(system.getForces()):
        force.setForceGroup(number)
    return topology, system, relaxed(topology, positions, system)


@pytest.fixture(scope="module")
def cluster():
    topology, positions, system = cluster_system(6)
    return topology, system, relaxed(topology, positions, system)


def simulation_of(setup, integrator, name="CPU", **options):
    topology, system, point = setup
    properties = {"Threads": "1", "DeterministicForces": "true"} if name == "CPU" else {}
    simulation = app.Simulation(topology, system, integrator, platform(name), properties, **options)
    if not options:
        simulation.context.setPositions(point[0])
        simulation.context.setVelocities(point[1])
    return simulation


# --- time, steps and settings -----------------------------------------------------------------------------------


@every_integrator
def test_counters(cluster, make):
    simulation = simulation_of(cluster, make(), "Reference")
    context, integrator = simulation.context, simulation.integrator
    assert simulation.integrator is context.getIntegrator()
    simulation.step(7)
    integrator.step(np.int64(3))
    integrator.step(0)
    assert simulation.currentStep == context.getStepCount() == 10
    assert context.getState().getStepCount() == 10
    assert context.getTime()._value == pytest.approx(0.010)
    simulation.currentStep = 1000
    context.setTime(5.0)
    integrator.setStepSize(2 * unit.femtosecond)
    simulation.step(5)
    assert simulation.currentStep == 1005
    assert context.getState().getTime()._value == pytest.approx(5.010)
    assert integrator.getStepSize() == 0.002 * unit.picosecond


def test_vectors_of_a_state(box):
    """What is read past OpenMM's quantities is what its own methods give."""
    _, system, point = box
    context = context_at(system, openmm.VerletIntegrator(0.001), point, "CPU")
    state = context.getState(positions=True, velocities=True, forces=True)
    for name in ("Positions", "Velocities", "Forces"):
        expected = getattr(state, f"get{name}")(asNumpy=True)._value
        found = read_vectors(state, getattr(openmm.State, name), np.empty(expected.shape))
        assert expected.any()
        assert np.array_equal(found, expected)


# --- the State --------------------------------------------------------------------------------------------------

FLAGS = ["positions", "velocities", "forces", "energy", "parameters", "parameterDerivatives", "integratorParameters"]


def with_parameter(system):
    system = openmm.XmlSerializer.clone(system)
    pull = openmm.CustomCompoundBondForce(1, "strength*x1")
    pull.addGlobalParameter("strength", 2.0)
    pull.addEnergyParameterDerivative("strength")
    for i in range(system.getNumParticles()):
        pull.addBond([i])
    pull.setForceGroup(5)
    system.addForce(pull)
    return system


@pytest.mark.slow
@every_integrator
@pytest.mark.parametrize("checkpoint", [False, True], ids=["a look", "a checkpoint"])
def test_asking_for_a_state_disturbs_nothing(box, make, checkpoint):
    topology, system, point = box
    setup = topology, with_parameter(system), point
    asked = dict.fromkeys(FLAGS, True) | {"enforcePeriodicBox": True, "integratorParameters": checkpoint}
    ends = []
    for curious in (False, True):
        simulation = simulation_of(setup, make())
        for _ in range(4):
            simulation.step(1)
            if curious:
                simulation.context.getState(**asked)
                simulation.context.getState(energy=True, forces=True, groups={0, 5})
        ends.append(phase_point(simulation.context))
    if checkpoint:
        # Such a State is a checkpoint. It renews the neighbour list of the CPU platform, whose forces of some 1e3
        # kJ/mol/nm in single precision then differ in their last bits: 1e-4 of them on 1 dalton for 4 fs.
        for one, other, rounding in zip(*ends, (1e-6, 1e-3), strict=True):
            assert one == pytest.approx(other, abs=rounding)
    else:
        assert all(np.array_equal(one, other) for one, other in zip(*ends, strict=True))


@every_integrator
def test_the_state_is_that_of_its_positions(cluster, make):
    """Forces, energies and parameters agree with a Context that was never stepped."""
    topology, system, point = cluster
    system = with_parameter(system)
    simulation = simulation_of((topology, system, point), make(), "Reference")
    simulation.step(5)
    simulation.context.setParameter("strength", 3.0)
    other = context_at(system, openmm.VerletIntegrator(0.001), phase_point(simulation.context))
    other.setParameter("strength", 3.0)
    for groups in (-1, {5}, {0}):
        states = [c.getState(**dict.fromkeys(FLAGS[:-1], True), groups=groups) for c in (simulation.context, other)]
        for name in ("Forces", "PotentialEnergy", "Positions", "Velocities"):
            assert np.array_equal(*(array(getattr(state, f"get{name}")()) for state in states))
        for name in ("Parameters", "EnergyParameterDerivatives"):
            one, two = (dict(getattr(state, f"get{name}")()) for state in states)
            assert one == two


@every_integrator
def test_force_groups_choose_the_forces_that_move(cluster, make):
    topology, system, point = cluster
    system = with_parameter(system)
    system.getForce(system.getNumForces() - 1).setForceGroup(7)
    for i in range(system.getNumForces() - 1):
        system.getForce(i).setForceGroup(2)
    integrator = make()
    integrator.setIntegrationForceGroups({7})
    if hasattr(integrator, "setFriction"):
        integrator.setFriction(0.0)
    simulation = simulation_of((topology, system, point), integrator, "Reference")
    masses = np.array([system.getParticleMass(i)._value for i in range(system.getNumParticles())])
    start = masses @ phase_point(simulation.context)[1]
    simulation.step(10)
    momentum = masses @ phase_point(simulation.context)[1] - start
    # A pull of 2 kJ/mol/nm on each of 18 atoms for 10 fs, and nothing else.
    assert np.allclose(momentum, [-2 * 18 * 0.01, 0, 0], atol=1e-6)
    middle = phase_point(simulation.context)[1]
    integrator.setIntegrationForceGroups({2})
    if isinstance(integrator, (SIER2Integrator, SIER4Integrator, SIERLangevinIntegrator)):
        simulation.step(1)
        change = masses @ (phase_point(simulation.context)[1] - middle)
        # It takes effect with the next step, as it does in Verlet; its forces cancel in sum.
        assert np.abs(change).max() < 1e-9


# --- changes from outside ---------------------------------------------------------------------------------------


@every_integrator
def test_constraints_applied_from_outside(cluster, make):
    simulation = simulation_of(cluster, make(), "Reference")
    context = simulation.context
    simulation.step(3)
    rng = np.random.default_rng(1)
    context.setPositions(phase_point(context)[0] + rng.uniform(-5e-4, 5e-4, (18, 3)))
    context.applyConstraints(1e-8)
    context.applyVelocityConstraints(1e-8)
    simulation.step(3)
    water = phase_point(context)[0].reshape(6, 3, 3)
    lengths = np.linalg.norm(water[:, 0] - water[:, 1], axis=1)
    # SETTLE's lengths, in single precision, for OpenMM's own.
    assert np.ptp(lengths) < 1e-7


def per_particle(topology):
    force = openmm.CustomExternalForce("k*x^2")
    force.addPerParticleParameter("k")
    for atom in topology.atoms():
        force.addParticle(atom.index, [1.0])

    def change():
        for i in range(force.getNumParticles()):
            force.setParticleParameters(i, i, [500.0])

    return force, change


def tabulated(topology):
    table = openmm.Continuous1DFunction(np.linspace(0, 1, 20), 0.0, 3.0)
    distance = openmm.CustomBondForce("r")
    distance.addBond(0, topology.getNumAtoms() - 1)
    force = openmm.CustomCVForce("table(d)")
    force.addCollectiveVariable("d", distance)
    force.addTabulatedFunction("table", table)

    def change():
        table.setFunctionParameters(1000 * np.linspace(0, 1, 20) ** 2, 0.0, 3.0)

    return force, change


def charges(topology):
    force = openmm.NonbondedForce()
    for _ in topology.atoms():
        force.addParticle(0.0, 0.1, 0.0)

    def change():
        for i in range(force.getNumParticles()):
            force.setParticleParameters(i, (-1) ** i * 0.3, 0.1, 0.0)

    return force, change


@every_integrator
@pytest.mark.parametrize("changing", [per_particle, tabulated, charges])
def test_parameters_updated_in_the_context_act_at_once(cluster, make, changing):
    """No state of OpenMM tells that `updateParametersInContext` was called."""
    topology, bare, point = cluster
    simulations, saved = [], None
    for changed_before in (False, True):
        system = openmm.XmlSerializer.clone(bare)
        force, change = changing(topology)
        if changed_before:
            change()
        system.addForce(force)
        simulation = simulation_of((topology, system, point), make(), "Reference")
        if changed_before:
            simulation.context.setState(saved)
        else:
            simulation.step(3)
            saved = simulation.context.getState(positions=True, velocities=True, integratorParameters=True)
            change()
            force.updateParametersInContext(simulation.context)
        simulation.step(1)
        simulations.append(simulation)
    ends = [phase_point(simulation.context) for simulation in simulations]
    if isinstance(simulations[0].integrator, openmm.LangevinMiddleIntegrator):
        # States of OpenMM's do not bring the noise.
        assert not np.array_equal(*ends)
    else:
        assert np.array_equal(*ends)


# --- wrappers that own a Simulation -----------------------------------------------------------------------------


def oxygen_distance(topology):
    oxygens = [atom.index for atom in topology.atoms() if atom.element is app.element.oxygen]
    distance = openmm.CustomBondForce("r")
    distance.addBond(*oxygens[:2])
    return app.BiasVariable(distance, 0.0, 3.0, 0.1)


@every_integrator
def test_metadynamics(tmp_path, box, make):
    topology, system, point = box
    system = openmm.XmlSerializer.clone(system)
    variable = oxygen_distance(topology)
    bias = app.Metadynamics(system, [variable], 297.0, 5.0, 2.0, 4, saveFrequency=8, biasDir=str(tmp_path))
    simulation = simulation_of((topology, system, point), make())
    bias.step(simulation, 20)
    assert simulation.currentStep == 20
    free_energy = array(bias.getFreeEnergy())
    # Five Gaussians of up to 2 kJ/mol where the molecules are, and the factor of well-tempered sampling.
    place = bias.getCollectiveVariables(simulation)[0]
    lowest = np.linspace(0, 3, variable.gridWidth)[free_energy.argmin()]
    assert abs(lowest - place) < 0.1
    assert -12.5 < free_energy.min() < -6.0
    assert len(list(tmp_path.glob("bias_*.npy"))) == 1


@every_thermostat
def test_simulated_tempering(box, make):
    random.seed(3)
    simulation = simulation_of(box, make())
    log = io.StringIO()
    tempering = app.SimulatedTempering(
        simulation,
        numTemperatures=3,
        minTemperature=297.0,
        maxTemperature=303.0,
        tempChangeInterval=2,
        reportInterval=2,
        reportFile=log,
    )
    visited = set()
    for _ in range(20):
        tempering.step(2)
        visited.add(tempering.currentTemperature)
        temperature = tempering.temperatures[tempering.currentTemperature]
        assert simulation.integrator.getTemperature()._value == pytest.approx(temperature._value)
    assert simulation.currentStep == 40
    assert len(visited) > 1
    assert len(log.getvalue().splitlines()) == 21
