"""Rigid bodies of many shapes without constraints, in Systems with and without frames."""

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.species import Species
from tests.support.cages import cage
from tests.support.molecules import GEOMETRIES
from tests.support.starts import displaced
from tests.support.waters import array, platform


def blob(atoms, extents, seed=5):
    """Masses (k,) in dalton and positions (k, 3) in nm of a cloud of beads about the origin."""
    rng = np.random.default_rng(seed)
    return rng.uniform(57, 186, atoms), rng.normal(size=(atoms, 3)) * extents


def benzene():
    """Masses and positions of benzene, in a plane through the origin that is no plane of the axes."""
    angles = np.pi / 3 * np.arange(6)
    ring = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    tilted = np.concatenate([0.139 * ring, 0.2485 * ring]) @ turn([1, 2, 3], 0.7)
    return np.repeat([12.011, 1.008], 6), tilted


def turn(axis, angle):
    """A rotation matrix."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


#: Masses and positions by names.
SHAPES = {
    **{name: (np.array(masses), np.array(places, dtype=float)) for name, (masses, places, _) in GEOMETRIES.items()},
    "benzene": benzene(),
    "C60": (np.full(60, 12.011), cage()),
    "36 beads": blob(36, [0.9, 0.7, 0.5]),
    "200 beads": blob(200, [1.6, 1.2, 1.0]),
    "thin": blob(40, [1.0, 0.8, 0.004]),
    "rod": blob(40, [3.0, 0.05, 0.04]),
    "ribbon": blob(40, [2.0, 0.2, 0.003]),
    "cube": (np.full(8, 20.0), 0.3 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])),
    "N2": (np.full(2, 14.007), np.array([[0, 0, 0], [0.11, 0, 0]])),
}
del SHAPES["ion"]


def system_of(*names, apart=2.5):
    """A System without Forces of bodies in a row, positions (N, 3) in nm, and the atoms of each body."""
    system, places, bodies = openmm.System(), [], []
    for number, name in enumerate(names):
        masses, shape = SHAPES[name]
        bodies.append([system.addParticle(mass) for mass in masses.tolist()])
        places.append(shape @ turn([number, 1, 2], number + 0.3) + [apart * number, 0.1, 0.2])
    return system, displaced(np.concatenate(places), system, bodies), bodies


def polar(system, bodies, charge=0.15, sigma=0.3, epsilon=0.3):
    """A NonbondedForce of bodies whose atoms have charges by turns, which leaves out pairs within them."""
    force = openmm.NonbondedForce()
    for i in range(system.getNumParticles()):
        force.addParticle(charge * (-1) ** i, sigma, epsilon)
    for atoms in bodies:
        for number, i in enumerate(atoms):
            for j in atoms[:number]:
                force.addException(i, j, 0, 1, 0)
    return force


def soft(system, bodies, stiffness=120.0):
    """Smooth attraction and repulsion of atoms of different bodies, without a cut-off, and a field that holds all."""
    force = openmm.CustomNonbondedForce("select(body1-body2, depth*(2*exp(-(r/0.5)^2) - exp(-(r/0.9)^2)), 0)")
    force.addGlobalParameter("depth", stiffness / 60)
    force.addPerParticleParameter("body")
    for number, atoms in enumerate(bodies):
        for _ in atoms:
            force.addParticle([number])
    springs = openmm.CustomExternalForce("k*(x^2 + 1.3*y^2 + 0.8*z^2)")
    springs.addPerParticleParameter("k")
    for number in range(system.getNumParticles()):
        springs.addParticle(number, [0.5 + number % 3])
    return force, springs


def topology_of(bodies, box=None):
    """A Topology with a residue for each body."""
    topology = app.Topology()
    chain = topology.addChain("A")
    carbon = app.Element.getBySymbol("C")
    for number, atoms in enumerate(bodies):
        residue = topology.addResidue("DOM", chain, str(number + 1))
        for i, _ in enumerate(atoms):
            topology.addAtom(f"C{i}", carbon, residue)
    topology.setPeriodicBoxVectors(box)
    return topology


def moved(positions, bodies, seed=2, far=0.1):
    """Positions at which each body has been turned and shifted as a whole, and points shifted."""
    rng = np.random.default_rng(seed)
    result = positions + far * rng.normal(size=positions.shape)
    for atoms in bodies:
        centre = positions[atoms].mean(axis=0)
        arms = (positions[atoms] - centre) @ turn(rng.normal(size=3), rng.uniform(0.1, 0.6))
        result[atoms] = centre + arms + far * rng.normal(size=3)
    return result


def energy_and_forces(system, positions, name="Reference"):
    """Potential energy in kJ/mol, positions (N, 3) in nm with virtual sites placed, and forces (N, 3) on particles."""
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), platform(name))
    context.setPositions(positions)
    context.computeVirtualSites()
    state = context.getState(energy=True, forces=True, positions=True)
    return array(state.getPotentialEnergy()), array(state.getPositions(asNumpy=True)), array(state.getForces())


def frame_velocities(framed, positions, velocities):
    """Velocities (P, 3) of the particles of a copy with frames, whose bodies move as atoms (N, 3) do."""
    result = np.zeros((framed.system.getNumParticles(), 3))
    result[: framed.numAtoms] = velocities
    centres, A, spins = _motion(framed.bodies, positions, velocities)
    for frame in framed.frames:
        body = frame.body
        corners = frame.shape.corners.T @ A[:, :, body]
        result[frame.atoms] = 0.0
        result[frame.particles] = centres[:, body] + np.cross(spins[:, body], corners)
    return result


def atom_velocities(framed, state):
    """Velocities of atoms, (N, 3), from a State of a copy with frames. OpenMM has none for virtual sites."""
    velocities = state.getVelocities(asNumpy=True).value_in_unit(unit.nanometer / unit.picosecond)
    species = [Species.from_sites(f.particles[None], f.shape.masses, f.shape.corners) for f in framed.frames]
    moving = BodySet(species, framed.system.getNumParticles())
    centres, A, spins = _motion(moving, array(state.getPositions()), velocities)
    result = velocities[: framed.numAtoms].copy()
    for number, frame in enumerate(framed.frames):
        arms = frame.places @ A[:, :, number]
        result[frame.atoms] = centres[:, number] + np.cross(spins[:, number], arms)
    return result


def _motion(bodies, positions, velocities):
    """Velocities of centres, (3, n), attitudes, (3, 3, n), and angular velocities, (3, n), of bodies."""
    _, A = bodies.fit(positions)
    p, L = bodies.momenta(velocities, A)
    return p / bodies.masses, A, np.einsum("axn,an,ayn,yn->xn", A, bodies.inverse_moments, A, L)


def net(positions, forces):
    """Net force and torque about the origin of particles, (2, 3)."""
    return np.array([forces.sum(axis=0), np.cross(positions, forces).sum(axis=0)])
