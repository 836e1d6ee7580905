"""Rigid bodies of every kind: named or constrained, alone and mixed with flexible molecules."""

import io
from itertools import combinations

import numpy as np
import openmm
import pytest
from openmm import app
from scipy.spatial.transform import Rotation

from openmm_sier import RigidBodies, RigidityError, SIERIntegrator
from openmm_sier.dynamics.constants import GAS_CONSTANT
from tests.support.molecules import CARBON_DIOXIDE, GEOMETRIES, METHANE, TETRAHEDRON
from tests.support.seeded import seeded
from tests.support.waters import context_at, energies, phase_point, platform

#: With symmetric and spherical tops that OpenMM's constraints hold: it has none for atoms in a row or in a plane, and
#: none that follow from others.
HELD = {
    "ammonia": ([14.007, 1.008, 1.008, 1.008], TETRAHEDRON[:4], 6),
    "phosphorus": (4 * [30.974], TETRAHEDRON[1:], 6),
    **{kind: GEOMETRIES[kind] for kind in ("water", "handed", "pair")},
}
KINDS = GEOMETRIES | HELD
every_kind = pytest.mark.parametrize("kind", KINDS)


def pairs_of(kind):
    return list(combinations(range(len(KINDS[kind][0])), 2))


class Gas:
    """Three molecules of one kind in a soft, uneven trap.

    Attributes:
        system: interactions, and constraints if they were asked for.
        topology: a residue each molecule.
        clusters: particle indices of each molecule.
        point: positions and velocities of a rigid motion.
    """

    def __init__(self, kind, constrained=()):
        """
        Args:
            constrained: pairs of atoms of each molecule.
        """
        masses, coordinates, _ = KINDS[kind]
        shape = np.array(coordinates) - np.average(coordinates, axis=0, weights=masses)
        apart = 2 * np.linalg.norm(shape, axis=1).max() + 0.32
        rng = np.random.default_rng(1)
        self.system, self.topology, self.clusters = openmm.System(), app.Topology(), []
        chain = self.topology.addChain()
        nonbonded, trap = openmm.NonbondedForce(), openmm.CustomExternalForce("40*(x^2 + 2*y^2 + 3*z^2) + 9*x*y*z")
        positions, velocities = [], []
        for number in range(3):
            arms = Rotation.random(rng=rng).apply(shape)
            centre = np.array([(number - 1) * apart, *rng.uniform(-0.05, 0.05, 2)])
            positions.append(centre + arms)
            velocities.append(rng.normal(scale=0.4, size=3) + np.cross(rng.normal(scale=3.0, size=3), arms))
            residue = self.topology.addResidue(kind, chain)
            atoms = [self.system.addParticle(mass) for mass in masses]
            for atom in atoms:
                self.topology.addAtom("X", app.element.carbon, residue)
                nonbonded.addParticle(0.1 * (-1) ** atom, 0.3, 0.4)
                trap.addParticle(atom)
            for i, j in pairs_of(kind):
                nonbonded.addException(atoms[i], atoms[j], 0, 1, 0)
            for i, j in constrained:
                self.system.addConstraint(atoms[i], atoms[j], np.linalg.norm(arms[i] - arms[j]))
            self.clusters.append(atoms)
        self.system.addForce(nonbonded)
        self.system.addForce(trap)
        self.point = np.concatenate(positions), np.concatenate(velocities)

    @property
    def bodies(self):
        """The molecules as bodies of their present shape."""
        return RigidBodies.from_system(self.system, rigid=self.clusters, positions=self.point[0])


@every_kind
def test_temperature_in_reports_counts_the_freedoms_of_the_bodies(kind):
    gas = Gas(kind)
    simulation = app.Simulation(gas.topology, gas.system, SIERIntegrator(0.001, "SIER2", bodies=gas.bodies), platform())
    simulation.context.setPositions(gas.point[0])
    simulation.context.setVelocities(gas.point[1])
    log = io.StringIO()
    simulation.reporters.append(app.StateDataReporter(log, 5, temperature=True, kineticEnergy=True))
    simulation.step(5)
    kinetic, temperature = map(float, log.getvalue().splitlines()[1].split(","))
    assert temperature == pytest.approx(2 * kinetic / (3 * KINDS[kind][2] * GAS_CONSTANT), rel=1e-12)
    assert kinetic == pytest.approx(energies(simulation.context)[1], rel=1e-12)


@pytest.mark.parametrize("constrained", [False, True], ids=["named", "constrained"])
def test_mirror_images_in_one_system(constrained):
    gas = Gas("handed", pairs_of("handed") if constrained else ())
    positions = gas.point[0]
    positions[gas.clusters[1]] *= [-1, 1, 1]
    named = RigidBodies.from_system(gas.system, rigid=None if constrained else gas.clusters, positions=positions)
    integrator = SIERIntegrator(0.001, "SIER2", bodies=named)
    context = context_at(gas.system, integrator, (positions, 0 * positions))
    bodies = integrator.bodies
    assert {tuple(species.atoms[:, 0]) for species in bodies.species} == {(0, 8), (4,)}
    state = integrator.getBodyState()
    # Constraint lengths make the geometry to the rounding of an eigenvalue problem.
    assert np.abs(bodies.place(state.q, state.A, np.zeros((12, 3))) - positions).max() < 1e-14
    integrator.step(200)
    molecules = np.reshape([positions, phase_point(context)[0]], (2, 3, 4, 3))
    before, after = np.linalg.det(molecules[:, :, 1:] - molecules[:, :, :1])
    assert after == pytest.approx(before, rel=1e-12)


# --- what is refused --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rigid", "message"),
    [
        ([[0, 1, 2, 3], [3]], "name particle 3 twice"),
        ([[0, 1, 2, 3], []], "must have particles, but the list of body 1 is empty"),
        ([[0, 1, 2, 12]], "name particle 12, but the System has only 12 particles"),
    ],
)
def test_bodies_that_cannot_be(rigid, message):
    gas = Gas("handed")
    with pytest.raises(ValueError, match=message):
        RigidBodies.from_system(gas.system, gas.topology, rigid, gas.point[0])
    for wrong in ("handed", ["handed"], {"handed": "rigid"}):
        with pytest.raises(TypeError, match="lists of"):
            RigidBodies.from_system(gas.system, gas.topology, wrong, gas.point[0])


def test_bodies_of_something_else():
    """Positions of other particles would otherwise give a geometry without a warning."""
    gas = Gas("handed")
    with pytest.raises(ValueError, match=r"positions .*\(12, 3\).*\(3, 3\)"):
        RigidBodies.from_system(gas.system, gas.topology, [[0, 1, 2]], gas.point[0][:3])
    with pytest.raises(TypeError, match=r"openmm\.System, got a Topology"):
        RigidBodies.from_system(gas.topology)


def test_virtual_sites_in_a_named_body_ride_along():
    gas = Gas(METHANE)
    gas.system.setParticleMass(4, 0)
    gas.system.setVirtualSite(4, openmm.TwoParticleAverageSite(0, 1, 1.5, -0.5))
    integrator = SIERIntegrator(0.001, "SIER2", bodies=gas.bodies)
    context = context_at(gas.system, integrator, gas.point)
    context.computeVirtualSites()
    integrator.step(20)
    assert sorted(len(species.masses) for species in integrator.bodies.species) == [4, 5]
    positions = phase_point(context)[0]
    assert np.allclose(positions[4], 1.5 * positions[0] - 0.5 * positions[1], atol=1e-15)


def test_shapes_that_only_positions_give():
    """Constraints of methane leave its mirror image possible. OpenMM itself needs no shape."""
    with pytest.raises(TypeError, match=r"bodies=RigidBodies\.from_system"):
        SIERIntegrator(0.001, "SIER2", bodies=Gas(METHANE).clusters)
    gas = Gas(METHANE, pairs_of(METHANE))
    with pytest.raises(RigidityError, match=r"bodies=RigidBodies\.from"):
        openmm.Context(gas.system, SIERIntegrator(0.001, "SIER2", engine="exact"), platform())
    integrator = SIERIntegrator(0.001, "SIER2")
    _context = openmm.Context(gas.system, integrator, platform())
    assert integrator.engine == "native"


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
    gas = Gas(CARBON_DIOXIDE)
    gas.system.setDefaultPeriodicBoxVectors([4, 0, 0], [0, 4, 0], [0, 0, 4])
    gas.system.getForce(0).setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    gas.system.removeForce(1)
    gas.system.addForce(seeded(openmm.XmlSerializer.clone(barostat), 1))
    with pytest.raises(RigidityError, match=r"atoms 0, 1, 2 .*MonteCarlo"):
        openmm.Context(gas.system, SIERIntegrator(0.001, "SIER2", bodies=gas.bodies), platform())

    bonds = openmm.HarmonicBondForce()
    for atoms in gas.clusters:
        bonds.addBond(*atoms[:2], 0.1, 0.0)
        bonds.addBond(*atoms[1:], 0.1, 0.0)
    gas.system.addForce(bonds)
    integrator = seeded(SIERIntegrator(0.001, "SIER2", bodies=gas.bodies))
    context = context_at(gas.system, integrator, gas.point)
    before = context.getState().getPeriodicBoxVolume()
    integrator.step(20)
    # A gas of three molecules at 1 bar hardly minds a change of 1 %: nine in ten moves are accepted, of twenty.
    assert context.getState().getPeriodicBoxVolume() != before

    gas.system.getForce(1).setScaleMoleculesAsRigid(False)
    with pytest.raises(RigidityError, match="AsRigid=True"):
        openmm.Context(gas.system, SIERIntegrator(0.001, "SIER2", bodies=gas.bodies), platform())
