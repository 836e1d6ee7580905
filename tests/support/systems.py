"""Systems and Forces of a few particles."""

import numpy as np
import openmm


def assembled(masses, *forces, constraints=()):
    """A System of particles.

    Args:
        masses: in dalton.
        forces: OpenMM's Forces.
        constraints: (i, j, length in nm).
    """
    system = openmm.System()
    for mass in masses:
        system.addParticle(mass)
    for constraint in constraints:
        system.addConstraint(*constraint)
    for force in forces:
        system.addForce(force)
    return system


def with_forces(system, *forces):
    """A copy of a System to which copies of Forces are added."""
    system = openmm.XmlSerializer.clone(system)
    for force in forces:
        system.addForce(openmm.XmlSerializer.clone(force))
    return system


def field(energy, atoms, **parameters):
    """A CustomExternalForce that acts on atoms alike, and has global parameters."""
    force = openmm.CustomExternalForce(energy)
    for name, value in parameters.items():
        force.addGlobalParameter(name, value)
    for atom in atoms:
        force.addParticle(atom)
    return force


def rotors(frozen=False):
    """A water molecule without forces, a chain of three atoms with two constraints, and perhaps a frozen atom."""
    constraints = ((0, 1, 0.1), (0, 2, 0.1), (1, 2, 0.16), (3, 4, 0.15), (4, 5, 0.15))
    system = assembled((16.0, 1.0, 1.0, 12.0, 14.0, 12.0), constraints=constraints)
    water = np.array([[0.0, 0.0, 0.0], [0.08, 0.06, 0.0], [-0.08, 0.06, 0.0]])
    chain = np.array([[0.15, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.15, 0.0]])
    positions = np.concatenate([water, chain + 2])
    if frozen:
        system.addParticle(0.0)
        positions = np.concatenate([positions, [[3.0, 3.0, 3.0]]])
    return system, positions
