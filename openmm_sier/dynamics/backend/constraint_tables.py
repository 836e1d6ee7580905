"""Connected components of constraints in the tables that backends take: stars of equal size, and all other graphs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np


class Stars(NamedTuple):
    """All stars of k leaves: m centres, each constrained to its own leaves.

    Attributes:
        centres: columns of the state, (m,).
        leaves: (k, m).
        light: inverse masses of the leaves, (k, m), 1/dalton.
        heavy: inverse masses of the centres, (m,).
        squares: squared lengths, (k, m), nm^2.
    """

    centres: np.ndarray
    leaves: np.ndarray
    light: np.ndarray
    heavy: np.ndarray
    squares: np.ndarray

    def component(self, number: int) -> np.ndarray:
        """Columns of the state of one star."""
        return np.array([self.centres[number], *self.leaves[:, number]])


class Pattern(NamedTuple):
    """Where the matrix of a sparse elimination has elements; see `graph_loops`."""

    rows: np.ndarray
    columns: np.ndarray
    diagonal: np.ndarray
    weights: np.ndarray


@dataclass(frozen=True, eq=False)
class Graphs:
    """All components that are not stars.

    Attributes:
        atoms: columns of the state, (a,), component by component.
        starts: first atom, end, first constraint and end of each component, (c, 4).
        ends: for each constraint the numbers of its atoms in `atoms`, (e, 2).
        squares: squared lengths, (e,), nm^2.
        inverse_masses: (a,), 1/dalton.
        pattern: of the elimination; the constraints are in its order.
    """

    atoms: np.ndarray
    starts: np.ndarray
    ends: np.ndarray
    squares: np.ndarray
    inverse_masses: np.ndarray
    pattern: Pattern

    @cached_property
    def compiled_arguments(self) -> tuple:
        """What every loop of `graph_loops` takes after the vectors: atoms, starts and graph."""
        return self.atoms, self.starts, (self.ends, self.squares, self.inverse_masses, tuple(self.pattern))

    @cached_property
    def columns_of_ends(self) -> np.ndarray:
        """`ends` transposed, (2, e), contiguous."""
        return np.ascontiguousarray(self.ends.T)

    @cached_property
    def first_atoms(self) -> np.ndarray:
        """For each atom the column of the first one of its component, (a,)."""
        low, high = self.starts[:, 0], self.starts[:, 1]
        return np.repeat(self.atoms[low], high - low)

    def component(self, number: int) -> np.ndarray:
        """Columns of the state of one component."""
        return self.atoms[self.starts[number, 0] : self.starts[number, 1]]
