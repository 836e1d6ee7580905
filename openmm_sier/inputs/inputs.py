"""Read the input of a simulation: coordinates, with a force field or a topology."""

import io
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier.inputs import forcefields
from openmm_sier.inputs.coordinates import Coordinates, read_coordinates, refuse_other_atoms
from openmm_sier.inputs.file_kinds import POSITIONS, PRMTOP, PSF, STATE, SYSTEM, TOP, TOPOLOGIES, file_kind
from openmm_sier.inputs.forcefields import USUAL, Box, Interactions
from openmm_sier.inputs.pdb_files import ForceFieldError, check_positions, named_atom, refusing
from openmm_sier.inputs.source_files import FilePath, SourceFile
from openmm_sier.system import checks, forces, tables
from openmm_sier.system.hydrogens import hydrogens
from openmm_sier.system.molecules import make_whole
from openmm_sier.system.untrusted_files import read_system

#: Arguments without effect, by the kind of topology.
IGNORED = {
    PRMTOP: ("forcefield",),
    TOP: ("forcefield",),
    PSF: (),
    SYSTEM: ("forcefield", "constraints", "cutoff", "switch", "tolerance", "edges"),
}

#: Mass of hydrogen, and a bound between the masses of deuterium and all other elements, dalton.
HYDROGEN, LIGHTEST_OTHER = 1.008, 2.5


def read_input(
    path: FilePath,
    topology: FilePath | None = None,
    files: Sequence[FilePath] | None = None,
    constraints: str | None = None,
    interactions: Interactions = USUAL,
    edges: Sequence[float] | None = None,
) -> Box:
    """Read coordinates and build the System for them.

    Args:
        path: path of the coordinates, see `openmm_sier.inputs.coordinates.read_coordinates`.
        topology: a prmtop file of AMBER, a top file of GROMACS, a psf file of CHARMM, or a System of OpenMM in XML;
            None for a PDB or PDBx/mmCIF file with a force field of OpenMM.
        files: files of the force field. For a psf file parameter, topology and stream files; for a PDB or PDBx/mmCIF
            file see `openmm_sier.inputs.forcefields.read_box`.
        constraints, interactions: see `openmm_sier.inputs.forcefields.pme_system`.
        edges: edges of a rectangular periodic box, nm, if the coordinate file has none.

    Raises:
        ForceFieldError: files have other formats or do not match, or OpenMM cannot create a System from them.
        OSError: a file cannot be read.
    """
    coordinates = SourceFile.of(path)
    if topology is None:
        _refuse_half(coordinates)
        return forcefields.read_box(coordinates, files, constraints, interactions, edges)
    kind = topology_kind(topology)
    source = _Source(coordinates, read_coordinates(coordinates, edges), SourceFile.of(topology), kind)
    if kind == SYSTEM:
        return _box_of_system(source, interactions)
    return _box_of_topology(source, files or (), constraints, interactions)


def topology_kind(path: FilePath) -> str:
    """Return the kind of a topology, see `openmm_sier.inputs.file_kinds`.

    Raises:
        ForceFieldError: the file is not a topology.
        OSError: the file cannot be read.
    """
    if (kind := file_kind(path)) not in TOPOLOGIES:
        raise ForceFieldError(
            f"{path} is {kind}, but the topology must be a prmtop file of AMBER, a top file of GROMACS, a psf file of "
            "CHARMM or a System of OpenMM in XML"
        )
    return kind


class _Source(NamedTuple):
    """Coordinates of an input, already read, and path and kind of its topology."""

    path: SourceFile
    coordinates: Coordinates
    topology: SourceFile
    kind: str


def _refuse_half(path: FilePath) -> None:
    """Refuse files that require a second file."""
    kind = file_kind(path)
    if kind in TOPOLOGIES:
        raise ForceFieldError(
            f"{path} is {kind}, but coordinates are expected: give these, and this file as `topology` (--topology)"
        )
    if kind in POSITIONS:
        kinds = "a prmtop, top or psf file, or a System of OpenMM in XML"
        raise ForceFieldError(f"{path} is {kind}, without a force field: give its `topology` (--topology) too: {kinds}")


def _box(source: _Source, system: openmm.System, topology: app.Topology, files: Sequence[FilePath] = ()) -> Box:
    """Return a Box whose coordinate file lists all particles; `files` belong to its force field."""
    positions = source.coordinates.positions
    check_positions(source.path, topology, positions.value_in_unit(unit.nanometer))
    try:
        whole = make_whole(system, positions, topology)
    except ValueError as error:
        raise ForceFieldError(f"{source.path}: {error}") from None
    names = tuple(map(str, (source.topology, *files)))
    return Box(topology, whole * unit.nanometer, system, names, source.kind, np.arange(system.getNumParticles()))


# --- topologies of other programs ---


_READERS: dict[str, Any] = {PRMTOP: app.AmberPrmtopFile, TOP: app.GromacsTopFile, PSF: app.CharmmPsfFile}


def _box_of_topology(
    source: _Source, files: Sequence[FilePath], constraints: str | None, interactions: Interactions
) -> Box:
    path, coordinates, topology, kind = source
    if file_kind(path) == STATE:
        raise ForceFieldError(
            f"{path} is {STATE} and needs a System of OpenMM as its topology, but {topology} is {kind}: give the "
            "System of that State"
        )
    if kind == PSF and not files:
        such = "par_all36_prot.prm top_all36_prot.rtf toppar_water_ions.str"
        raise ForceFieldError(
            f"{topology} is {kind}, which needs its parameters: give all its parameter files as `files` "
            f"(--forcefield), such as {such}"
        )
    parameters = [forcefields.locate(str(file), Path(path).parent) for file in files]
    with refusing(f"cannot read {topology} as {kind}"):
        file = _READERS[kind](str(topology), periodicBoxVectors=coordinates.box)
        create = file.createSystem
        if kind == PSF:
            # OpenMM's other readers do not add constrained bonds by default.
            create = partial(create, app.CharmmParameterSet(*parameters), flexibleConstraints=False)
    if coordinates.box is None and file.topology.getPeriodicBoxVectors() is not None:
        raise ForceFieldError(
            f"{path} has no periodic box, but {topology} was made for one: give coordinates with their box, or its "
            "`edges` (--edges)"
        )
    refuse_other_atoms(path, coordinates, file.topology, topology)
    try:
        system = forcefields.build_system(create, coordinates.box, constraints, interactions)
    except ForceFieldError as error:
        # OpenMM's reader calculates with bond lengths that it did not find.
        is_incomplete = kind == PRMTOP and isinstance(error.__cause__, TypeError)
        hint = ". Does a water with extra points lack the bond between its hydrogens?" if is_incomplete else ""
        raise ForceFieldError(f"{topology}: {error}{hint}") from error
    return _box(source, system, file.topology, files)


# --- a System ---


def _box_of_system(source: _Source, interactions: Interactions) -> Box:
    path, coordinates, topology, kind = source
    with refusing(f"cannot read {topology} as {kind}"):
        system = read_system(io.BytesIO(topology.content))
        checks.refuse_impossible_masses(system)
        checks.refuse_sites_without_place(system)
    for force in system.getForces():
        if forces.kind_of(force).sets:
            raise ForceFieldError(
                f"{topology} has a {force.getName()}, but the run sets the ensemble: remove this Force from the System"
            )
    named = coordinates.topology or _topology_of(system)
    refuse_other_atoms(path, coordinates._replace(names=()), named, topology)
    _refuse_other_masses(path, system, named, topology)
    if not system.usesPeriodicBoundaryConditions():
        named.setPeriodicBoxVectors(None)
    else:
        if coordinates.box is not None:
            system.setDefaultPeriodicBoxVectors(*coordinates.box)
        vectors = [vector.value_in_unit(unit.nanometer) for vector in system.getDefaultPeriodicBoxVectors()]
        named.setPeriodicBoxVectors(vectors * unit.nanometer)
    forcefields.finish_system(system, interactions)
    return _box(source, system, named)


def _refuse_other_masses(path: SourceFile, system: openmm.System, named: app.Topology, topology: SourceFile) -> None:
    """Refuse names that contradict the masses of a System's hydrogens.

    All other atoms are heavier than light hydrogen, even after mass repartitioning.
    """
    masses = tables.masses(system)
    for atom in named.atoms():
        mass = masses[atom.index]
        if atom.element is None or mass == 0:
            continue
        is_hydrogen = atom.element.atomic_number == 1
        if mass > tables.HEAVIEST_HYDROGEN if is_hydrogen else mass < LIGHTEST_OTHER:
            raise ForceFieldError(
                f"{path} has {named_atom(atom)} where {topology} has a particle of {mass:.4g} dalton: are the atoms "
                "in another order?"
            )


def _topology_of(system: openmm.System) -> app.Topology:
    """Return a Topology for a System without one: molecules are residues, and elements follow from masses.

    Water is HOH; residues of other kinds are M1, M2 and so on. Massless particles have no element.
    """
    topology, kinds = app.Topology(), {"OHH": "HOH"}
    chain, masses = topology.addChain(), tables.masses(system).copy()
    for centre, bonded in hydrogens(system).items():
        # Undo mass repartitioning.
        masses[centre] += (masses[bonded] - HYDROGEN).sum()
        masses[bonded] = HYDROGEN
    for molecule in _molecules(system):
        elements = [app.Element.getByMass(masses[i]) if masses[i] > 0 else None for i in molecule]
        symbols = [element.symbol if element else "X" for element in elements]
        kind = "".join(symbol for symbol in symbols if symbol != "X")
        residue = topology.addResidue(kinds.setdefault(kind, f"M{len(kinds)}"), chain)
        for number, (symbol, element) in enumerate(zip(symbols, elements, strict=True), 1):
            topology.addAtom(f"{symbol}{number}", element, residue)
    return topology


def _molecules(system: openmm.System) -> list[list[int]]:
    """Return the particles of each molecule, in order; molecules with separated particles are divided."""
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatform("Reference"))
    molecule_of = {i: number for number, molecule in enumerate(context.getMolecules()) for i in molecule}
    return [list(run) for _, run in groupby(range(system.getNumParticles()), molecule_of.__getitem__)]


# --- sources ---


def sources_of(
    path: FilePath,
    topology: FilePath | None = None,
    files: Sequence[FilePath] | None = None,
) -> dict[str, SourceFile]:
    """Return the files that `read_input` reads, by purpose, except files of OpenMM and those that a top file includes.

    Args:
        path, topology, files: see `read_input`.

    Raises:
        OSError: a file that names others cannot be read.
    """
    box, named = SourceFile(path), files or ()
    sources = {"box": box}
    if topology is not None:
        sources["topology"] = SourceFile(topology)
    elif not named:
        # A file that names no force field is refused when it is read.
        with suppress(ForceFieldError):
            named, _ = forcefields.pick(box)
    located = {str(name): Path(forcefields.locate(str(name), Path(path).parent)) for name in named}
    return sources | {name: SourceFile(place) for name, place in located.items() if place.is_file()}
