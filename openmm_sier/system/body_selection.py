"""Select rigid bodies by ranges of residues, MDTraj selections or lists of atoms."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, overload

from openmm import app

from openmm_sier.dynamics.index_ranges import as_ranges
from openmm_sier.system.residue_ranges import ResidueRanges

#: Description of one or several bodies.
Description = str | Sequence[int] | Sequence[Any] | Mapping[str, Any]

#: Forms of a textual description, for messages.
FORMS = (
    "residues, such as A:1-36 or A:1-36,50-60, or :1-36 in each chain; a chain, such as A: ; the name of a residue; or "
    "an MDTraj selection, such as 'name CA and resSeq 1 to 36' or 'index 0 to 35'"
)


@dataclass(frozen=True)
class SelectedBodies(Sequence[tuple[int, ...]]):
    """Named bodies, as sequences of particle indices. Print the object for a summary.

    It can be passed wherever lists of particle indices can: as `bodies` of integrators and of `prepare_system`, and as
    `rigid` of `RigidBodies.from_system`.

    Attributes:
        atoms: particle indices of each body.
        names: of the bodies.
    """

    atoms: tuple[tuple[int, ...], ...]
    names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.atoms)

    @overload
    def __getitem__(self, index: int) -> tuple[int, ...]: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[tuple[int, ...], ...]: ...

    def __getitem__(self, index: int | slice) -> Any:
        return self.atoms[index]

    def __str__(self) -> str:
        lines = []
        for name, atoms in zip(self.names, self.atoms, strict=True):
            words = f"atoms {as_ranges(atoms)}"
            lines.append(name if name == words else f"{name} ({words})")
        return "\n".join(lines)


def select_bodies(topology: app.Topology, description: Description) -> SelectedBodies:
    """Select bodies by residues, chains or an atom selection.

    >>> domains = select_bodies(topology, {"first": "A:1-2", "second": "A:4,6"})
    >>> print(domains)
    first (atoms 0-5)
    second (atoms 9-11,15-17)
    >>> bodies = RigidBodies.from_system(system, topology, domains, positions)

    A description is one of these strings:

    - `A:1-36` or `A:1-36,50-60`: residues of the chain A as one body, by the topology's numbers, both ends included.
      `:1-36` is one body in each chain that has these residues, `A:` is a whole chain, and `A:1-36 B:4-9` is one body
      of both.
    - the name of a residue: each residue of that name is one body.
    - anything else is an MDTraj selection, such as `name CA and resSeq 1 to 36`; MDTraj must be installed. The selected
      atoms of each chain are one body.

    If several chains have the same name, each gets a body.

    Args:
        topology: the topology.
        description: a string, the particle indices of one body, a list of these, or a mapping from names to these.

    Returns:
        The bodies, in the order of their descriptions. Bodies with the same name are numbered.

    Raises:
        ValueError: a string has none of these forms, or names a chain, residue or atom that the topology does not have;
            a selection is empty; an atom is in two bodies; or MDTraj is not installed. The message quotes the string.
        TypeError: the topology or a description has the wrong type.
    """
    if not isinstance(topology, app.Topology):
        raise TypeError(f"topology must be an openmm.app.Topology, got a {type(topology).__name__}")
    reader = _Reader(topology)
    atoms: list[tuple[int, ...]] = []
    names: list[str] = []
    for name, selection in _entries(description):
        is_text = isinstance(selection, str)
        groups = reader.in_words(selection.strip()) if is_text else [reader.of_indices(name, selection)]
        for number, group in enumerate(groups, 1):
            atoms.append(tuple(sorted(set(group))))
            body_name = name or (selection if is_text else f"atoms {as_ranges(group)}")
            names.append(body_name if len(groups) == 1 else f"{body_name} {number}")
    if not atoms:
        raise ValueError(f"the description contains no body: give {FORMS}")
    _refuse_shared(atoms, names)
    return SelectedBodies(tuple(atoms), tuple(names))


def _entries(description: Any) -> list[tuple[str | None, Any]]:
    """Split a description into descriptions of single bodies, each with its name or None."""
    if isinstance(description, Mapping):
        return list(description.items())
    if isinstance(description, str):
        return [(None, description)]
    if not isinstance(description, Iterable):
        raise TypeError(f"bodies must be described by {FORMS}; or by lists of particle indices, got {description!r}")
    entries = list(description)
    if any(not isinstance(item, str) and hasattr(item, "__index__") for item in entries):
        return [(None, entries)]
    return [(None, item) for item in entries]


def _refuse_shared(bodies: Sequence[tuple[int, ...]], names: Sequence[str]) -> None:
    owner: dict[int, str] = {}
    for atoms, name in zip(bodies, names, strict=True):
        for atom in atoms:
            if atom in owner:
                raise ValueError(f"atom {atom} is in two bodies: {owner[atom]} and {name}")
            owner[atom] = name


class _Reader:
    """Reader of descriptions for one topology."""

    def __init__(self, topology: app.Topology):
        self._topology = topology
        self._ranges = ResidueRanges(topology)
        self._mdtraj: Any = None

    def of_indices(self, name: str | None, indices: Any) -> list[int]:
        """Return the atoms of a list of indices."""
        of = "" if name is None else f" of {name}"
        try:
            atoms = [operator.index(i) for i in indices]
        except TypeError:
            raise TypeError(
                f"the particles{of} must be whole numbers, or words such as {FORMS}; got {indices!r}"
            ) from None
        if any(isinstance(i, bool) for i in indices):
            raise TypeError(f"the particles{of} must be particle indices, got a mask of True and False")
        if not atoms:
            raise ValueError(f"the list of particles{of} is empty")
        if len(set(atoms)) < len(atoms):
            twice = next(i for i in atoms if atoms.count(i) > 1)
            raise ValueError(f"the particles{of} must be different ones, got {twice} twice")
        last = self._topology.getNumAtoms() - 1
        if outside := [i for i in atoms if not 0 <= i <= last]:
            raise ValueError(f"the particles{of} must be from 0 to {last}, got {outside[0]}")
        return atoms

    def in_words(self, words: str) -> list[list[int]]:
        """Return the atoms of each body that a string describes."""
        residues = [residue for residue in self._topology.residues() if residue.name == words]
        if residues:
            return [[atom.index for atom in residue.atoms()] for residue in residues]
        if self._ranges.are_ranges(words):
            return self._ranges.atoms(words)
        return self._selected(words)

    def _selected(self, words: str) -> list[list[int]]:
        """Return the atoms of an MDTraj selection, chain by chain."""
        try:
            import mdtraj
        except ImportError:
            raise ValueError(
                f"{words!r} is an MDTraj selection, but MDTraj is not installed: pip install mdtraj; or give {FORMS}"
            ) from None
        if self._mdtraj is None:
            self._mdtraj = mdtraj.Topology.from_openmm(self._topology)
        try:
            selected = set(self._mdtraj.select(words).tolist())
        # Its parser raises errors of many classes.
        except Exception:
            raise ValueError(f"{words!r} describes no body: give {FORMS}") from None
        if not selected:
            raise ValueError(f"{words!r} selects no atoms of the topology")
        return self._ranges.by_chain(selected)
