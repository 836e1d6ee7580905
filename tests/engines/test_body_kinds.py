"""Rigid bodies of every kind: named or constrained, alone and mixed with what is not rigid."""

import io
from itertools import combinations

import numpy as np
import openmm
import pytest
from openmm import app, unit
from scipy.spatial.transform import Rotation

from openmm_sier import RigidBodies, RigidityError, SIER2Integrator, SIER4Integrator
from openmm_sier.dynamics.constants import GAS_CONSTANT
from tests.support.cages import cage
from tests.support.flexible_systems import started
from tests.support.solutes import disulfide, ion, spc, system_of, water
from tests.support.waters import context_at, energies, phase_point, platform


def ring(n, radius, height=0.0):
    """n points on a circle about the z axis."""
    angles = 2 * np.pi * np.arange(n) / n
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(n, height)], axis=1)


AXES = np.concatenate([np.eye(3), -np.eye(3)])
TETRAHEDRON = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)

#: Masses, coordinates in nm and charges of rigid molecules.
KINDS = {
    "CO2": ([16.0, 12.0, 16.0], [[0, 0, -0.116], [0, 0, 0], [0, 0, 0.116]], [-0.35, 0.7, -0.35]),
    "CH4": ([12.0] + 4 * [1.0], np.vstack([[0, 0, 0], 0.109 * TETRAHEDRON]), [-0.4] + 4 * [0.1]),
    "SF6": ([32.0] + 6 * [19.0], np.vstack([[0, 0, 0], 0.156 * AXES]), [1.2] + 6 * [-0.2]),
    "NH3": ([14.0] + 3 * [1.0], np.vstack([[0, 0, 0], ring(3, 0.0938, 0.038)]), [-0.9] + 3 * [0.3]),
    "BNZ": (6 * [12.0] + 6 * [1.0], np.vstack([ring(6, 0.139), ring(6, 0.248)]), 6 * [-0.12] + 6 * [0.12]),
    "C60": (60 * [12.0], cage(0.142), 60 * [0.0]),
}
KINDS = {name: tuple(np.array(part, dtype=float) for part in parts) for name, parts in KINDS.items()}
every_kind = pytest.mark.parametrize("kind", KINDS)


class Gas:
    """A few molecules of one kind in a soft, uneven trap.

    Attributes:
        system: interactions, and constraints if they were asked for.
        topology: a residue each molecule.
        clusters: particle indices of each molecule.
        point: positions and velocities of a rigid motion.
    """

    def __init__(self, kind, molecules=3, constrained=False, seed=1):
        masses, coordinates, charges = KINDS[kind]
        rng = np.random.default_rng(seed)
        self.system, self.topology = openmm.System(), app.Topology()
        self.clusters = []
        chain = self.topology.addChain()
        nonbonded, trap = openmm.NonbondedForce(), openmm.CustomExternalForce("40*(x^2 + 2*y^2 + 3*z^2) + 9*x*y*z")
        positions, velocities = [], []
        self.motions = list(motions_of(molecules, np.linalg.norm(coordinates, axis=1).max(), rng))
        for centre, turn, velocity, omega in self.motions:
            residue = self.topology.addResidue(kind, chain)
            arms = (coordinates - masses @ coordinates / masses.sum()) @ turn.T
            positions.append(centre + arms)
            velocities.append(velocity + np.cross(omega, arms))
            atoms = [self.system.addParticle(mass) for mass in masses]
            for atom, charge in zip(atoms, charges, strict=True):
                self.topology.addAtom(f"X{atom}", app.element.carbon, residue)
                nonbonded.addParticle(charge, 0.3, 0.4)
                trap.addParticle(atom)
            for i, j in combinations(atoms, 2):
                nonbonded.addException(i, j, 0, 1, 0)
                if constrained:
                    self.system.addConstraint(
                        i, j, np.linalg.norm(positions[-1][i - atoms[0]] - positions[-1][j - atoms[0]])
                    )
            self.clusters.append(atoms)
        self.system.addForce(nonbonded)
        self.system.addForce(trap)
        self.point = np.concatenate(positions), np.concatenate(velocities)


def motions_of(molecules, radius, rng):
    """Centre, attitude, velocity and angular velocity of each of a few molecules in a row."""
    for number in range(molecules):
        centre = np.array([(number - 0.5 * (molecules - 1)) * (2 * radius + 0.32), *rng.uniform(-0.05, 0.05, 2)])
        turn = Rotation.random(rng=rng).as_matrix()
        yield centre, turn, rng.normal(scale=0.4, size=3), rng.normal(scale=0.3 / radius, size=3)


def ends_of(integrator, gas, steps, name="Reference", system=None):
    context = context_at(system or gas.system, integrator, gas.point, name, steps=steps)
    return phase_point(context)


@every_kind
def test_named_by_atoms_or_by_residue_or_constrained_they_move_alike(kind):
    gas = Gas(kind)
    ends = [ends_of(SIER4Integrator(0.002, bodies=gas.clusters), gas, 25)]
    residues = RigidBodies.from_system(gas.system, gas.topology, {kind: "rigid"}, gas.point[0] * unit.nanometer)
    ends.append(ends_of(SIER4Integrator(0.002, bodies=residues), gas, 25))
    # OpenMM inverts the matrix of 1770 constraints, which takes minutes; constraints of atoms in a row are refused.
    if kind not in ("C60", "CO2"):
        ends.append(ends_of(SIER4Integrator(0.002), Gas(kind, constrained=True), 25))
    for end in ends[1:]:
        # The geometries differ by the rounding of coordinates; constraint lengths make them by an eigenvalue problem
        # with their squares.
        assert np.abs(end[0] - ends[0][0]).max() < 1e-11
        assert np.abs(end[1] - ends[0][1]).max() < 1e-9


def peer_of(kind, gas):
    """The same dynamics without this package: two to four mass points, held by constraints, that carry the atoms.

    Points of equal mass with the same second moments as the molecule have its tensor of inertia. The atoms are virtual
    sites on them.
    """
    masses, coordinates, _ = KINDS[kind]
    sites = coordinates - masses @ coordinates / masses.sum()
    squares, axes = np.linalg.eigh(np.einsum("k,kx,ky->xy", masses / masses.sum(), sites, sites))
    spread = np.sqrt(np.maximum(squares, 0))
    rank = int((spread > 1e-8).sum())
    corners = {
        1: np.array([[0, 0, 1], [0, 0, -1]]),
        2: np.sqrt(2) * ring(3, 1.0)[:, [2, 0, 1]],
        3: np.sqrt(3) * TETRAHEDRON,
    }[rank]
    points = (corners * spread) @ axes.T
    count = len(points)

    system = openmm.System()
    positions, velocities = np.zeros((0, 3)), np.zeros((0, 3))
    nonbonded, trap = (openmm.XmlSerializer.clone(gas.system.getForce(i)) for i in range(2))
    parts = openmm.NonbondedForce(), openmm.CustomExternalForce(trap.getEnergyFunction())
    for number, (centre, turn, velocity, omega) in enumerate(gas.motions):
        first = system.getNumParticles()
        for _ in range(count):
            system.addParticle(masses.sum() / count)
            parts[0].addParticle(0, 1, 0)
        for i, j in combinations(range(count), 2):
            system.addConstraint(first + i, first + j, np.linalg.norm(points[i] - points[j]))
        carried = []
        for atom, site in zip(gas.clusters[number], sites, strict=True):
            index = system.addParticle(0)
            system.setVirtualSite(index, virtual_site(range(first, first + count), points, site))
            parts[0].addParticle(*nonbonded.getParticleParameters(atom))
            parts[1].addParticle(index)
            carried.append(index)
        for i, j in combinations(carried, 2):
            parts[0].addException(i, j, 0, 1, 0)
        arms = np.vstack([points, sites]) @ turn.T
        positions = np.vstack([positions, centre + arms])
        velocities = np.vstack([velocities, velocity + np.cross(omega, arms)])
    for force in parts:
        system.addForce(force)
    massive = np.array([system.getParticleMass(i)._value > 0 for i in range(system.getNumParticles())])
    return system, (positions, velocities), np.flatnonzero(~massive)


def rotated_velocity_verlet(h):
    """Constrained velocity Verlet (RATTLE) whose second half kick comes with the next step, positions being the same.

    A CustomIntegrator moves virtual sites at the end of a step only, so that forces must not be asked for before.
    """
    verlet = openmm.CustomIntegrator(h)
    verlet.addPerDofVariable("x1", 0)
    verlet.addGlobalVariable("started", 0)
    verlet.addUpdateContextState()
    verlet.beginIfBlock("started > 0.5")
    verlet.addComputePerDof("v", "v+0.5*dt*f/m+(x-x1)/dt")
    verlet.addConstrainVelocities()
    verlet.endBlock()
    verlet.addComputePerDof("v", "v+0.5*dt*f/m")
    verlet.addComputePerDof("x", "x+dt*v")
    verlet.addComputePerDof("x1", "x")
    verlet.addConstrainPositions()
    verlet.addComputeGlobal("started", "1")
    verlet.setConstraintTolerance(1e-10)
    return verlet


def virtual_site(parents, points, site):
    if len(points) == 2:
        span = points[1] - points[0]
        weight = (site - points[0]) @ span / (span @ span)
        return openmm.TwoParticleAverageSite(*parents, 1 - weight, weight)
    x = points[1] - points[0]
    z = np.cross(x, points[2] - points[0])
    frame = np.stack([x, np.cross(z, x), z])
    frame /= np.linalg.norm(frame, axis=1, keepdims=True)
    weights = [openmm.Vec3(*weight) for weight in ([1, 0, 0], [-1, 1, 0], [-1, 0, 1])]
    return openmm.LocalCoordinatesSite(*list(parents)[:3], *weights, openmm.Vec3(*frame @ (site - points[0])))


@every_kind
def test_they_move_as_openmm_moves_their_peers(kind):
    """Both are second-order methods from one start, so that they differ by O(h^2)."""
    gas = Gas(kind)
    system, point, atoms = peer_of(kind, gas)
    differences = []
    for h in (0.002, 0.001):
        ours = ends_of(SIER2Integrator(h, bodies=gas.clusters), gas, round(0.04 / h))
        verlet = rotated_velocity_verlet(h)
        context = context_at(system, verlet, point)
        context.computeVirtualSites()
        verlet.step(round(0.04 / h))
        differences.append(np.abs(ours[0] - phase_point(context)[0][atoms]).max())
    # The constraints of the peers hold to 1e-10.
    assert 1e-8 < differences[1] < 1e-4
    assert 3.6 < differences[0] / differences[1] < 4.4


@every_kind
def test_temperature_in_reports_counts_the_freedoms_of_the_bodies(kind):
    gas = Gas(kind)
    simulation = app.Simulation(gas.topology, gas.system, SIER2Integrator(0.001, bodies=gas.clusters), platform())
    simulation.context.setPositions(gas.point[0])
    simulation.context.setVelocities(gas.point[1])
    log = io.StringIO()
    simulation.reporters.append(app.StateDataReporter(log, 5, temperature=True, kineticEnergy=True))
    simulation.step(5)
    kinetic, temperature = map(float, log.getvalue().splitlines()[1].split(","))
    freedoms = 5 if kind == "CO2" else 6
    assert temperature == pytest.approx(2 * kinetic / (3 * freedoms * GAS_CONSTANT), rel=1e-12)
    assert kinetic == pytest.approx(energies(simulation.context)[1], rel=1e-12)


# --- mirror images ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("constrained", [False, True], ids=["named", "constrained"])
def test_mirror_images_in_one_system(constrained):
    geometry = np.array([[0, 0, 0], [0.1, 0, 0.01], [0.02, 0.11, 0], [0, 0.03, 0.12]])
    masses = [12.0, 1.0, 16.0, 14.0]
    system, named, positions = openmm.System(), [], []
    trap = openmm.CustomExternalForce("40*(x^2 + 2*y^2 + 3*z^2) + 20*x*y*z")
    hands = [1, -1, -1, 1, -1]
    for number, hand in enumerate(hands):
        named.append([system.addParticle(mass) for mass in masses])
        for i, j in combinations(range(4), 2):
            if constrained:
                system.addConstraint(4 * number + i, 4 * number + j, np.linalg.norm(geometry[i] - geometry[j]))
        turn = Rotation.from_rotvec([number, 1, 2]).as_matrix() * hand
        positions.append(geometry @ turn + [0.3 * number, 0, 0])
        for atom in named[-1]:
            trap.addParticle(atom)
    system.addForce(trap)
    positions = np.concatenate(positions)
    integrator = SIER2Integrator(0.001, bodies=None if constrained else named)
    context = context_at(system, integrator, (positions, 0 * positions))
    bodies = integrator.bodies
    found = {tuple(map(tuple, species.atoms)) for species in bodies.species}
    expected = {tuple(tuple(named[b]) for b in range(5) if hands[b] == hand) for hand in (1, -1)}
    assert found == expected
    state = integrator.getBodyState()
    # Constraint lengths make the geometry to the rounding of an eigenvalue problem.
    assert np.abs(bodies.place(state.q, state.A, np.zeros((20, 3))) - positions).max() < 1e-14
    integrator.step(200)
    moved = phase_point(context)[0].reshape(5, 4, 3)
    volumes = np.linalg.det(moved[:, 1:] - moved[:, :1])
    assert np.allclose(volumes, np.linalg.det(geometry[1:]) * np.array(hands), rtol=1e-12)


# --- mixtures ---------------------------------------------------------------------------------------------------


def test_mixture_moves_as_in_openmm():
    """Rigid water, ions, carbon dioxide with a virtual site, and molecules that are not rigid."""
    system, positions = system_of([water(), ion("Na"), disulfide(), ion("Cl"), spc(), water()], dumbbells=1)
    start = started(system, openmm.VerletIntegrator(0.001), positions, 297.0)
    start.applyVelocityConstraints(1e-10)
    point, differences = phase_point(start), []
    for h in (0.001, 0.0005):
        ends = []
        for integrator in (SIER2Integrator(h), rotated_velocity_verlet(h)):
            context = context_at(system, integrator, point, steps=round(0.04 / h))
            ends.append(phase_point(context)[0])
        differences.append(np.abs(ends[0] - ends[1]).max())
    # SETTLE's lengths, of single precision, are off by 5e-9 nm.
    assert 1e-7 < differences[1] < 1e-4
    assert 3.4 < differences[0] / differences[1] < 4.6


# --- what is refused --------------------------------------------------------------------------------------------


def methyl():
    """One carbon with three hydrogens whose distances to it are constrained, as constraints=HBonds does."""
    system, topology = openmm.System(), app.Topology()
    residue = topology.addResidue("CH3", topology.addChain())
    for number, mass in enumerate((12.0, 1.0, 1.0, 1.0)):
        system.addParticle(mass)
        topology.addAtom(f"A{number}", app.element.carbon, residue)
        if number:
            system.addConstraint(0, number, 0.109)
    positions = np.vstack([[0, 0, 0], 0.109 * TETRAHEDRON[:3]])
    return system, topology, positions


@pytest.mark.parametrize(
    ("rigid", "error", "message"),
    [
        ([[0, 1]], RigidityError, "constraint between atoms 0 and 2 joins a rigid body to another particle"),
        ([[0, 1, 2, 3], [3]], ValueError, "name particle 3 twice"),
        ([[0, 1, 2, 3], []], ValueError, "must name the particles of each, got an empty list in place 1"),
        ([[0, 1, 2, 7]], ValueError, "name particle 7, the System has 4 particles"),
        ({"XYZ": "rigid"}, ValueError, "name residue XYZ, which the topology does not have"),
        ({"CH3": "stiff"}, ValueError, "must be \"rigid\", got 'stiff'"),
    ],
)
def test_bodies_that_cannot_be(rigid, error, message):
    system, topology, positions = methyl()
    with pytest.raises(error, match=message):
        RigidBodies.from_system(system, topology, rigid, positions)


def test_bodies_of_something_else():
    """Positions of other particles would give a geometry without a word, as long as the named ones are among them."""
    system, topology, positions = methyl()
    with pytest.raises(ValueError, match=r"positions must have the shape \(4, 3\) .*, got \(3, 3\)"):
        RigidBodies.from_system(system, topology, [[0, 1, 2]], positions[:3])
    with pytest.raises(TypeError, match=r"must be an openmm\.System, got a Topology"):
        RigidBodies.from_system(topology)


def test_virtual_sites_in_a_named_body_ride_along():
    gas = Gas("CH4")
    gas.system.setParticleMass(4, 0)
    gas.system.setVirtualSite(4, openmm.TwoParticleAverageSite(0, 1, 1.5, -0.5))
    integrator = SIER2Integrator(0.001, bodies=gas.clusters)
    context = context_at(gas.system, integrator, gas.point)
    context.computeVirtualSites()
    integrator.step(20)
    assert integrator.bodies.atoms_of(2).tolist() == [0, 1, 2, 3] or len(integrator.bodies.species) == 2
    positions = phase_point(context)[0]
    assert np.allclose(positions[4], 1.5 * positions[0] - 0.5 * positions[1], atol=1e-15)


def test_named_bodies_need_positions():
    gas = Gas("CH4")
    integrator = SIER2Integrator(0.001, bodies=gas.clusters)
    context = openmm.Context(gas.system, integrator, platform())
    with pytest.raises(RigidityError, match=r"its atoms lie on one point.*Set the positions first"):
        _ = integrator.bodies
    context.setPositions(gas.point[0])
    assert integrator.bodies.n == 3


def periodic_gas():
    gas = Gas("CO2")
    gas.system.setDefaultPeriodicBoxVectors([4, 0, 0], [0, 4, 0], [0, 0, 4])
    gas.system.getForce(0).setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    gas.system.removeForce(1)
    return gas


@pytest.mark.parametrize(
    "barostat",
    [
        openmm.MonteCarloBarostat(1.0, 300.0, 1),
        openmm.MonteCarloAnisotropicBarostat(openmm.Vec3(1, 1, 1), 300.0, True, True, True, 1),
        openmm.MonteCarloMembraneBarostat(1.0, 0.0, 300.0, 0, 0, 1),
        openmm.MonteCarloFlexibleBarostat(1.0, 300.0, 1),
    ],
    ids=lambda b: type(b).__name__,
)
def test_barostats_must_not_tear_bodies_apart(barostat):
    """OpenMM's barostats move molecules, and atoms without bonds are molecules of their own."""
    gas = periodic_gas()
    barostat = openmm.XmlSerializer.clone(barostat)
    barostat.setRandomNumberSeed(1)
    gas.system.addForce(barostat)
    integrator = SIER2Integrator(0.001, bodies=gas.clusters)
    context = context_at(gas.system, integrator, gas.point)
    with pytest.raises(
        RigidityError, match=r"the body of atoms 0, 1, 2 consists of several molecules, which MonteCarlo"
    ):
        integrator.step(1)

    bonds = openmm.HarmonicBondForce()
    for atoms in gas.clusters:
        bonds.addBond(*atoms[:2], 0.1, 0.0)
        bonds.addBond(*atoms[1:], 0.1, 0.0)
    gas.system.addForce(bonds)
    integrator = SIER2Integrator(0.001, bodies=gas.clusters)
    context = context_at(gas.system, integrator, gas.point)
    before = context.getState().getPeriodicBoxVolume()
    integrator.step(20)
    assert context.getState().getPeriodicBoxVolume() != before

    gas.system.getForce(1).setScaleMoleculesAsRigid(False)
    context = context_at(gas.system, SIER2Integrator(0.001, bodies=gas.clusters), gas.point)
    with pytest.raises(
        RigidityError, match=r"MonteCarlo\w*Barostat scales every atom apart.*scaleMoleculesAsRigid=True"
    ):
        context.getIntegrator().step(1)
