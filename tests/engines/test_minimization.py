"""OpenMM's minimization with bodies that no constraint holds."""

import warnings

import numpy as np
import openmm
import pytest
from openmm import app, unit

from openmm_sier import RigidBodies, RigidityError, SIERIntegrator, select_bodies
from openmm_sier.system.links import held_bodies
from tests.support import methanols
from tests.support.systems import field, with_forces
from tests.support.waters import cluster_system, context_at, energies, phase_point, platform

N = 27


def constraints_hold(system, bodies):
    return all(held.all() for held in held_bodies(system, bodies.species))


@pytest.fixture(scope="module")
def gas():
    positions = methanols.positions_of(N, digit=None)
    return methanols.system_of(N), methanols.topology_of(N), positions


@pytest.fixture(scope="module")
def rigid(gas):
    system, topology, positions = gas
    return RigidBodies.from_system(system, topology, select_bodies(topology, "MOH"), positions)


def distances(positions):
    molecules = positions.reshape(-1, 6, 3)
    return np.linalg.norm(molecules[:, :, None] - molecules[:, None], axis=3)


def rms_force(context, bodies):
    """Root mean square of forces and of torques over radii of gyration, of bodies with six freedoms."""
    forces = context.getState(forces=True).getForces(asNumpy=True)._value
    _, A = bodies.fit(phase_point(context)[0])
    F, tau = bodies.forces_and_torques(forces, A)
    gyration = bodies.moments.sum(axis=0) / (2 * bodies.masses)
    return np.sqrt(((F**2).sum() + (tau**2 / gyration).sum()) / bodies.dof)


def test_a_simulation_minimizes_named_bodies_whole(gas, rigid):
    system, topology, positions = gas
    simulation = app.Simulation(topology, system, SIERIntegrator(0.002, "SIER2", bodies=rigid), platform())
    simulation.context.setPositions(positions)
    simulation.context.setVelocitiesToTemperature(300, 1)
    velocities = phase_point(simulation.context)[1]
    before = energies(simulation.context)[0]
    simulation.minimizeEnergy(tolerance=2 * unit.kilojoule_per_mole / unit.nanometer)
    after = phase_point(simulation.context)
    assert energies(simulation.context)[0] < before - 10
    assert np.abs(distances(after[0]) - distances(positions)).max() < 1e-13
    assert np.abs(after[0] - positions).max() > 0.02
    assert np.array_equal(after[1], velocities)
    assert rms_force(simulation.context, rigid) < 2
    assert simulation.context.getStepCount() == 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        simulation.step(5)


def test_iterations_are_counted_and_reported(gas, rigid):
    class Reporter(openmm.MinimizationReporter):
        def report(self, iteration, x, grad, args):
            calls.append((iteration, np.array(x), np.array(grad), args["system energy"]))
            return len(calls) == 4

    system, _, positions = gas
    integrator = SIERIntegrator(0.002, "SIER2", bodies=rigid)
    context = context_at(system, integrator, (positions, 0 * positions))
    calls = []
    openmm.LocalEnergyMinimizer.minimize(context, 1e-9, 50, Reporter())
    assert [call[0] for call in calls] == [0, 1, 2, 3]
    state = context.getState(positions=True, forces=True, energy=True)
    assert np.array_equal(calls[-1][1], state.getPositions(asNumpy=True)._value.ravel())
    assert np.array_equal(calls[-1][2], -state.getForces(asNumpy=True)._value.ravel())
    assert calls[-1][3] == state.getPotentialEnergy()._value
    before = integrator.forceEvaluations
    openmm.LocalEnergyMinimizer.minimize(context, 1e-9, 7)
    assert integrator.forceEvaluations - before == 8


def test_constrained_bodies_are_left_to_openmm():
    """Water, and whatever has no bodies of several atoms, is minimized as with any integrator."""
    _, positions, system = cluster_system(4, "tip4pew")
    ends = []
    for integrator in (SIERIntegrator(0.001, "SIER2"), openmm.VerletIntegrator(0.001)):
        context = context_at(system, integrator, (positions, 0 * positions))
        openmm.LocalEnergyMinimizer.minimize(context, 5, 50)
        ends.append(phase_point(context)[0])
    assert np.array_equal(*ends)
    assert constraints_hold(system, RigidBodies.from_system(system))


def test_one_constraint_too_few_does_not_hold():
    _, _, system = cluster_system(4)
    bodies = RigidBodies.from_system(system)
    system = openmm.XmlSerializer.clone(system)
    parameters = system.getConstraintParameters(0)
    system.removeConstraint(0)
    assert not constraints_hold(system, bodies)
    # The same pair twice is one constraint.
    system.addConstraint(*system.getConstraintParameters(0))
    assert not constraints_hold(system, bodies)
    system.addConstraint(*parameters)
    assert constraints_hold(system, bodies)


def test_a_force_that_is_not_finite_leaves_the_bodies(gas, rigid):
    system, _, positions = gas
    # Downhill to a wall, behind which the potential is not defined: bodies take some iterations to come there.
    wall = field("-50*x + 1e-9*sqrt(wall - x)", range(system.getNumParticles()), wall=1e3)
    system = with_forces(system, wall)
    integrator = SIERIntegrator(0.001, "SIER2", bodies=rigid)
    context = context_at(system, integrator, (positions, 0 * positions), steps=2)
    before = phase_point(context)
    context.setParameter("wall", before[0][:, 0].max() + 0.05)
    evaluations = integrator.forceEvaluations
    with pytest.raises(openmm.OpenMMException, match=r"residue MOH \d+ "):
        openmm.LocalEnergyMinimizer.minimize(context)
    assert integrator.forceEvaluations > evaluations + 2
    for one, other in zip(phase_point(context), before, strict=True):
        assert np.array_equal(one, other)
    context.setParameter("wall", 1e3)
    integrator.step(1)
    reference = context_at(system, SIERIntegrator(0.001, "SIER2", bodies=rigid), (positions, 0 * positions), steps=3)
    assert np.array_equal(phase_point(context)[0], phase_point(reference)[0])


def test_bodies_that_were_torn_elsewhere_are_refused_with_the_cause(gas, rigid):
    """Another integrator's Context knows nothing of them."""
    system, _, positions = gas
    other = context_at(system, openmm.VerletIntegrator(0.001), (positions, 0 * positions))
    other.setVelocitiesToTemperature(3000, 1)
    other.getIntegrator().step(100)
    context = context_at(system, SIERIntegrator(0.001, "SIER2", bodies=rigid), phase_point(other))
    with pytest.raises(RigidityError) as caught:
        context.getIntegrator().step(1)
    assert "If you named it in `bodies`" in str(caught.value)
    assert "minimize in a Context with this integrator" in str(caught.value)
    with pytest.raises(RigidityError, match="residue MOH"):
        openmm.LocalEnergyMinimizer.minimize(context)


def test_positions_that_were_never_set(gas, rigid):
    system, _, _ = gas
    context = openmm.Context(system, SIERIntegrator(0.001, "SIER2", bodies=rigid), platform())
    with pytest.raises(openmm.OpenMMException, match="Particle positions have not been set"):
        openmm.LocalEnergyMinimizer.minimize(context)
