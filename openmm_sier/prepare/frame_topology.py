"""Extend a Topology by the particles of frames."""

from openmm import app

#: Name of the residue of a frame, and prefix of the names of its particles, which have no element, like virtual sites.
RESIDUE, PARTICLE = "FRM", "F"


def with_frame_atoms(topology: app.Topology, frames: list[list[int]]) -> app.Topology:
    """Return a copy of a Topology with one more chain, in which each frame is a residue.

    Args:
        topology: openmm.app.Topology.
        frames: particles of each frame, which follow those of the topology.
    """
    extended, atoms = app.Topology(), {}
    for chain in topology.chains():
        new_chain = extended.addChain(chain.id)
        for residue in chain.residues():
            new = extended.addResidue(residue.name, new_chain, residue.id, residue.insertionCode)
            for atom in residue.atoms():
                atoms[atom] = extended.addAtom(atom.name, atom.element, new, atom.id, atom.formalCharge)
    for bond in topology.bonds():
        extended.addBond(atoms[bond[0]], atoms[bond[1]], bond.type, bond.order)
    extended.setPeriodicBoxVectors(topology.getPeriodicBoxVectors())
    chain = extended.addChain()
    for number, particles in enumerate(frames, 1):
        residue = extended.addResidue(RESIDUE, chain, str(number))
        for i, _ in enumerate(particles, 1):
            extended.addAtom(f"{PARTICLE}{i}", None, residue)
    return extended
