"""Copies of Systems with frames move as the originals do, by OpenMM's integrators and by those of this package."""

import io

import numpy as np
import openmm
import pytest
from openmm import app

from openmm_sier import SIER2, SIER4G, RigidBodies, SIERIntegrator, SIERLangevinIntegrator, with_frames
from openmm_sier.dynamics.constants import GAS_CONSTANT
from tests.support.framed import atom_velocities, frame_velocities, moved, polar, soft, system_of, topology_of
from tests.support.seeded import seeded
from tests.support.waters import array, energies, phase_point, platform

T = 300.0


def charged():
    """Two domains, benzene, carbon dioxide and an ion, which attract each other, in a field."""
    system, positions, bodies = system_of("36 beads", "benzene", "36 beads", "carbon dioxide", apart=2.2)
    system.addParticle(23.0)
    positions = np.vstack([positions, [3.0, 2.0, 0.5]])
    system.addForce(polar(system, bodies, charge=0.4))
    system.addForce(soft(system, bodies)[1])
    return system, moved(positions, bodies), bodies


def context_of(system, integrator, positions, velocities, name="Reference"):
    context = openmm.Context(system, integrator, platform(name))
    context.setPositions(positions)
    context.setVelocities(velocities)
    return context


@pytest.fixture(scope="module")
def start():
    """System, bodies, copy, and positions and velocities of rigid bodies near 300 K."""
    system, positions, bodies = charged()
    known = RigidBodies.from_system(system, rigid=bodies, positions=positions)
    framed = with_frames(system, positions, known)
    context = openmm.Context(framed.system, openmm.VerletIntegrator(0.001), platform())
    context.setPositions(framed.positions)
    context.setVelocitiesToTemperature(T, 4)
    state = context.getState(positions=True, velocities=True)
    return system, known, framed, framed.getAtomPositions(state), atom_velocities(framed, state)


@pytest.fixture(scope="module")
def exact(start):
    """The phase point of the original after 1 ps with the exact engine."""
    system, known, _, positions, velocities = start
    after = SIERIntegrator(0.001, SIER4G, bodies=known, engine="exact")
    context = context_of(system, after, positions, velocities)
    after.step(1000)
    return phase_point(context)


def verlet(start, name, h, time=1.0):
    """Positions of atoms after a time in ps by OpenMM's Verlet, whose velocities are those half a step before."""
    _, _, framed, positions, velocities = start
    there = framed.addFramePositions(positions)
    speeds = frame_velocities(framed, positions, velocities)
    back = SIERIntegrator(h, SIER4G, engine="native")
    context = context_of(framed.system, back, there, -speeds)
    back.step(1)
    before = phase_point(context)[0]
    integrator = openmm.VerletIntegrator(h)
    integrator.setConstraintTolerance(1e-10)
    context = context_of(framed.system, integrator, there, (there - before) / h, name)
    integrator.step(round(time / h))
    return framed.getAtomPositions(context.getState(positions=True))


def test_verlet_of_openmm_has_the_trajectory_of_the_exact_engine(start, exact):
    """Its error is of second order: 16 times smaller at a quarter of the step, and below 1e-5 nm there."""
    errors = [np.abs(verlet(start, "Reference", h) - exact[0]).max() for h in (0.001, 0.00025)]
    assert errors[1] < 1e-5
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.1)


def test_verlet_on_the_cpu_platform(start, exact):
    """Forces in single precision are good to 1e-6, and move a body by as much of its way, 0.3 nm."""
    assert np.abs(verlet(start, "CPU", 0.00025) - exact[0]).max() < 2e-5


# --- ensembles --------------------------------------------------------------------------------------------------------


def oscillators():
    """Bodies that a field holds by one atom each, without other forces.

    V is quadratic in the positions of these atoms: 3/2 kT each at any orientation, since centres move freely below it.
    """
    system, positions, bodies = system_of("36 beads", "benzene", "36 beads", "carbon dioxide", "C60")
    force = openmm.CustomExternalForce("k*((x-x0)^2 + (y-y0)^2 + (z-z0)^2)")
    for name in ("k", "x0", "y0", "z0"):
        force.addPerParticleParameter(name)
    for atoms in bodies:
        force.addParticle(atoms[0], [2000.0, *positions[atoms[0]]])
    system.addForce(force)
    return system, positions, bodies


@pytest.mark.thorough
@pytest.mark.parametrize(
    "make",
    [
        lambda: openmm.LangevinMiddleIntegrator(T, 5.0, 0.004),
        lambda: SIERLangevinIntegrator(T, 5.0, 0.004, SIER2, engine="native"),
    ],
    ids=["LangevinMiddle", "SIERLangevin native"],
)
def test_energies_and_temperatures_in_a_bath(make):
    system, positions, bodies = oscillators()
    framed = with_frames(system, positions, bodies)
    integrator = seeded(make(), 7)
    context = context_of(framed.system, integrator, framed.positions, 0 * framed.positions)
    context.setVelocitiesToTemperature(T, 7)
    integrator.step(500)
    potential, translation, rotation = [], [], []
    for _ in range(800):
        integrator.step(20)
        state = context.getState(positions=True, velocities=True, energy=True)
        potential.append(array(state.getPotentialEnergy()))
        velocities = atom_velocities(framed, state)
        masses = [np.array([system.getParticleMass(i)._value for i in atoms]) for atoms in bodies]
        centres = [m @ velocities[atoms] / m.sum() for m, atoms in zip(masses, bodies, strict=True)]
        moving = sum(0.5 * m.sum() * (v**2).sum() for m, v in zip(masses, centres, strict=True))
        whole = sum(0.5 * (m[:, None] * velocities[a] ** 2).sum() for m, a in zip(masses, bodies, strict=True))
        translation.append(moving)
        rotation.append(whole - moving)
    half = 0.5 * GAS_CONSTANT * T
    for results, freedoms in ((potential, 15), (translation, 15), (rotation, 14)):
        # Samples are 80 fs apart and a bath of 5/ps keeps energies for about 100 fs, so that at least a third of them
        # are independent: an energy of n freedoms deviates by sqrt(2 n) kT/2. Errors of the step are of (w h)^2/4,
        # below 0.002 for benzene, whose w is 7/ps.
        error = half * np.sqrt(2 * freedoms / (len(results) / 3))
        assert np.mean(results) == pytest.approx(half * freedoms, abs=6.5 * error + 0.003 * half * freedoms)


def test_openmm_counts_the_degrees_of_freedom_of_the_bodies():
    """Four, three and two masses with six, three and one constraints have 6, 6 and 5; less 3 for the centre."""
    system, positions, bodies = system_of("36 beads", "benzene", "carbon dioxide")
    system.addForce(openmm.CMMotionRemover())
    topology = topology_of(bodies)
    framed = with_frames(system, positions, bodies, topology)
    simulation = app.Simulation(framed.topology, framed.system, openmm.VerletIntegrator(0.001), platform())
    simulation.context.setPositions(framed.positions)
    simulation.context.setVelocitiesToTemperature(T, 3)
    log = io.StringIO()
    simulation.reporters.append(app.StateDataReporter(log, 1, kineticEnergy=True, temperature=True))
    simulation.step(1)
    kinetic, temperature = (float(value) for value in log.getvalue().splitlines()[1].split(","))
    assert temperature == pytest.approx(2 * kinetic / ((6 + 6 + 5 - 3) * GAS_CONSTANT), rel=1e-4)


def test_checkpoints_continue_a_run_and_minimization_keeps_bodies_rigid():
    system, positions, bodies = charged()
    framed = with_frames(system, positions, bodies)
    integrator = seeded(openmm.LangevinMiddleIntegrator(T, 1.0, 0.002), 5)
    context = context_of(framed.system, integrator, framed.positions, 0 * framed.positions)
    before = energies(context)[0]
    openmm.LocalEnergyMinimizer.minimize(context, 10, 50)
    assert energies(context)[0] < before - 1
    atom_positions = framed.getAtomPositions(context.getState(positions=True))
    for atoms in bodies:
        shapes = [np.linalg.norm(x[atoms][:, None] - x[atoms][None], axis=2) for x in (atom_positions, positions)]
        # Sites stand on axes of unit length, whatever the frame's own errors, which lines alone feel: 1e-5 of a length.
        assert np.abs(shapes[0] - shapes[1]).max() < 1e-5
    context.setVelocitiesToTemperature(T, 2)
    integrator.step(10)
    saved = context.createCheckpoint()
    integrator.step(10)
    expected = phase_point(context)
    context.loadCheckpoint(saved)
    integrator.step(10)
    assert (phase_point(context)[0] == expected[0]).all()
    assert (phase_point(context)[1] == expected[1]).all()


@pytest.mark.parametrize(
    "barostat",
    [
        openmm.MonteCarloBarostat(20.0, T, 1),
        openmm.MonteCarloAnisotropicBarostat([20.0, 20.0, 20.0], T, True, True, True, 1),
        openmm.MonteCarloFlexibleBarostat(20.0, T, 1),
    ],
    ids=lambda barostat: type(barostat).__name__,
)
def test_barostats_of_openmm_move_bodies_as_wholes(barostat):
    system, positions, bodies = system_of("C60", "benzene", "36 beads")
    system.setDefaultPeriodicBoxVectors([9, 0, 0], [0, 9, 0], [0, 0, 9])
    force = polar(system, bodies, charge=0.0)
    force.setNonbondedMethod(force.CutoffPeriodic)
    system.addForce(force)
    system.addForce(seeded(barostat, 9))
    framed = with_frames(system, positions, bodies)
    integrator = seeded(openmm.LangevinMiddleIntegrator(T, 5.0, 0.004), 3)
    context = context_of(framed.system, integrator, framed.positions, 0 * framed.positions)
    volumes = set()
    for _ in range(30):
        integrator.step(1)
        volumes.add(context.getState().getPeriodicBoxVolume()._value)
    # Half of the moves is accepted at least, of thirty.
    assert len(volumes) > 1
    atom_positions = framed.getAtomPositions(context.getState(positions=True))
    for atoms in bodies:
        shapes = [np.linalg.norm(x[atoms][:, None] - x[atoms][None], axis=2) for x in (atom_positions, positions)]
        assert np.abs(shapes[0] - shapes[1]).max() < 1e-9


@pytest.mark.thorough
def test_the_volume_of_an_ideal_gas_of_bodies():
    """<V> = (n + 1) kT/p for n bodies, each of which is one molecule although no bond joins its atoms."""
    system, positions, bodies = system_of(*(8 * ["benzene"]))
    pressure, bar = 8.0, 0.0602214  # bar, and kJ/mol/nm^3 in one
    volume = (len(bodies) + 1) * GAS_CONSTANT * T / (pressure * bar)
    edge = volume ** (1 / 3)
    system.setDefaultPeriodicBoxVectors([edge, 0, 0], [0, edge, 0], [0, 0, edge])
    gas = openmm.NonbondedForce()
    for _ in range(system.getNumParticles()):
        gas.addParticle(0, 1, 0)
    gas.setNonbondedMethod(gas.CutoffPeriodic)
    gas.setCutoffDistance(0.2)
    system.addForce(gas)
    system.addForce(seeded(openmm.MonteCarloBarostat(pressure, T, 1), 6))
    framed = with_frames(system, positions, bodies)
    integrator = seeded(openmm.LangevinMiddleIntegrator(T, 5.0, 0.004), 3)
    context = context_of(framed.system, integrator, framed.positions, 0 * framed.positions)
    integrator.step(1000)
    volumes = []
    for _ in range(3000):
        integrator.step(1)
        volumes.append(context.getState().getPeriodicBoxVolume()._value)
    # V has a gamma distribution of n + 1 = 9: a standard deviation of a third. Moves of the size that OpenMM finds
    # leave some twenty correlated.
    assert np.mean(volumes) == pytest.approx(volume, rel=4 / 3 / np.sqrt(3000 / 20))


def test_frozen_atoms_stay_and_exert_their_forces():
    system, positions, bodies = system_of("36 beads", "benzene", apart=2.0)
    wall = system.addParticle(0.0)
    positions = np.vstack([positions, [1.0, 2.0, 0.0]])
    system.addForce(polar(system, bodies, charge=0.4))
    framed = with_frames(system, positions, bodies)
    integrator = openmm.VerletIntegrator(0.002)
    context = context_of(framed.system, integrator, framed.positions, 0 * framed.positions)
    integrator.step(50)
    atom_positions = framed.getAtomPositions(context.getState(positions=True))
    assert (atom_positions[wall] == positions[wall]).all()
    assert np.abs(atom_positions - positions).max() > 1e-4
