"""What OpenMM promises of any integrator, run once with one of its own, as a control, and with ours."""

import numpy as np
import openmm
import pytest
from openmm import unit

from openmm_sier import SIER2, SIERIntegrator, SIERLangevinIntegrator
from tests.support.restarts import simulation_of
from tests.support.seeded import seeded
from tests.support.systems import with_forces
from tests.support.waters import array, context_at, phase_point

INTEGRATORS = {
    "LangevinMiddle": lambda: seeded(openmm.LangevinMiddleIntegrator(297.0, 1.0, 0.001)),
    "SIER4": lambda: SIERIntegrator(0.001, "SIER4"),
    "SIER4 native": lambda: SIERIntegrator(0.001, "SIER4", engine="native"),
    "SIERLangevin": lambda: seeded(SIERLangevinIntegrator(297.0, 1.0, 0.001, scheme=SIER2)),
}
every_integrator = pytest.mark.parametrize("make", INTEGRATORS.values(), ids=INTEGRATORS.keys())


# --- time, steps and settings -----------------------------------------------------------------------------------


@every_integrator
def test_counters(cluster, make):
    topology, system, point = cluster
    simulation = simulation_of(topology, system, make(), point=point)
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


# --- the State --------------------------------------------------------------------------------------------------

FLAGS = ["positions", "velocities", "forces", "energy", "parameters", "parameterDerivatives"]


def with_parameter(system):
    pull = openmm.CustomCompoundBondForce(1, "strength*x1")
    pull.addGlobalParameter("strength", 2.0)
    pull.addEnergyParameterDerivative("strength")
    for i in range(system.getNumParticles()):
        pull.addBond([i])
    pull.setForceGroup(5)
    return with_forces(system, pull)


def test_the_state_is_that_of_its_positions(cluster):
    """Forces, energies and parameters agree with a Context that was never stepped."""
    topology, system, point = cluster
    system = with_parameter(system)
    simulation = simulation_of(topology, system, SIERIntegrator(0.001, "SIER4"), point=point)
    simulation.step(5)
    simulation.context.setParameter("strength", 3.0)
    other = context_at(system, openmm.VerletIntegrator(0.001), phase_point(simulation.context))
    other.setParameter("strength", 3.0)
    for groups in (-1, {5}, {0}):
        states = [c.getState(**dict.fromkeys(FLAGS, True), groups=groups) for c in (simulation.context, other)]
        for name in ("Forces", "PotentialEnergy", "Positions", "Velocities"):
            assert np.array_equal(*(array(getattr(state, f"get{name}")()) for state in states))
        for name in ("Parameters", "EnergyParameterDerivatives"):
            one, two = (dict(getattr(state, f"get{name}")()) for state in states)
            assert one == two


@pytest.mark.parametrize(("engine", "is_same"), [("exact", True), ("native", False)])
def test_reading_the_energy_draws_random_numbers_of_openmm(cluster, engine, is_same):
    """The Reference platform draws for each evaluation of the kinetic energy of a CustomIntegrator.

    The noise of the exact engine is not of OpenMM, see docs/guide/restarts.md.
    """
    _, system, point = cluster
    ends = []
    for reads in (False, True):
        integrator = seeded(SIERLangevinIntegrator(297.0, 1.0, 0.001, engine=engine))
        context = context_at(system, integrator, point, steps=2)
        context.getState(energy=reads)
        integrator.step(2)
        ends.append(phase_point(context)[0])
    assert np.array_equal(*ends) == is_same


@pytest.mark.parametrize("engine", ["exact", "native"])
def test_force_groups_choose_the_forces_that_move(cluster, engine):
    topology, system, point = cluster
    system = with_parameter(system)
    system.getForce(system.getNumForces() - 1).setForceGroup(7)
    for i in range(system.getNumForces() - 1):
        system.getForce(i).setForceGroup(2)
    integrator = SIERIntegrator(0.001, "SIER4", engine=engine)
    integrator.setIntegrationForceGroups({7})
    simulation = simulation_of(topology, system, integrator, point=point)
    masses = np.array([system.getParticleMass(i)._value for i in range(system.getNumParticles())])
    start = masses @ phase_point(simulation.context)[1]
    simulation.step(10)
    momentum = masses @ phase_point(simulation.context)[1] - start
    # A pull of 2 kJ/mol/nm on each of 24 atoms for 10 fs, and nothing else.
    assert np.allclose(momentum, [-2 * 24 * 0.01, 0, 0], atol=1e-6)
    middle = phase_point(simulation.context)[1]
    integrator.setIntegrationForceGroups({2})
    simulation.step(1)
    change = masses @ (phase_point(simulation.context)[1] - middle)
    # It takes effect with the next step, as it does in Verlet; its forces cancel in sum.
    assert np.abs(change).max() < 1e-9
