"""Bonds that a PDB or PDBx/mmCIF file lists itself, some of which may be left from another file."""

import re
from collections.abc import Callable, Iterable

from openmm import app
from openmm.unit import Quantity

from openmm_sier.inputs.pdb_files import ForceFieldError

#: What OpenMM's messages call a residue that has no template, by its index.
_RESIDUE = re.compile(r"residue (\d+) \(")


def listed_bonds(topology: app.Topology, positions: Quantity) -> list[app.topology.Bond]:
    """Return the bonds of a topology that do not follow from the names of its residues, or from bridges of sulfur.

    Args:
        topology: openmm.app.Topology.
        positions: (N, 3).
    """
    standard = _copied(topology, [])
    standard.createStandardBonds()
    standard.createDisulfideBonds(positions)
    known = {_pair(bond) for bond in standard.bonds()}
    return [bond for bond in topology.bonds() if _pair(bond) not in known]


def tell_stale_bonds(
    error: ForceFieldError, topology: app.Topology, positions: Quantity, match: Callable[[app.Topology], object]
) -> str:
    """Return what to say of listed bonds that alone keep a residue from its template; empty where there are none.

    Args:
        error: names the residue that has no template.
        topology, positions: for `listed_bonds`.
        match: finds templates for all residues, with an error of the same form where it fails.
    """
    if (residue := _unmatched(error)) is None:
        return ""
    listed = [
        bond for bond in listed_bonds(topology, positions) if residue in (bond[0].residue.index, bond[1].residue.index)
    ]
    if not listed:
        return ""
    left_out = {_pair(bond) for bond in listed}
    try:
        match(_copied(topology, [bond for bond in topology.bonds() if _pair(bond) not in left_out]))
    except ForceFieldError as other:
        if _unmatched(other) == residue:
            return ""
    one, two = (f"{atom.name} of {atom.residue.name} {atom.residue.id}" for atom in listed[0])
    more = f" (there are {len(listed) - 1} more such bonds)" if len(listed) > 1 else ""
    return (
        f". A record of the file bonds {one} to {two}{more}; without it the residue has a template. If the record is "
        "left from another file, remove it (CONECT in a PDB file, _struct_conn in a PDBx/mmCIF file)"
    )


def _unmatched(error: ForceFieldError) -> int | None:
    """Return the index of the residue that an error names."""
    found = _RESIDUE.search(str(error))
    return None if found is None else int(found[1])


def _pair(bond: app.topology.Bond) -> frozenset[int]:
    return frozenset(atom.index for atom in bond)


def _copied(topology: app.Topology, bonds: Iterable[app.topology.Bond]) -> app.Topology:
    """Return a topology of the same atoms with other bonds."""
    made = app.Topology()
    made.setPeriodicBoxVectors(topology.getPeriodicBoxVectors())
    atoms = []
    for chain in topology.chains():
        chain_made = made.addChain(chain.id)
        for residue in chain.residues():
            residue_made = made.addResidue(residue.name, chain_made, residue.id, residue.insertionCode)
            atoms += [made.addAtom(atom.name, atom.element, residue_made, atom.id) for atom in residue.atoms()]
    for bond in bonds:
        made.addBond(atoms[bond[0].index], atoms[bond[1].index], bond.type, bond.order)
    return made
