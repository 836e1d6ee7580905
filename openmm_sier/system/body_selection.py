"""Select rigid bodies by ranges of residues, MDTraj selections or lists of atoms."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from openmm import app

from openmm_sier.dynamics.index_ranges import as_ranges

#: Description of one or several bodies.
Description = str | Sequence[int] | Sequence[Any] | Mapping[str, Any]

#: Forms of a textual description, for messages.
FORMS = (
    "residues, such as A:1-36 or A:1-36,50-60, or :1-36 in each chain; a chain, such as A: ; the name of a residue; or "
    "an MDTraj selection, such as 'name CA and resSeq 1 to 36' or 'index 0 to 35'"
)

#: A residue by number and insertion code, the first and last of a range, and ranges of a chain.
_NUMBER = r"-?\d+[A-Za-z]?"
_SPAN = re.compile(rf"({_NUMBER})(?:-({_NUMBER}))?")
_RANGES = re.compile(rf"([^:\s]*):((?:{_NUMBER}(?:-{_NUMBER})?)(?:,{_NUMBER}(?:-{_NUMBER})?)*)?")


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

    def __getitem__(self, index: Any) -> Any:
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
      `:1-36` is one body in each chain that has these residues, and `A:` is a whole chain.
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
        ValueError: a string has none of these forms, or names a chain or residue that the topology does not have; a
            selection is empty; or MDTraj is not installed. The message quotes the string.
        TypeError: the topology or a description has the wrong type.
    """
    if not isinstance(topology, app.Topology):
        raise TypeError(f"topology must be an openmm.app.Topology, got a {type(topology).__name__}")
    atoms: list[tuple[int, ...]] = []
    names: list[str] = []
    for name, selection in _entries(description):
        is_text = isinstance(selection, str)
        groups = _in_words(topology, selection.strip()) if is_text else [selection]
        for number, group in enumerate(groups, 1):
            atoms.append(tuple(sorted(map(int, group))))
            body_name = name or (selection if is_text else f"atoms {as_ranges(group)}")
            names.append(body_name if len(groups) == 1 else f"{body_name} {number}")
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


def _in_words(topology: app.Topology, words: str) -> list[list[int]]:
    """Return the atoms of each body that a string describes."""
    residues = [residue for residue in topology.residues() if residue.name == words]
    if residues:
        return [[atom.index for atom in residue.atoms()] for residue in residues]
    if match := _RANGES.fullmatch(words):
        return _in_ranges(topology, match[1], _SPAN.findall(match[2] or ""))
    return _selected(topology, words)


def _in_ranges(topology: app.Topology, name: str, spans: Sequence[tuple[str, str]]) -> list[list[int]]:
    """Return the atoms of ranges of residues in each chain of a name that has them all, or in any chain without a name.

    Args:
        topology: openmm.app.Topology.
        name: of the chain; may be empty.
        spans: first and last residue of each range; the last is empty for a single residue. Without any all residues.
    """
    bodies, extents = [], []
    for chain in topology.chains():
        residues = list(chain.residues())
        numbers = [f"{residue.id.strip()}{residue.insertionCode.strip()}" for residue in residues]
        extents.append(f"{chain.id.strip()}:{numbers[0]}-{numbers[-1]}")
        ends = [(first, last or first) for first, last in spans]
        if name not in ("", chain.id.strip()) or any(numbers.count(number) != 1 for pair in ends for number in pair):
            continue
        ranges = [residues[numbers.index(first) : numbers.index(last) + 1] for first, last in ends] or [residues]
        bodies.append([atom.index for within in ranges for residue in within for atom in residue.atoms()])
    if not bodies or not all(bodies):
        raise ValueError(
            f"no chain {name} has residues {', '.join(map('-'.join, spans))}, each once; there are {', '.join(extents)}"
        )
    return bodies


def _selected(topology: app.Topology, words: str) -> list[list[int]]:
    """Return the atoms of an MDTraj selection, chain by chain."""
    try:
        import mdtraj
    except ImportError:
        raise ValueError(
            f"{words!r} is an MDTraj selection, but MDTraj is not installed: pip install mdtraj; or give {FORMS}"
        ) from None
    try:
        atoms = set(mdtraj.Topology.from_openmm(topology).select(words).tolist())
    # Its parser raises errors of many classes.
    except Exception:
        raise ValueError(f"{words!r} describes no body: give {FORMS}") from None
    if not atoms:
        raise ValueError(f"{words!r} selects no atoms of the topology")
    in_chains = ([atom.index for atom in chain.atoms() if atom.index in atoms] for chain in topology.chains())
    return [group for group in in_chains if group]
