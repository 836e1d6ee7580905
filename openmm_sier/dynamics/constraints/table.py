"""Constraints in the form used by kernels."""

from typing import NamedTuple

from numpy import ndarray


class ConstraintTable(NamedTuple):
    """Constraints of atoms that are numbered from 0.

    Attributes:
        members: column of the state for each atom, (atoms,).
        first: the same for the first atom of its component, (atoms,).
        ends: the two atoms of each constraint, (2, c).
        squares: squared lengths, (c,), nm^2.
        inverse_masses: (atoms,), 1/dalton.
        rows, columns: pairs of constraints that share an atom, each also with itself, (k,).
        weights: for each pair the sum of +-1/m of the shared atoms, + where both begin or both end there, (k,).
        largest: number of constraints in the largest component.
    """

    members: ndarray
    first: ndarray
    ends: ndarray
    squares: ndarray
    inverse_masses: ndarray
    rows: ndarray
    columns: ndarray
    weights: ndarray
    largest: int
