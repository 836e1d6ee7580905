"""The graph of constraints: its connected components, and which constraints are independent."""

import numpy as np

from openmm_sier.dynamics import kernels
from openmm_sier.dynamics.constraints.table import ConstraintTable

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
    return len(table.squares) == len(table.members) - len(np.unique(table.first))
