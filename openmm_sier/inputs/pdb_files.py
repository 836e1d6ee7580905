"""Read PDB and PDBx/mmCIF files, and refuse errors that would make a simulation meaningless."""

import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
from openmm import Vec3, app, unit
from openmm.unit import Quantity

from openmm_sier.dynamics.constants import GRAM_PER_CM3
from openmm_sier.inputs.file_kinds import MMCIF, PDB, file_kind
from openmm_sier.inputs.source_files import FilePath, SourceFile
from openmm_sier.system.arguments import checked_positions
from openmm_sier.system.boxes import reduced
from openmm_sier.system.user_warnings import warn

#: Start of OpenMM's warning of a duplicate atom, of which it keeps one.
TWICE = "WARNING: duplicate atom "

#: Maximum density, g/cm3, above that of any matter on earth. Files without a box often have one of 1 A.
DENSEST = 30.0

#: Maximum edge of a box, nm.
LONGEST = 1e4

READERS = {PDB: app.PDBFile, MMCIF: app.PDBxFile}


class ForceFieldError(ValueError):
    """Error in a force field, in coordinates, or in their combination."""


def read_pdb(path: FilePath, edges: Sequence[float] | None = None) -> app.PDBFile | app.PDBxFile:
    """Read a PDB or PDBx/mmCIF file.

    Args:
        path: path of the file.
        edges: edges of the periodic box, see `box_of`.

    Raises:
        ForceFieldError: the file has another format, has duplicate atoms, two atoms in one place, or a box
            too small for its atoms.
        OSError: the file cannot be read.
    """
    source = SourceFile.of(path)
    if (kind := file_kind(source)) not in READERS:
        raise ForceFieldError(f"{path} is not a PDB file with atoms: give coordinates in PDB or PDBx/mmCIF format")
    with refusing(f"cannot read {path} as {kind}"), warnings.catch_warnings():
        warnings.filterwarnings("error", TWICE)
        try:
            file = READERS[kind](source.stream)
        except UserWarning as twice:
            raise ForceFieldError(f"{path} has an atom twice: {first_line(twice).removeprefix(TWICE)}") from None
    warn_about_alternates(source, file.topology)
    file.topology.setPeriodicBoxVectors(box_of(path, file.topology.getPeriodicBoxVectors(), edges))
    check_positions(path, file.topology, checked_positions(file.positions, file.topology.getNumAtoms()))
    return file


def warn_about_alternates(path: FilePath, topology: app.Topology) -> None:
    """Warn if a PDB or PDBx/mmCIF file has alternate locations; `topology` is that of its first model."""
    records = sum(line.startswith(("ATOM", "HETATM")) for line in SourceFile.of(path).lines)
    # All models have the same number of atoms.
    if records % max(topology.getNumAtoms(), 1):
        warn(
            f"{path} has atoms in alternate locations, of which the first is taken. If another one is more frequent, "
            "keep its atoms alone (by the letter in column 17 of a PDB file, label_alt_id of a PDBx/mmCIF file)"
        )


def box_of(path: FilePath, box: Quantity | None, edges: Sequence[float] | None) -> Quantity | None:
    """Return the periodic box of a file or, if it has none, a rectangular one with the given edges in nm.

    Raises:
        ForceFieldError: both are given, or the box of the file has an edge above `LONGEST`.
    """
    if box is not None:
        if edges is not None:
            raise ForceFieldError(f"{path} has a periodic box of its own: leave out `edges` (--edges)")
        longest = float(np.abs(box.value_in_unit(unit.nanometer)).max())
        if not longest <= LONGEST:
            raise ForceFieldError(f"{path}: the box has an edge of {longest:.3g} nm, expected {LONGEST:g} or less")
        return box
    if edges is None:
        return None
    return [Vec3(*row) for row in np.diag(edges).tolist()] * unit.nanometer


def box_vectors(topology: app.Topology) -> np.ndarray | None:
    """Return vectors of the periodic box in rows, (3, 3), nm; None without one."""
    vectors = topology.getPeriodicBoxVectors()
    return None if vectors is None else np.array(vectors.value_in_unit(unit.nanometer))


def extent(vectors: np.ndarray) -> str:
    """Return text with the edges of a box, and its angles unless it is rectangular.

    Args:
        vectors: box vectors as rows, (3, 3), nm.
    """
    vectors = reduced(vectors)
    lengths = np.linalg.norm(vectors, axis=1)
    edges = f"{' x '.join(f'{edge:.4f}' for edge in lengths)} nm"
    a, b, c = vectors / lengths[:, None]
    angles = [f"{np.degrees(np.arccos(one @ two)):.2f}" for one, two in ((b, c), (a, c), (a, b))]
    if set(angles) == {"90.00"}:
        return edges
    return f"{edges} with angles of {angles[0]}, {angles[1]} and {angles[2]} degrees"


def first_line(error: BaseException) -> str:
    """Return the message of an error on one line."""
    message = " ".join(str(error).split())
    # The message of a KeyError is only the key.
    return f"{type(error).__name__} {message}".rstrip() if isinstance(error, LookupError) or not message else message


@contextmanager
def refusing(action: str = "") -> Iterator[None]:
    """Context manager that converts errors of OpenMM's readers to `ForceFieldError`, except `OSError`.

    Args:
        action: the failed action, in front of the message, such as "cannot read FILE".
    """
    try:
        yield
    except (ForceFieldError, OSError):
        raise
    except Exception as error:
        raise ForceFieldError(f"{action}: {first_line(error)}" if action else first_line(error)) from error


def check_positions(path: FilePath, topology: app.Topology, positions: np.ndarray) -> None:
    """Refuse positions that would make a simulation meaningless; virtual sites may be anywhere.

    Args:
        path: path of the file, for messages.
        topology: topology with the box, and with the elements of all atoms except virtual sites.
        positions: (N, 3), nm.

    Raises:
        ForceFieldError: positions are not finite, two atoms are in one place, or the box is too small for the atoms.
    """
    atoms = [atom for atom in topology.atoms() if atom.element is not None]
    places = positions[[atom.index for atom in atoms]]
    if not np.isfinite(places).all():
        raise ForceFieldError(f"{path} has coordinates that are not numbers")
    order = np.lexsort(places.T)
    same = np.flatnonzero((np.diff(places[order], axis=0) == 0).all(axis=1))
    if len(same):
        one, two = (named_atom(atoms[order[same[0] + k]]) for k in (0, 1))
        raise ForceFieldError(f"{path}: {one} and {two} are in the same place: is a molecule listed twice?")
    if (vectors := box_vectors(topology)) is None:
        return
    volume = abs(float(np.linalg.det(vectors)))
    elements = Counter(atom.element for atom in atoms)
    mass = sum(count * element.mass.value_in_unit(unit.dalton) for element, count in elements.items())
    if not mass < DENSEST * GRAM_PER_CM3 * volume:
        raise ForceFieldError(
            f"{path}: the box has a volume of {volume:.3g} nm3, too small for atoms of {mass:.4g} dalton. If "
            "the system has no box, remove it from the file (in a PDB file the record CRYST1)"
        )


def named_atom(atom: app.topology.Atom) -> str:
    """Return the name of an atom for messages."""
    return f"atom {atom.id} ({atom.name} of {atom.residue.name} {atom.residue.id})"
