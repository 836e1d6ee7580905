"""Ranges of residues, such as A:1-36."""

from __future__ import annotations

import re
from collections.abc import Sequence

from openmm import app

_NUMBER = r"-?\d+[A-Za-z]?"
_RANGE = re.compile(rf"({_NUMBER})(?:-({_NUMBER}))?")
_OF_CHAIN = re.compile(rf"([^:\s]*):((?:{_NUMBER}(?:-{_NUMBER})?)(?:,{_NUMBER}(?:-{_NUMBER})?)*)?")


class _Chain:
    """Residues of a chain, by number and insertion code.

    Attributes:
        name: name of the chain; empty if it has none.
        numbers: numbers of its residues, in order.
        atoms: atom indices of each residue.
    """

    def __init__(self, chain: app.topology.Chain):
        residues = list(chain.residues())
        self.name = chain.id.strip()
        self.numbers = [f"{residue.id.strip()}{residue.insertionCode.strip()}" for residue in residues]
        self.atoms = [[atom.index for atom in residue.atoms()] for residue in residues]
        self._places: dict[str, list[int]] = {}
        for place, number in enumerate(self.numbers):
            self._places.setdefault(number, []).append(place)

    def within(self, span: str | None) -> list[int]:
        """Return the atoms in ranges such as 1-36,50; all atoms for None.

        Raises:
            ValueError: no residue of the chain has such a number, or several have.
        """
        if span is None:
            return [atom for atoms in self.atoms for atom in atoms]
        selected: list[int] = []
        for match in _RANGE.finditer(span):
            first, last = self._place(match[1]), self._place(match[2] or match[1])
            if last < first:
                raise ValueError(f"{self} has residue {match[2]} before {match[1]}: give the lower one first")
            selected += [atom for atoms in self.atoms[first : last + 1] for atom in atoms]
        return selected

    def _place(self, number: str) -> int:
        places = self._places.get(number, [])
        if len(places) != 1:
            many = f"{len(places)} residues" if places else "no residue"
            extent = f"{self.numbers[0]} to {self.numbers[-1]}" if self.numbers else "none"
            raise ValueError(
                f"{self} has {many} {number}; it has {extent}. Correct the range, or select atoms, such as "
                "'index 0 to 35'"
            )
        return places[0]

    def __str__(self) -> str:
        return f"the chain {self.name or 'without a name'}"


class ResidueRanges:
    """Ranges of the residues of a topology."""

    def __init__(self, topology: app.Topology):
        self._chains = [_Chain(chain) for chain in topology.chains()]
        self._named: dict[str, list[_Chain]] = {}
        for chain in self._chains:
            self._named.setdefault(chain.name, []).append(chain)

    @staticmethod
    def are_ranges(words: str) -> bool:
        """Return whether words are ranges, such as A:1-36 B:4-9."""
        return bool(words) and all(_OF_CHAIN.fullmatch(word) for word in words.split())

    def atoms(self, words: str) -> list[list[int]]:
        """Return the atoms of each body described by ranges.

        Raises:
            ValueError: a chain or residue does not exist, or a range of a body of several chains fits more than one.
        """
        ranges = [match.groups() for word in words.split() if (match := _OF_CHAIN.fullmatch(word))]
        if len({chain for chain, _ in ranges}) == 1:
            return self._in_each(ranges[0][0], [span for _, span in ranges])
        body: list[int] = []
        for chain, span in ranges:
            in_chains = self._in_each(chain, [span])
            if len(in_chains) > 1:
                chains = f"chains {chain}" if chain else "chains"
                raise ValueError(
                    f"{words!r} must be one body, but there are {len(in_chains)} {chains}: describe the body of "
                    "each chain by itself, or give particle indices"
                )
            body += in_chains[0]
        return [body]

    def by_chain(self, atoms: set[int]) -> list[list[int]]:
        """Return the given atoms grouped by chain."""
        in_chains = ([atom for atom in chain.within(None) if atom in atoms] for chain in self._chains)
        return [ranges for ranges in in_chains if ranges]

    def _in_each(self, name: str, spans: Sequence[str | None]) -> list[list[int]]:
        """Return the atoms of ranges in each chain of a name; an empty name means every chain that has the residues."""
        chains = self._named.get(name, []) if name else self._chains
        if not chains:
            names = ", ".join(each or "(no name)" for each in self._named)
            raise ValueError(f"the topology has no chain {name}; it has {names}")
        in_chains, missing = [], None
        for chain in chains:
            try:
                in_chains.append([atom for span in spans for atom in chain.within(span)])
            except ValueError as error:
                if name:
                    raise
                missing = error
        if not in_chains and missing is not None:
            raise missing
        return in_chains
