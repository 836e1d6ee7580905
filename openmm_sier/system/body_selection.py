"""Bodies by what people have: ranges of residues, chains, MDTraj selections, and files of these."""

from __future__ import annotations

import json
import operator
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, overload

from openmm import app

from openmm_sier.dynamics.names import as_ranges
from openmm_sier.system.residue_ranges import ResidueRanges

#: A description of bodies, or of several.
Description = str | os.PathLike[str] | Sequence[int] | Sequence[Any] | Mapping[str, Any]

#: The forms that a description in words may have.
FORMS = (
    "residues, such as A:1-36 or A:1-36,50-60, or :1-36 in each chain; a chain, such as chain A; atoms, such as atoms "
    "0-35; the name of a residue; or an MDTraj selection, such as 'name CA and resSeq 1 to 36'"
)

#: Endings of files that hold JSON.
JSON = ".json"

_CHAIN = re.compile(r"chain\s+(\S+)")
_ATOMS = re.compile(r"atoms?\s+(\d.*)")
_FILE = re.compile(r"\S+\.\w+")
_STOPPED = re.compile(r"\(at char (\d+)\)")


@dataclass(frozen=True)
class SelectedBodies(Sequence[tuple[int, ...]]):
    """Hold bodies as sequences of particle indices, with a name for each; print it to see them.

    It is taken wherever lists of particle indices are: as `bodies` of integrators and of `prepare_system`, and as
    `rigid` of `RigidBodies.from_system`.

    Attributes:
        atoms: particle indices of each body.
        names: of the bodies.
        descriptions: where each of them is, such as "A:1-36", from which `select_bodies` makes it again.
    """

    atoms: tuple[tuple[int, ...], ...]
    names: tuple[str, ...]
    descriptions: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.atoms)

    @overload
    def __getitem__(self, index: int) -> tuple[int, ...]: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[tuple[int, ...], ...]: ...

    def __getitem__(self, index: int | slice) -> Any:
        return self.atoms[index]

    def __str__(self) -> str:
        return "\n".join(map(self._line, range(len(self))))

    def _line(self, number: int) -> str:
        where = self.descriptions[number]
        if not where.startswith("atoms "):
            where += f" (atoms {as_ranges(self.atoms[number])})"
        name = self.names[number]
        return where if name == self.descriptions[number] else f"{name}: {where}"


def select_bodies(topology: app.Topology, description: Description) -> SelectedBodies:
    """Find the atoms of bodies that you describe by residues, by chains or by a selection.

    >>> domains = select_bodies(topology, {"first": "A:1-2", "second": "A:4,6"})
    >>> print(domains)
    first: A:1-2 (atoms 0-5)
    second: A:4,6 (atoms 9-11,15-17)
    >>> bodies = RigidBodies.from_system(system, topology, domains, positions)

    A description in words is one of these:

    - `A:1-36` or `A:1-36,50-60`: residues of the chain A as one body, by the topology's numbers, both ends included.
      `:1-36` is one body in each chain that has these residues, and `A:1-36 B:4-9` is one body of both.
    - `chain A`: a whole chain.
    - `atoms 0-35,40`: atoms by their index, from 0, as OpenMM counts them.
    - the name of a residue: each residue of that name is one body.
    - anything else is a selection in the language of MDTraj, which must be installed, such as
      `name CA and resSeq 1 to 36`. The atoms that it selects in one chain are one body.

    Where chains share a name there is one body in each of them. A name may come before, as in `head = A:1-36`.

    Args:
        topology: the topology.
        description: words; the indices of one body's particles; a list of several of these; a mapping of names to
            these; or the name of a file. A file has words in each line, and comments after #. A file that ends in .json
            has a list, or an object with names.

    Returns:
        The bodies, in the order of their descriptions.

    Raises:
        ValueError: words are none of these, or name a chain, a residue or an atom that the topology does not have; a
            selection is empty; an atom is in two bodies; or MDTraj is not installed. The message has the words.
        TypeError: the topology is something else, or a description is.
        OSError: the file cannot be read.
    """
    if not isinstance(topology, app.Topology):
        raise TypeError(f"topology must be an openmm.app.Topology, got a {type(topology).__name__}")
    reader = _Reader(topology)
    found = [body for name, what in _entries(description) for body in reader.named(name, what)]
    if not found:
        raise ValueError(f"no body is described: give {FORMS}")
    _refuse_shared(found)
    return SelectedBodies(
        tuple(body.atoms for body in found), tuple(body.name for body in found), tuple(body.where for body in found)
    )


class _Body(NamedTuple):
    atoms: tuple[int, ...]
    name: str
    where: str


# --- what is described ------------------------------------------------------------------------------------------------


def _entries(description: Any) -> Iterator[tuple[str | None, Any]]:
    """Give the descriptions that one consists of, each with its name if it has one."""
    if isinstance(description, os.PathLike) or (isinstance(description, str) and _is_file(description)):
        yield from _in_file(Path(description))
    elif isinstance(description, Mapping):
        yield from description.items()
    elif isinstance(description, str):
        yield named_words(description)
    elif _is_indices(description):
        yield None, description
    elif isinstance(description, Iterable):
        for each in description:
            yield named_words(each) if isinstance(each, str) else (None, each)
    else:
        raise TypeError(f"bodies must be described by {FORMS}; or by lists of particle indices, got {description!r}")


def file_words(words: str) -> list[str]:
    """Return the words of a file, a body each, where words are its name; otherwise the words themselves.

    Raises:
        ValueError: the file describes no body, or not in words that can be written down.
        OSError: it cannot be read.
    """
    if not _is_file(words):
        return [words]
    lines = []
    for name, what in _in_file(Path(words)):
        text = what if isinstance(what, str) else f"atoms {as_ranges(what)}"
        lines.append(text if name is None else f"{name} = {text}")
    return lines


def _is_file(text: str) -> bool:
    """Tell whether words are the name of a file. A name without an ending may be a selection."""
    return bool(Path(text).suffix) and os.path.isfile(text)


def _is_indices(description: Any) -> bool:
    """Tell whether a description is the particle indices of one body."""
    if isinstance(description, str | Mapping) or not isinstance(description, Iterable):
        return False
    return any(not isinstance(each, str) and hasattr(each, "__index__") for each in description)


def _in_file(path: Path) -> Iterator[tuple[str | None, Any]]:
    text = path.read_text(encoding="utf-8-sig")
    if path.suffix.lower() == JSON:
        try:
            found = json.loads(text)
        except json.JSONDecodeError as error:
            raise ValueError(f"{path}: {error}") from None
        if not isinstance(found, list | dict):
            raise ValueError(
                f"{path} must have a JSON list of bodies, or a JSON object of bodies by name, got {found!r}"
            )
        yield from _entries(found)
        return
    empty = True
    for line in text.splitlines():
        words = line.partition("#")[0].strip()
        if not words:
            continue
        empty = False
        yield named_words(words)
    if empty:
        raise ValueError(f"{path} describes no body: each line has {FORMS}")


def named_words(words: str) -> tuple[str | None, str]:
    """Return the name that a line has before "=", or None, and what it describes.

    A selection may have comparisons, such as "mass >= 2", "name == CA" or "name =~ 'C.*'".
    """
    name, separator, what = words.partition("=")
    if not separator or what.startswith(("=", "~")) or name.rstrip().endswith(("<", ">", "!")):
        return None, words
    return name.strip(), what.strip()


def _refuse_shared(found: Sequence[_Body]) -> None:
    owner: dict[int, _Body] = {}
    for body in found:
        for atom in body.atoms:
            if atom in owner:
                raise ValueError(f"atom {atom} is in two bodies: {owner[atom].name} and {body.name}")
            owner[atom] = body


# --- which atoms ------------------------------------------------------------------------------------------------------


class _Reader:
    """Find the atoms that words describe."""

    def __init__(self, topology: app.Topology):
        self._topology = topology
        self._ranges = ResidueRanges(topology)
        self._names = {residue.name for residue in topology.residues()}
        self._count = topology.getNumAtoms()
        self._mdtraj: Any = None

    def named(self, name: str | None, what: Any) -> list[_Body]:
        """Return the bodies of a description, with a name if it has one; several of one name are numbered."""
        if isinstance(what, str):
            # RigidBodies.from_system has residues in this form.
            is_residue = what.strip() == "rigid" and name in self._names
            groups = self._of_residues(name or "") if is_residue else self._in_words(what.strip())
        else:
            groups = [self._of_indices(name, what)]
        bodies = []
        for number, group in enumerate(groups, 1):
            atoms = tuple(sorted(set(group)))
            where = self._ranges.describe(atoms)
            numbered = name if len(groups) == 1 else f"{name} {number}"
            bodies.append(_Body(atoms, where if name is None else str(numbered), where))
        return bodies

    def _of_indices(self, name: str | None, what: Any) -> list[int]:
        of = "" if name is None else f" of {name}"
        try:
            atoms = [operator.index(i) for i in what]
        except TypeError:
            raise TypeError(
                f"the particles{of} must be whole numbers, or words such as {FORMS}; got {what!r}"
            ) from None
        if any(isinstance(i, bool) for i in what):
            raise TypeError(f"the particles{of} must be particle indices, got a mask of True and False")
        if not atoms:
            raise ValueError(f"the list of particles{of} is empty")
        if len(set(atoms)) < len(atoms):
            twice = next(i for i in atoms if atoms.count(i) > 1)
            raise ValueError(f"the particles{of} must be different ones, got {twice} twice")
        return self._checked(atoms, of)

    def _checked(self, atoms: list[int], of: str) -> list[int]:
        if outside := [i for i in atoms if not 0 <= i < self._count]:
            raise ValueError(f"the particles{of} must be from 0 to {self._count - 1}, got {outside[0]}")
        return atoms

    def _in_words(self, words: str) -> list[list[int]]:
        """Return the atoms of each body that words describe."""
        if words in self._names:
            return self._of_residues(words)
        if found := _ATOMS.fullmatch(words):
            return [self._of_ranges(words, found[1])]
        if found := _CHAIN.fullmatch(words):
            return self._ranges.atoms(f"{found[1]}:")
        if self._ranges.are_ranges(words):
            return self._ranges.atoms(words)
        return self._selected(words)

    def _of_residues(self, name: str) -> list[list[int]]:
        return [[atom.index for atom in each.atoms()] for each in self._topology.residues() if each.name == name]

    def _of_ranges(self, words: str, text: str) -> list[int]:
        atoms: list[int] = []
        for part in re.split(r"[,\s]+", text.strip()):
            ends = re.fullmatch(r"(\d+)(?:-(\d+))?", part)
            if ends is None or int(ends[2] or ends[1]) < int(ends[1]):
                raise ValueError(f"{words!r}: expected atoms as in 'atoms 0-35,40', got {part!r}")
            last = int(ends[2] or ends[1])
            self._checked([last], f" of {words!r}")
            atoms += range(int(ends[1]), last + 1)
        return atoms

    def _selected(self, words: str) -> list[list[int]]:
        """Return what a selection of MDTraj has in each chain."""
        try:
            import mdtraj
        except ImportError:
            raise ValueError(
                f"{words!r} is a selection of MDTraj, which is not installed: pip install mdtraj; or give {FORMS}"
            ) from None
        if self._mdtraj is None:
            self._mdtraj = mdtraj.Topology.from_openmm(self._topology)
        try:
            selected = set(self._mdtraj.select(words).tolist())
        # Its parser raises errors of many classes.
        except Exception as error:
            no_file = f"there is no file {words}, and " if _FILE.fullmatch(words) else ""
            stopped = _STOPPED.search(str(error))
            where = f" (MDTraj understands it up to {words[: int(stopped[1])]!r})" if stopped else ""
            raise ValueError(f"{no_file}{words!r} describes no body{where}: give {FORMS}") from None
        if not selected:
            raise ValueError(f"{words!r} selects no atom of the topology")
        return self._ranges.by_chain(selected)
