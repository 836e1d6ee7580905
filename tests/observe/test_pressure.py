"""The molecular pressure tensor, against sums over pairs, OpenMM's barostats and the ideal gas."""

import math
from itertools import pairwise

import numpy as np
import openmm
import pytest
from openmm import unit

from openmm_sier import SIER2, RigidBodies, SIERHMCIntegrator, SIERIntegrator, SIERLangevinIntegrator
from openmm_sier.dynamics.constants import BAR
from openmm_sier.observe.force_check import check_forces
from openmm_sier.observe.pressure import COLUMNS, COMPONENTS, MolecularPressure
from openmm_sier.observe.reporters import PressureReporter
from tests.support.flexible_systems import started
from tests.support.restarts import assert_same, everything, simulation_of
from tests.support.seeded import seeded
from tests.support.systems import assembled, with_forces
from tests.support.waters import array, cluster_system, context_at, periodic_system

#: Edges of the box of ions, nm, and the rotation that turns a diagonal of it to the x axis.
EDGES = np.array([1.6, 1.8, 1.7])
TURN = np.array([[1.6, 1.8, 0], [-1.8, 1.6, 0], [0, 0, math.hypot(1.6, 1.8)]]) / math.hypot(1.6, 1.8)


def tensor_of(context):
    """The tensor in kJ/mol/nm^3, (3, 3)."""
    result = MolecularPressure(context).components(context.getState(positions=True, velocities=True)) * BAR
    tensor = np.zeros((3, 3))
    for (i, j), value in zip(COMPONENTS, result, strict=True):
        tensor[i, j] = tensor[j, i] = value
    return tensor


# --- pairs ---


def water_of_smooth_pairs(cutoff):
    """TIP4P water with virtual sites and a smooth potential q_i q_j 50 (1 - r²/cutoff²)³ between molecules."""
    topology, positions, system = periodic_system("tip4pew", 27)
    charges = openmm.CustomNonbondedForce(f"50*q1*q2*(1-(r/{cutoff})^2)^3")
    charges.addPerParticleParameter("q")
    charges.setNonbondedMethod(charges.CutoffPeriodic)
    charges.setCutoffDistance(cutoff)
    owners = np.array([atom.residue.index for atom in topology.atoms()])
    q = np.array([{"O": 0.3, "H": 0.5, "M": -1.2}[atom.name[0]] for atom in topology.atoms()])
    for value in q:
        charges.addParticle([value])
    for a in range(len(q)):
        for b in range(a):
            if owners[a] == owners[b]:
                charges.addExclusion(a, b)
    for number in reversed(range(system.getNumForces())):
        system.removeForce(number)
    system.addForce(charges)
    return system, positions, owners, q


def pair_tensor(positions, velocities, masses, owners, q, edge, cutoff):
    """The tensor by a sum over pairs of force times distance of the centres, kJ/mol/nm^3, symmetrized."""
    totals = np.bincount(owners, masses)
    centres = np.stack([np.bincount(owners, masses * x) for x in positions.T], axis=1) / totals[:, None]
    momenta = np.stack([np.bincount(owners, masses * x) for x in velocities.T], axis=1)
    arms = positions - centres[owners]
    apart = positions[:, None] - positions
    apart -= edge * np.round(apart / edge)
    r2 = (apart**2).sum(axis=2) / cutoff**2
    acting = (r2 < 1) & (owners[:, None] != owners)
    # -du/dr over r.
    strength = np.where(acting, 50 * np.outer(q, q) * 6 * (1 - r2) ** 2 / cutoff**2, 0.0)
    between = apart - arms[:, None] + arms
    virial = np.einsum("ij,ija,ijb->ab", strength, apart, between) / 2
    tensor = (momenta.T @ (momenta / totals[:, None]) + virial) / edge**3
    return (tensor + tensor.T) / 2


@pytest.mark.thorough
def test_water_with_virtual_sites_against_pairs():
    cutoff = 0.4
    system, positions, owners, q = water_of_smooth_pairs(cutoff)
    context = context_at(system, SIERIntegrator(0.001, "SIER2"), (positions, 0 * positions))
    context.setVelocitiesToTemperature(300, 3)
    state = context.getState(positions=True, velocities=True)
    masses = np.array([system.getParticleMass(i)._value for i in range(len(q))])
    edge = array(state.getPeriodicBoxVectors())[0, 0]
    point = array(state.getPositions()), array(state.getVelocities())
    expected = pair_tensor(*point, masses, owners, q, edge, cutoff)
    # The third derivative of the energy makes an error of some 1e-6 by a strain of 1e-3.
    np.testing.assert_allclose(tensor_of(context), expected, rtol=0, atol=1e-5 * np.abs(expected).max())
    # Molecules at other images are the same liquid.
    images = np.random.default_rng(4).integers(-2, 3, (27, 3))[owners]
    context.setPositions(point[0] + edge * images)
    np.testing.assert_allclose(tensor_of(context), expected, rtol=0, atol=1e-5 * np.abs(expected).max())


# --- Ewald sums and the correction for dispersion ---


def salt(turn=False, dispersion=True):
    """System and phase point of ions near a rock-salt lattice, with all periodic images turned or not."""
    cells = 4
    grid = np.stack(np.meshgrid(*[np.arange(cells)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    positions = (grid + np.random.default_rng(2).normal(scale=0.1, size=grid.shape)) * EDGES / cells
    box = np.diag(EDGES)
    if turn:
        # The same lattice of images: its first vector is a diagonal, its second was the first edge.
        box = np.array([box[0] + box[1], -box[0], box[2]]) @ TURN.T
        box[0, 1] = 0
        positions = positions @ TURN.T
    force = openmm.NonbondedForce()
    force.setNonbondedMethod(force.PME)
    force.setCutoffDistance(0.5)
    force.setPMEParameters(6.6, 48, 40, 40)
    force.setUseSwitchingFunction(True)
    force.setSwitchingDistance(0.4)
    force.setUseDispersionCorrection(dispersion)
    for place in grid:
        force.addParticle((-1.0) ** place.sum(), 0.25, 0.5)
    system = assembled(len(grid) * [30.0], force)
    system.setDefaultPeriodicBoxVectors(*box)
    velocities = np.random.default_rng(3).normal(size=grid.shape)
    return system, (positions, velocities @ TURN.T if turn else velocities)


def still(system, point, name="Reference"):
    return context_at(system, openmm.VerletIntegrator(0.001), point, name)


def test_diagonal_against_the_barostat_of_openmm():
    system, point = salt()
    tensor = tensor_of(still(system, point))
    barostat = openmm.MonteCarloAnisotropicBarostat(openmm.Vec3(1, 1, 1), 300, True, True, True, 0)
    system.addForce(barostat)
    theirs = barostat.computeCurrentPressure(still(system, point))
    # Theirs takes the same differences. Ions are molecules of one atom, whose centre is no matter of definition.
    np.testing.assert_allclose(np.diag(tensor), np.array(theirs.value_in_unit(unit.bar)) * BAR, rtol=1e-6)


def test_shear_is_the_diagonal_of_a_turned_box():
    """The same lattice of periodic images, in a box that is not rectangular."""
    straight = tensor_of(still(*salt()))
    # The Reference platform of OpenMM 8.6 misses pairs where a box is as oblique and as small as this one.
    turned = tensor_of(still(*salt(turn=True), "CPU"))
    # The meshes of PME are different ones, and the CPU platform has single precision.
    np.testing.assert_allclose(turned, TURN @ straight @ TURN.T, rtol=0, atol=2e-3 * np.abs(straight).max())
    assert abs(straight[0, 1]) > 0.02 * np.abs(straight).max()


# --- the ideal gas ---


def gas(joined, n=20):
    """A System of bent rotors without interactions, their bodies, and positions; joined by constraints or not."""
    shape = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.12, 0.0]])
    force, rng = openmm.NonbondedForce(), np.random.default_rng(5)
    force.setNonbondedMethod(force.CutoffPeriodic)
    force.setCutoffDistance(0.5)
    for _ in range(3 * n):
        force.addParticle(0, 1, 0)
    bodies = np.arange(3 * n).reshape(n, 3).tolist()
    sides = [(i, j, np.linalg.norm(shape[i] - shape[j])) for i, j in pairwise((0, 1, 2, 0))]
    constraints = [(atoms[i], atoms[j], length) for atoms in bodies for i, j, length in sides]
    system = assembled(n * (16.0, 2.0, 1.0), force, constraints=constraints if joined else ())
    system.setDefaultPeriodicBoxVectors(*(2 * np.eye(3)))
    return system, bodies, (shape + rng.uniform(-3, 3, (n, 1, 3))).reshape(-1, 3)


@pytest.mark.parametrize("joined", [True, False])
def test_ideal_gas_of_rotors(joined):
    system, bodies, positions = gas(joined)
    rigid = RigidBodies.from_system(system, rigid=None if joined else bodies, positions=positions)
    integrator = SIERIntegrator(0.002, SIER2, rigid)
    context = started(system, integrator, positions, seed=1, steps=3)
    motion = integrator.getBodyState()
    expected = motion.p @ motion.p.T / 19.0 / 8.0
    np.testing.assert_allclose(tensor_of(context), expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    # N kT: the translational temperature of all centres.
    centres = (motion.p**2).sum() / 19.0 / 3
    assert np.trace(tensor_of(context)) / 3 * 8.0 == pytest.approx(centres, rel=1e-12)


# --- the reporter ---


def bath():
    return seeded(SIERLangevinIntegrator(297, 5, 0.002, SIER2), 1)


def trials():
    return seeded(SIERHMCIntegrator(297, 0.002, SIER2, stepsPerTrial=4), 1)


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:.*trial")
@pytest.mark.parametrize(("make", "name"), [(bath, "Reference"), (trials, "Reference"), (bath, "CPU")])
def test_runs_are_the_same_to_the_bit(tmp_path, box, make, name):
    """The second report of hybrid Monte Carlo is in mid-trial."""
    topology, system, point = box
    ends = []
    for reported in (True, False):
        simulation = simulation_of(topology, system, make(), name, point)
        if reported:
            simulation.reporters.append(PressureReporter(tmp_path / "p.csv", 3))
        # Chunks of steps are the same, since another end of one writes the bodies to the Context anew.
        for _ in range(3):
            simulation.step(3)
        ends.append((*everything(simulation.context), np.frombuffer(simulation.context.createCheckpoint(), np.uint8)))
    assert_same(*ends)
    assert len((tmp_path / "p.csv").read_text().splitlines()) == 4


def test_rows_do_not_depend_on_the_past(tmp_path, box):
    """On the CPU platform, whose neighbour list does: a restart writes the rows that the run itself would have."""
    topology, system, point = box
    simulation = simulation_of(topology, system, bath(), "CPU", point)
    simulation.reporters.append(PressureReporter(tmp_path / "whole.csv", 1))
    simulation.step(2)
    saved = simulation.context.createCheckpoint()
    simulation.step(1)
    again = simulation_of(topology, system, bath(), "CPU", point)
    again.context.loadCheckpoint(saved)
    again.currentStep = 2
    again.reporters.append(PressureReporter(tmp_path / "part.csv", 1))
    again.step(1)
    whole, part = ((tmp_path / name).read_text().splitlines() for name in ("whole.csv", "part.csv"))
    assert whole[0] == ",".join(COLUMNS)
    assert part[1] == whole[3]


def test_refusals(tmp_path, box):
    topology, positions, system = cluster_system(4)
    simulation = simulation_of(
        topology, system, SIERIntegrator(0.0005, "SIER2"), "Reference", (positions, 0 * positions)
    )
    simulation.reporters.append(PressureReporter(tmp_path / "p.csv", 1))
    with pytest.raises(ValueError, match="periodic"):
        simulation.step(1)
    held = with_forces(box[1], openmm.CustomExternalForce("x"))
    with pytest.raises(ValueError, match="CustomExternalForce"):
        MolecularPressure(context_at(held, SIERIntegrator(0.001, "SIER2"), box[2]))
    (frozen, point), (summed, _) = salt(), salt()
    frozen.setParticleMass(7, 0)
    summed.getForce(0).setNonbondedMethod(openmm.NonbondedForce.Ewald)
    with pytest.raises(ValueError, match="rectangular"):
        MolecularPressure(still(summed, point))
    with pytest.raises(ValueError, match="atom 7 "):
        MolecularPressure(still(frozen, point))


def test_parameters_and_force_groups_are_followed():
    system, point = salt()
    force = system.getForce(0)
    force.addGlobalParameter("shift", 0.0)
    force.addParticleParameterOffset("shift", 0, 1.0, 0, 0)
    context = still(system, point)
    pressure = MolecularPressure(context)
    state = context.getState(positions=True, velocities=True)
    before = pressure.components(state)
    context.setParameter("shift", -1.0)
    assert np.abs(pressure.components(state) - before).max() > 1e-3 * np.abs(before).max()
    context.getIntegrator().setIntegrationForceGroups(0)
    momenta = 30.0 * point[1].T @ point[1]
    expected = [momenta[axes] / EDGES.prod() / BAR for axes in COMPONENTS]
    np.testing.assert_allclose(pressure.components(state), expected, rtol=1e-12)


# --- a run beside it ---


@pytest.mark.parametrize("observe", [tensor_of, check_forces], ids=["pressure tensor", "check of forces"])
def test_random_numbers_of_openmm_continue_in_the_first_context(observe):
    """Leave alone what all Contexts of a process share: random numbers of barostats, on Reference those of baths."""
    positions = 0.5 * np.array(list(np.ndindex(4, 4, 4)))
    system, pairs = openmm.System(), openmm.NonbondedForce()
    for _ in positions:
        system.addParticle(40)
        pairs.addParticle(0, 0.34, 1)
    system.setDefaultPeriodicBoxVectors(*2.0 * np.eye(3))
    pairs.setNonbondedMethod(pairs.CutoffPeriodic)
    pairs.setCutoffDistance(0.9)
    system.addForce(pairs)
    system.addForce(seeded(openmm.MonteCarloBarostat(1 * unit.bar, 300, 2), 5))
    runs = []
    for is_observed in (False, True):
        integrator = seeded(openmm.LangevinMiddleIntegrator(300, 1, 0.002), 3)
        context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
        context.setPositions(positions)
        context.setVelocitiesToTemperature(300, 1)
        if is_observed:
            observe(context)
        integrator.step(8)
        runs.append(array(context.getState(positions=True).getPositions(asNumpy=True)))
    assert np.array_equal(*runs)
