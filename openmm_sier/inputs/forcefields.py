"""Find the force field of a PDB file, and build Systems with it."""

import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import openmm
from openmm import app, unit
from openmm.unit import Quantity

from openmm_sier.inputs.pdb_files import ForceFieldError, box_vectors, extent, read_pdb, refusing
from openmm_sier.inputs.source_files import FilePath, SourceFile
from openmm_sier.observe.conservation import density
from openmm_sier.prepare.masses import set_hydrogen_masses
from openmm_sier.prepare.pme import balance_pme, mesh_of, meshed_forces
from openmm_sier.system import tables
from openmm_sier.system.arguments import checked_positions
from openmm_sier.system.checks import refuse_sites_without_place
from openmm_sier.system.cut_molecules import Bonds, joined_by
from openmm_sier.system.inner_forces import all_forces
from openmm_sier.system.molecules import make_whole
from openmm_sier.system.untrusted_files import open_regular

#: Directories of this project's force fields and boxes, in an installed package and in a checkout.
PACKAGE = Path(__file__).parent.parent
SHIPPED = (PACKAGE / "systems", PACKAGE.parent / "systems")

#: Directory of OpenMM's force fields.
OF_OPENMM = Path(app.__file__).parent / "data"

#: Start of PDB records that name a force-field file.
REMARK = "REMARK  99 FORCEFIELD"

#: Default cut-off in a periodic box, and start of the switching of Lennard-Jones interactions, nm.
CUTOFF = 0.9
SWITCH = 0.75

#: Default ewaldErrorTolerance. A smaller one helps no scheme at its usual step: with balanced sums rms(H)/rms(V) in
#: water at 6 fs is 0.0145 % for SIER4P and 0.09 % for SIER4G.
EWALD_TOLERANCE = 1e-4

#: Values of OpenMM's argument `constraints`: bonds to hydrogen, all bonds, or all bonds and angles of hydrogens.
CONSTRAINTS = {"none": None, "hbonds": app.HBonds, "allbonds": app.AllBonds, "hangles": app.HAngles}

#: Maximum cut-off as a fraction of the smallest box width. OpenMM refuses 0.5, and a barostat may shrink the box.
LARGEST_CUTOFF = 0.45


#: Maximum number of mesh points of PME, which take 8 GiB in single precision.
MOST_MESH_POINTS = 2**31


class Interactions(NamedTuple):
    """Settings of nonbonded interactions and hydrogen masses; None for the defaults of `pme_system`.

    Attributes:
        cutoff: cut-off of the direct sum of PME and of Lennard-Jones interactions, nm.
        switch: start of the switching of Lennard-Jones interactions, nm; 0 for a jump at the cut-off.
        tolerance: error tolerance of PME.
        hydrogen_mass: mass of hydrogens, in water too, dalton, at the expense of the atoms they are bonded to.
    """

    cutoff: float | None = None
    switch: float | None = None
    tolerance: float | None = None
    hydrogen_mass: float | None = None


USUAL = Interactions()


def pick(path: FilePath) -> tuple[tuple[str, ...], str]:
    """Return the force-field files in records "REMARK  99 FORCEFIELD file.xml" of a PDB file, and a reason in words.

    Raises:
        ForceFieldError: there is no such record.
        OSError: the file cannot be read.
    """
    lines = SourceFile.of(path).lines
    if not (named := tuple(line[len(REMARK) :].strip() for line in lines if line.startswith(REMARK))):
        such = f"tip3p.xml for water, or in a record '{REMARK} tip3p.xml' of the PDB file"
        raise ForceFieldError(f"no force field is named: give its `files` (--forcefield), such as {such}")
    return named, "named in the PDB file"


def load(files: Sequence[str], directory: FilePath = ".") -> app.ForceField:
    """Load a ForceField from files, searched as given, in `directory`, in this project and in OpenMM.

    Raises:
        ForceFieldError: a file is not found, or is not a force field.
    """
    with refusing(f"cannot read the force field {' '.join(files)}"):
        return app.ForceField(*[locate(name, Path(directory)) for name in files])


def locate(name: str, directory: Path) -> str:
    """Return the path of a force-field file, or its name if OpenMM is to search for it; see `load`.

    Raises:
        OSError: the file is not regular, or cannot be read.
    """
    for place in (folder / name for folder in (Path(), directory, *SHIPPED)):
        if place.exists() and not place.is_dir():
            open_regular(place).close()
            return str(place)
    return name


def foreign_files(names: Iterable[str], directory: Path) -> list[str]:
    """Return the force-field files that come neither with OpenMM nor with this project; see `load`."""
    return [name for name in names if not _is_installed(Path(locate(name, directory)))]


def _is_installed(path: Path) -> bool:
    """Return whether a file that `locate` gives comes with OpenMM or with this project."""
    if path.exists():
        return any(path.resolve().is_relative_to(folder.resolve()) for folder in (*SHIPPED, OF_OPENMM))
    # OpenMM looks for it in its own directories, out of which a name may lead.
    return not path.is_absolute() and ".." not in path.parts


def add_virtual_sites(
    topology: app.Topology, positions: Quantity, forcefield: app.ForceField
) -> tuple[app.Topology, Quantity]:
    """Return topology and positions (a Quantity) with the virtual sites of the force field added.

    Raises:
        ForceFieldError: the force field has no template for a residue.
    """

    modeller = app.Modeller(topology, positions)
    with refusing():
        modeller.addExtraParticles(forcefield)
    return modeller.topology, modeller.positions


def _has_extra_particles(forcefield: app.ForceField) -> bool:
    """Return whether a template of a force field has particles without an element."""
    return any(atom.element is None for template in forcefield._templates.values() for atom in template.atoms)


def pme_system(
    topology: app.Topology,
    forcefield: app.ForceField,
    constraints: str | None = None,
    interactions: Interactions = USUAL,
) -> openmm.System:
    """Return the System of a box: rigid water, with PME in a periodic box, or else without a cut-off.

    The cut-off is shorter in a small box. The sums of PME are balanced (`openmm_sier.balance_pme`). Lennard-Jones
    interactions have the usual long-range correction. The motion of the centre of mass is not removed.

    Args:
        topology: openmm.app.Topology.
        forcefield: openmm.app.ForceField.
        constraints: constraints besides those of water, one of `CONSTRAINTS`; None for none.
        interactions: settings other than the defaults.

    Raises:
        ForceFieldError: the force field has no template for a residue, or the interactions do not fit the box.
    """
    create = partial(forcefield.createSystem, topology)
    return build_system(create, topology.getPeriodicBoxVectors(), constraints, interactions)


def build_system(
    create: Callable[..., openmm.System],
    box: Quantity | None,
    constraints: str | None = None,
    interactions: Interactions = USUAL,
) -> openmm.System:
    """Return the System of one of OpenMM's readers, with the settings of `pme_system`.

    Args:
        create: createSystem of the reader.
        box: periodic box vectors; None without a box.
        constraints, interactions: see `pme_system`.

    Raises:
        ForceFieldError: OpenMM cannot create a System, or the interactions do not fit the box.
    """
    settings = {"constraints": CONSTRAINTS[constraints or "none"], **_cut_off(box, interactions)}
    with refusing():
        system = create(rigidWater=True, removeCMMotion=False, **settings)
        refuse_sites_without_place(system)
    finish_system(system, interactions)
    return system


def finish_system(system: openmm.System, interactions: Interactions) -> None:
    """Set the requested masses of hydrogens in a System, and balance its PME.

    Raises:
        ForceFieldError: the mesh is too large.
        ValueError: see `balance_pme`.
    """
    if interactions.hydrogen_mass is not None:
        set_hydrogen_masses(system, interactions.hydrogen_mass)
    if meshed_forces(system):
        balance_pme(system)
    _refuse_huge_meshes(system)


def _cut_off(box: Quantity | None, interactions: Interactions) -> dict[str, Any]:
    """Return the arguments of createSystem for cut-offs."""
    if box is None:
        if interactions.cutoff is not None or interactions.switch is not None:
            raise ForceFieldError("a cut-off or switch needs a periodic box, and there is none")
        return {"nonbondedMethod": app.NoCutoff}
    # In OpenMM's reduced form, a is along x and b in the xy plane.
    width = float(np.diag(np.array(box.value_in_unit(unit.nanometer))).min())
    cutoff = interactions.cutoff or min(CUTOFF, LARGEST_CUTOFF * width)
    if 2 * cutoff >= width:
        raise ForceFieldError(f"a cut-off of {cutoff:g} nm needs a box wider than {2 * cutoff:g} nm, got {width:.4g}")
    switch = cutoff * SWITCH / CUTOFF if interactions.switch is None else interactions.switch
    if switch >= cutoff:
        raise ForceFieldError(f"the switch must begin below the cut-off of {cutoff:g} nm, got {switch:g} nm")
    return {
        "nonbondedMethod": app.PME,
        "nonbondedCutoff": cutoff * unit.nanometer,
        "switchDistance": switch * unit.nanometer if switch else None,
        "ewaldErrorTolerance": interactions.tolerance or EWALD_TOLERANCE,
    }


def _refuse_huge_meshes(system: openmm.System) -> None:
    """Refuse a box whose PME would take minutes and gigabytes before it fails.

    Raises:
        ForceFieldError: the mesh is too large.
    """
    for force in meshed_forces(system):
        mesh = mesh_of(force, system)
        if math.prod(mesh) > MOST_MESH_POINTS:
            vectors = [vector.value_in_unit(unit.nanometer) for vector in system.getDefaultPeriodicBoxVectors()]
            raise ForceFieldError(
                f"the box of {extent(np.array(vectors))} needs a mesh of {' x '.join(map(str, mesh))} points for PME, "
                f"more than {MOST_MESH_POINTS}: are the edges of the box in Angstrom?"
            )


class Box(NamedTuple):
    """Coordinates and System of a simulation, with whole molecules.

    Attributes:
        topology: openmm.app.Topology, including virtual sites.
        positions: Quantity, including virtual sites.
        system: openmm.System.
        files: files of the force field.
        reason: reason for these files, in words.
        listed: indices of the particles listed in the coordinate file, without added virtual sites.
    """

    topology: app.Topology
    positions: unit.Quantity
    system: openmm.System
    files: tuple[str, ...]
    reason: str
    listed: np.ndarray


def read_box(
    path: FilePath,
    files: Sequence[FilePath] | None = None,
    constraints: str | None = None,
    interactions: Interactions = USUAL,
    edges: Sequence[float] | None = None,
) -> Box:
    """Read a PDB or PDBx/mmCIF file and build its System.

    Args:
        path: the file.
        files: force-field files; None for those named in the PDB file, see `pick`.
        constraints, interactions: see `pme_system`.
        edges: edges of the periodic box, nm, if the file has none.

    Raises:
        ForceFieldError: the file has another format, duplicate atoms, or a box too small for its atoms; no force field
            fits it; or a molecule is broken, see `openmm_sier.make_whole`.
        OSError: the file cannot be read.
    """
    source = SourceFile.of(path)
    pdb = read_pdb(source, edges)
    lengths = checked_positions(pdb.positions, pdb.topology.getNumAtoms())
    # Force fields need whole molecules to place virtual sites.
    lengths = joined_by(Bonds.guessed(pdb.topology), lengths, box_vectors(pdb.topology))
    try:
        chosen, reason = (tuple(map(str, files)), "as given") if files else pick(source)
        forcefield = load(chosen, Path(path).parent)
        topology, positions = pdb.topology, lengths * unit.nanometer
        if _has_extra_particles(forcefield):
            topology, positions = add_virtual_sites(topology, positions, forcefield)
        system = pme_system(topology, forcefield, constraints, interactions)
        whole = make_whole(system, positions, topology)
    except ValueError as error:
        raise ForceFieldError(f"{path}: {error}") from None
    listed = np.array([atom.index for atom in topology.atoms() if atom.element is not None])
    if len(listed) != pdb.topology.getNumAtoms():
        listed = np.arange(topology.getNumAtoms())
    return Box(topology, whole * unit.nanometer, system, chosen, reason, listed)


def describe(box: Box) -> str:
    """Return the size and treatment of the interactions, in words."""
    vectors = box_vectors(box.topology)
    residues, nonbonded = f"{box.topology.getNumResidues()} residues", _described_interactions(box.system)
    if vectors is None:
        return f"{residues} without a periodic box, {nonbonded}"
    return f"{residues} in {extent(vectors)} at {density_of(box):.3g} g/ml, {nonbonded}"


def density_of(box: Box) -> float | None:
    """Return the density of a box, g/ml; None if it is not periodic."""
    if (vectors := box_vectors(box.topology)) is None:
        return None
    return density(sum(tables.masses(box.system)), abs(float(np.linalg.det(vectors))))


def _described_interactions(system: openmm.System) -> str:
    force = next((entry.force for entry in all_forces(system) if isinstance(entry.force, openmm.NonbondedForce)), None)
    if force is None or force.getNonbondedMethod() == force.NoCutoff:
        return "no cut-off"
    names = ("NoCutoff", "CutoffNonPeriodic", "CutoffPeriodic", "Ewald", "PME", "LJPME")
    cutoff = force.getCutoffDistance().value_in_unit(unit.nanometer)
    return f"{names[force.getNonbondedMethod()]} with a cut-off of {cutoff:.3g} nm"
