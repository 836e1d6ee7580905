"""Complete structures from archives by PDBFixer, and solvate them by OpenMM's Modeller."""

from __future__ import annotations

import io
import random
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier.inputs.file_kinds import file_kind
from openmm_sier.inputs.forcefields import REMARK, add_virtual_sites, load
from openmm_sier.inputs.pdb_files import (
    READERS,
    ForceFieldError,
    box_vectors,
    extent,
    refusing,
    warn_about_alternates,
)
from openmm_sier.observe.conservation import density

if TYPE_CHECKING:
    from pdbfixer import PDBFixer

#: Default force field.
FILES = ("amber14-all.xml", "amber14/tip3p.xml")

#: Shapes of boxes, with Modeller's names.
SHAPES = ("cube", "octahedron", "dodecahedron")

#: Minimum distance between a solute and its images, nm; concentration of ions beyond neutralization, mol/l; and pH.
PADDING, SALT, PH = 1.0, 0.15, 7.0

#: Modeller's water models by number of particles; it has one box for all models with the same number.
WATERS = {3: "tip3p", 4: "tip4pew", 5: "tip5p"}

#: Length in nm above which a bond between two residues spans a gap; the longest bonds, of sulfur, have 0.21 nm.
LONGEST_BOND = 0.3

#: Length in nm above which PDBFixer has not placed the atoms of a bond well.
STRETCHED = 0.25


class Completed(NamedTuple):
    """A structure with all its atoms.

    Attributes:
        topology: openmm.app.Topology, without a box unless the structure is in water.
        positions: Quantity.
        files: files of the force field.
        changes: pairs of a kind of change (added, replaced, left out) and its amount.
    """

    topology: app.Topology
    positions: unit.Quantity
    files: tuple[str, ...]
    changes: tuple[tuple[str, str], ...]


def complete(
    path: str | Path,
    files: Sequence[str | Path] = FILES,
    leave_out: Sequence[str] = (),
    ends: bool = False,
    ph: float = PH,
    seed: int = 1,
) -> Completed:
    """Add missing residues within chains, heavy atoms and hydrogens to a structure, by PDBFixer.

    Nonstandard residues, such as selenomethionine, are replaced by the standard residues they derive from.

    Args:
        path: path of a PDB or PDBx/mmCIF file, of which the first model is used.
        files: files of the force field for the structure.
        leave_out: names of residues to leave out.
        ends: whether missing residues at the ends of chains are added too.
        ph: pH, which determines the hydrogens of residues.
        seed: seed of the positions of added atoms.

    Raises:
        ForceFieldError: the file has another format, a chain has a gap without a sequence to fill it, a name in
            `leave_out` does not occur, or a residue has no template in the force field.
        ModuleNotFoundError: PDBFixer is not installed.
        OSError: the file cannot be read.
    """
    names = tuple(map(str, files))
    forcefield = load(names, Path(path).parent)
    if file_kind(path) not in READERS:
        raise ForceFieldError(f"{path} is not a PDB file with atoms: give a structure in PDB or PDBx/mmCIF format")
    fixer = _fixer(path)
    warn_about_alternates(path, fixer.topology)
    changes: list[tuple[str, str]] = []
    with refusing(f"cannot complete {path}"), _seeded(seed):
        changes += _left_out(fixer, path, leave_out)
        changes += _residues(fixer, ends)
        changes += _atoms(fixer, seed)
        _refuse_gaps(path, fixer.topology, fixer.positions)
        before = fixer.topology.getNumAtoms()
        fixer.addMissingHydrogens(ph)
        changes.append(("hydrogens added", f"{fixer.topology.getNumAtoms() - before}, for pH {ph:g}"))
    try:
        add_virtual_sites(fixer.topology, fixer.positions, forcefield)
    except ForceFieldError as error:
        raise ForceFieldError(
            f"{path}, with the force field {' '.join(names)}: {error}. Leave residues out by name with `leave_out` "
            "(--leave-out), or add a force field that has templates for them to `files` (--forcefield)"
        ) from error
    return Completed(fixer.topology, fixer.positions, names, tuple(changes))


def solvate(
    structure: Completed,
    shape: str = "dodecahedron",
    padding: float = PADDING,
    salt: float = SALT,
    seed: int = 1,
    directory: str | Path = ".",
) -> Completed:
    """Solvate a structure in water with ions, by Modeller.

    Args:
        structure: a structure with all its atoms.
        shape: shape of the box, one of `SHAPES`.
        padding: minimum distance between the solute and its images, nm.
        salt: concentration of ions beyond those that neutralize the solute, mol/l.
        seed: seed of the positions of ions.
        directory: additional directory to search for files of the force field.

    Raises:
        ForceFieldError: the force field has no water, or no ions.
    """
    forcefield = load(structure.files, directory)
    with refusing(f"cannot add water with the force field {' '.join(structure.files)}"), _seeded(seed):
        modeller = app.Modeller(structure.topology, structure.positions)
        modeller.addExtraParticles(forcefield)
        modeller.addSolvent(
            forcefield,
            model=WATERS[_size_of_water(forcefield)],
            padding=padding * unit.nanometer,
            boxShape=shape,
            ionicStrength=salt * unit.molar,
        )
        # Readers of the file add them again.
        modeller.delete([atom for atom in modeller.topology.atoms() if atom.element is None])
    before, after = (_names(topology) for topology in (structure.topology, modeller.topology))
    added = after - before
    waters = added.pop("HOH", 0)
    ions = ", ".join(f"{count} {name}" for name, count in sorted(added.items()))
    changes = (
        ("waters added", f"{waters}" + (f", to {before['HOH']} of the file" if before["HOH"] else "")),
        ("ions added", ions or "none"),
        ("box", f"{shape}, {_described_box(modeller.topology)}"),
    )
    return structure._replace(
        topology=modeller.topology, positions=modeller.positions, changes=structure.changes + changes
    )


def as_pdb(structure: Completed) -> str:
    """Return a PDB file that names its force field, for `openmm-sier run`."""
    file = io.StringIO()
    file.writelines(f"{REMARK} {name}\n" for name in structure.files)
    app.PDBFile.writeFile(structure.topology, structure.positions, file, keepIds=True)
    return file.getvalue()


# --- missing residues and atoms ---


def _fixer(path: str | Path) -> PDBFixer:
    """Return the PDBFixer of a file."""
    try:
        from pdbfixer import PDBFixer
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("setup needs PDBFixer; install it with: pip install 'openmm-sier[setup]'") from error
    with refusing(f"cannot read {path}"):
        return PDBFixer(filename=str(path))


@contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """Seed Python's random numbers, which Modeller uses to place hydrogens and ions, and restore them at the end."""
    before = random.getstate()
    random.seed(seed)
    try:
        yield
    finally:
        random.setstate(before)


def _left_out(fixer: PDBFixer, path: str | Path, names: Sequence[str]) -> list[tuple[str, str]]:
    """Leave out residues, and return the change."""
    if not names:
        return []
    counts = _names(fixer.topology)
    for name in names:
        if name not in counts:
            raise ForceFieldError(f"{path} has no residue {name} to leave out; it has {' '.join(sorted(counts))}")
    left_out = [residue for residue in fixer.topology.residues() if residue.name in names]
    modeller = app.Modeller(fixer.topology, fixer.positions)
    modeller.delete(left_out)
    fixer.topology, fixer.positions = modeller.topology, modeller.positions
    return [("residues left out", ", ".join(f"{counts[name]} {name}" for name in dict.fromkeys(names)))]


def _residues(fixer: PDBFixer, ends: bool) -> list[tuple[str, str]]:
    """Find missing residues, replace nonstandard ones, and return the changes."""
    changes = []
    fixer.findMissingResidues()
    chains = list(fixer.topology.chains())
    retained: dict[tuple[int, int], list[str]] = {}
    for (chain, place), names in fixer.missingResidues.items():
        residues = list(chains[chain].residues())
        inside = 0 < place < len(residues)
        if inside:
            where = f"between {_named(residues[place - 1])} and {_named(residues[place])}"
        else:
            where = f"{'before' if place == 0 else 'after'} {_named(residues[0 if place == 0 else -1])}"
        is_added = inside or ends
        retained |= {(chain, place): names} if is_added else {}
        changes.append(("residues added" if is_added else "missing at an end, left out", f"{len(names)} {where}"))
    fixer.missingResidues = retained
    fixer.findNonstandardResidues()
    replaced = Counter((residue.name, by) for residue, by in fixer.nonstandardResidues)
    changes += [("residues replaced", f"{count} {name} by {by}") for (name, by), count in replaced.items()]
    fixer.replaceNonstandardResidues()
    return changes


def _atoms(fixer: PDBFixer, seed: int) -> list[tuple[str, str]]:
    """Add heavy atoms, including those of missing residues, and return the change."""
    topology, positions = fixer.topology, fixer.positions
    fixer.findMissingAtoms()
    fixer.addMissingAtoms(seed)
    if any(length > STRETCHED for _, _, length in _bonds(fixer.topology, fixer.positions)):
        # Its minimization may end where atoms overlap. On which platform, processor and threads is chance; in double
        # precision it has not been seen.
        fixer.topology, fixer.positions = topology, positions
        fixer.platform = openmm.Platform.getPlatformByName("Reference")
        fixer.addMissingAtoms(seed)
    added = fixer.topology.getNumAtoms() - topology.getNumAtoms()
    return [("heavy atoms added", str(added))] if added else []


def _bonds(topology: app.Topology, positions: unit.Quantity) -> Iterator[tuple[Any, Any, float]]:
    """Yield the atoms of each bond, and its length, nm."""
    places = np.array(positions.value_in_unit(unit.nanometer))
    for one, two in topology.bonds():
        yield one, two, float(np.linalg.norm(places[one.index] - places[two.index]))


def _refuse_gaps(path: str | Path, topology: app.Topology, positions: unit.Quantity) -> None:
    """Refuse bonds across a gap in a chain, by which OpenMM joins the residues on either side."""
    for one, two, length in _bonds(topology, positions):
        if one.residue is not two.residue and length > LONGEST_BOND:
            raise ForceFieldError(
                f"{path}: the chain has a gap of {length:.2g} nm between {_named(one.residue)} and "
                f"{_named(two.residue)}, and the file has no sequence that fits the chain and tells which residues are "
                "missing (SEQRES in a PDB file, _entity_poly_seq in a PDBx/mmCIF file): take the file as the archive "
                "has it, or divide the chain there (TER)"
            )


# --- descriptions ---


def _names(topology: app.Topology) -> Counter[str]:
    """Return the number of residues with each name."""
    return Counter(residue.name for residue in topology.residues())


def _named(residue: Any) -> str:
    return f"{residue.name} {residue.chain.id} {residue.id}"


def _size_of_water(forcefield: app.ForceField) -> int:
    """Return the number of particles in a water molecule of the force field."""
    topology = app.Topology()
    residue = topology.addResidue("HOH", topology.addChain())
    oxygen, *hydrogens = (
        topology.addAtom(name, app.Element.getBySymbol(name[0]), residue) for name in ("O", "H1", "H2")
    )
    for hydrogen in hydrogens:
        topology.addBond(oxygen, hydrogen)
    modeller = app.Modeller(topology, np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]) * unit.nanometer)
    modeller.addExtraParticles(forcefield)
    return int(modeller.topology.getNumAtoms())


def _described_box(topology: app.Topology) -> str:
    vectors = box_vectors(topology)
    assert vectors is not None
    mass = sum(atom.element.mass.value_in_unit(unit.dalton) for atom in topology.atoms())
    return f"{extent(vectors)}, {density(mass, abs(float(np.linalg.det(vectors)))):.3g} g/ml"
