"""A Topology with the particles of frames."""

from openmm import app

#: Names of the residue of a frame and, with their numbers, of its particles; they have no element, like virtual sites.
RESIDUE, PARTICLE = "FRM", "F"


def with_frame_atoms(topology: app.Topology, frames: list[list[int]]) -> app.Topology:
    """Return a copy of a Topology with a last chain, which has a residue for each frame.

    Args:
        topology: openmm.app.Topology.
        frames: the particles of each, which follow those of the topology.
    """
    made, atoms = app.Topology(), {}
    for chain in topology.chains():
        new_chain = made.addChain(chain.id)
        for residue in chain.residues():
            new = made.addResidue(residue.name, new_chain, residue.id, residue.insertionCode)
            for atom in residue.atoms():
                atoms[atom] = made.addAtom(atom.name, atom.element, new, atom.id, atom.formalCharge)
    for bond in topology.bonds():
        made.addBond(atoms[bond[0]], atoms[bond[1]], bond.type, bond.order)
    made.setPeriodicBoxVectors(topology.getPeriodicBoxVectors())
    chain = made.addChain()
    for number, particles in enumerate(frames, 1):
        residue = made.addResidue(RESIDUE, chain, str(number))
        for i, _ in enumerate(particles, 1):
            made.addAtom(f"{PARTICLE}{i}", None, residue)
    return made
