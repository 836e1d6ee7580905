"""Systems and Forces that tests make by hand."""

import openmm


def assembled(masses, *forces, constraints=()):
    """A System of particles.

    Args:
        masses: in dalton.
        forces: what acts on them.
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
