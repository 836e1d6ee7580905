"""The graph of constraints: its connected components, and which constraints are independent."""

import numpy as np

from openmm_sier.dynamics import kernels
from openmm_sier.dynamics.constraints.table import ConstraintTable
from openmm_sier.dynamics.index_ranges import distinct, of_ranges

#: A pivot below this is that of a redundant constraint, with a diagonal of ones to which this shift is added.
PIVOT, SHIFT = 1e-9, 1e-12


def joined(n: int, pairs: np.ndarray) -> np.ndarray:
    """Return the smallest index in the connected component of each of n nodes, (n,), for edges (c, 2)."""
    ends = np.asarray(pairs, dtype=np.int64).reshape(-1, 2)
    smallest = np.arange(n)
    while True:
        # Each component of more than one node has one of them, its root, as the smallest index of all its nodes. Those
        # of joined components become that of a neighbour which is smaller: at least half of the roots vanish.
        roots = smallest[ends]
        apart = roots[roots[:, 0] != roots[:, 1]]
        if not len(apart):
            return smallest
        np.minimum.at(smallest, apart.max(axis=1), apart.min(axis=1))
        while True:
            further = smallest[smallest]
            if np.array_equal(further, smallest):
                break
            smallest = further


def couplings(pairs: np.ndarray, inverse_masses: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the constraints that share an atom, and by what weight; see `ConstraintTable`.

    The order of the columns in a row is fixed, since sums over them have other bits in another one: those that share
    the smaller atom come first, and each group is descending.

    Args:
        pairs: atoms of each constraint, (c, 2).
        inverse_masses: of the atoms, 1/dalton.

    Returns:
        `rows`, `columns` and `weights` of a `ConstraintTable`, each (k,).
    """
    # Both ends of all constraints, first the smaller atoms, and for each atom the constraints that end there.
    ends = np.sort(pairs, axis=1).T.ravel()
    numbers = np.tile(np.arange(len(pairs)), 2)
    signs = np.where(pairs[numbers, 0] == ends, 1.0, -1.0)
    order = np.lexsort((numbers, ends))
    starts = np.searchsorted(ends[order], np.arange(len(inverse_masses) + 1))
    counts = starts[ends + 1] - starts[ends]
    one, other = np.repeat(np.arange(len(ends)), counts), order[of_ranges(starts[ends], starts[ends + 1])]
    rows, columns, is_larger = numbers[one], numbers[other], one >= len(pairs)
    weights = signs[one] * signs[other] * inverse_masses[ends[one]]
    # A constraint shares both atoms with itself, which is one entry.
    is_own = rows == columns
    weights[is_own & is_larger] += weights[is_own & ~is_larger]
    kept = np.flatnonzero(is_larger | ~is_own)
    kept = kept[np.lexsort((-columns[kept], is_larger[kept], rows[kept]))]
    return rows[kept], columns[kept], weights[kept]


def independent(table: ConstraintTable, q: np.ndarray) -> np.ndarray:
    """Return which constraints of bodies at q (3, n) do not follow from others to first order, (c,).

    In trees, such as bonds to hydrogens, none does: each outermost atom has one constraint, which alone moves it. Else
    the matrix of the constraints is factorized with pivots on the diagonal. Pivots of redundant constraints are close
    to the shift of the diagonal, which keeps them from being 0.
    """
    if _are_trees(table):
        return np.ones(len(table.squares), dtype=bool)
    from scipy import sparse
    from scipy.sparse.linalg import splu

    elements = kernels.constraints.equations(table, np.ascontiguousarray(q))
    c = len(table.squares)
    matrix = sparse.csc_array((elements, (table.rows, table.columns)), (c, c)) + SHIFT * sparse.eye_array(c)
    factors = splu(matrix.tocsc(), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return (np.abs(factors.U.diagonal()) > PIVOT)[factors.perm_c]


def _are_trees(table: ConstraintTable) -> bool:
    """Return whether no component of the constraints has a cycle."""
    return len(table.squares) == len(table.members) - len(distinct(table.first))
