"""Motion with distance constraints, all solved at once. NumPy executes these functions, Numba compiles them.

Momenta that satisfy the constraints to first order follow from linear equations for multipliers along the bonds, with
the matrix G M^-1 G^T. It is symmetric, sparse, well conditioned for bonds of molecules, and singular where constraints
are redundant. The method of conjugate residuals (Stiefel, Comment. Math. Helv. 29, 157 (1955)) needs only products with
it, and multipliers that do nothing do not disturb it. Three digits take some 4 iterations for bonds to hydrogens and 10
for all bonds of a chain.

Positions x, relative to the first atom of each component, and momenta p are (3, atoms), bonds (3, constraints). Bonds
and total momentum have the rounding of numbers of their own size, wherever in the box the atoms are.
"""

from typing import NamedTuple

import numpy as np
from numpy import ndarray

#: Factor by which each solution of the linear equations reduces residuals. They neglect the motion of the bonds.
REDUCTION = 1e-3

#: The same for projections, which are made twice, so that only rounding remains.
FULL_REDUCTION = 1e-10

#: The update that follows a relative residual below this is the last one.
CLOSE = 1e-11

#: Linear and nonlinear iterations; reached only where there is no solution.
LINEAR, NONLINEAR = 400, 40


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
    """

    members: ndarray
    first: ndarray
    ends: ndarray
    squares: ndarray
    inverse_masses: ndarray
    rows: ndarray
    columns: ndarray
    weights: ndarray


def differences(ends, x):
    """Return vectors (3, c) from the second to the first end of each constraint."""
    return taken(ends[0], x) - taken(ends[1], x)


def pushed(ends, multipliers, bonds, p):
    """Return momenta (3, atoms) after multipliers (c,) along bonds (3, c) act on first ends, oppositely on second."""
    first, second = ends
    atoms = p.shape[1]
    forces = multipliers * bonds
    return p + np.stack([np.bincount(first, f, atoms) - np.bincount(second, f, atoms) for f in forces])


def multiplied(rows, columns, matrix, x):
    """Return the product with a sparse matrix that has an element in each row."""
    return np.bincount(rows, matrix * x[columns])


def taken(columns, vectors):
    """Return some columns of vectors (3, n)."""
    return vectors[:, columns]


def put(columns, values, vectors):
    """Write some columns of vectors (3, n)."""
    vectors[:, columns] = values


def dots(a, b):
    """Return scalar products (c,) of vectors (3, c)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def linear_equations(table, bonds):
    """Return elements of G M^-1 G^T scaled to a diagonal of ones, and the factors of its rows and columns."""
    first, second = table.inverse_masses[table.ends[0]], table.inverse_masses[table.ends[1]]
    scale = 1 / np.sqrt(dots(bonds, bonds) * (first + second))
    rows = scale * bonds
    return table.weights * dots(rows[:, table.rows], rows[:, table.columns]), scale


def solution(table, matrix, scale, wanted, reduction):
    """Return multipliers that change rates along the bonds as wanted, up to a share `reduction` of them."""
    residual = scale * wanted
    x = np.zeros(len(residual))
    image = multiplied(table.rows, table.columns, matrix, residual)
    direction, image_of_direction = residual, image
    size = (residual * image).sum()
    enough = reduction**2 * size
    for _ in range(LINEAR):
        if not size > enough:
            break
        step = size / (image_of_direction * image_of_direction).sum()
        x = x + step * direction
        residual = residual - step * image_of_direction
        image = multiplied(table.rows, table.columns, matrix, residual)
        last = size
        size = (residual * image).sum()
        direction = residual + (size / last) * direction
        image_of_direction = image + (size / last) * image_of_direction
    return scale * x


def lengths_after(table, x, p, d):
    """Return positions x + d M^-1 p, and the errors of their squared lengths, (c,)."""
    reached = x + (d * table.inverse_masses) * p
    bonds = differences(table.ends, reached)
    return reached, table.squares - dots(bonds, bonds)


def constrain(table, x, p, d, guess):
    """Return momenta with which x + d M^-1 p satisfies the constraints, changed along their gradients at x.

    Args:
        guess: multipliers to begin with, (c,).

    Returns:
        (positions reached, momenta, multipliers, the constraint that is violated most if there is no solution or -1).
    """
    before = differences(table.ends, x)
    matrix, scale = linear_equations(table, before)
    p = pushed(table.ends, guess, before, p)
    multipliers = guess
    residuals = np.zeros(len(guess))
    for _ in range(NONLINEAR):
        reached, lacking = lengths_after(table, x, p, d)
        found = np.abs(lacking) / table.squares
        if not np.isfinite(found).all():
            # The last finite residuals show the constraints that have no solution, unless free motion is not finite.
            if residuals.max() == 0:
                residuals = np.where(np.isfinite(found), 0.0, np.inf)
            break
        residuals = found
        change = solution(table, matrix, scale, (0.5 / d) * lacking, REDUCTION)
        multipliers = multipliers + change
        p = pushed(table.ends, change, before, p)
        if residuals.max() < CLOSE:
            return x + (d * table.inverse_masses) * p, p, multipliers, -1
    return reached, p, multipliers, residuals.argmax()


def relative(table, q):
    """Return positions (3, atoms) from the first atom of each component, of bodies at q (3, n)."""
    return taken(table.members, q) - taken(table.first, q)


def tangent(table, x, p):
    """Return momenta (3, atoms) without their part along the constraints."""
    bonds = differences(table.ends, x)
    matrix, scale = linear_equations(table, bonds)
    for _ in range(2):
        rates = dots(bonds, differences(table.ends, table.inverse_masses * p))
        change = solution(table, matrix, scale, -rates, FULL_REDUCTION)
        p = pushed(table.ends, change, bonds, p)
    return p


def project(table, q, p, new_p):
    """Write momenta, or forces, of constrained bodies without what acts along the constraints; all are (3, n)."""
    put(table.members, tangent(table, relative(table, q), taken(table.members, p)), new_p)


def displace(table, q, push, new_q):
    """Write positions q + M^-1 push, put back along the bonds at q; returns the constraint violated most, or -1."""
    pushed, none = taken(table.members, push), np.zeros(len(table.squares))
    x, _, _, failed = constrain(table, relative(table, q), pushed, 1.0, none)
    put(table.members, taken(table.first, q) + x, new_q)
    return failed


def drift(table, q, p, times, new_q, new_p):
    """Write positions and momenta after RATTLE steps of some times; returns the constraint violated most, or -1.

    Momenta are not projected: the multipliers of the next step remove their part along the bonds.
    """
    x, p = relative(table, q), taken(table.members, p)
    forces, before = np.zeros(len(table.squares)), 0.0
    for d in times:
        # Momenta are those of the middle of the step before.
        half = 0.5 * (d + before)
        x, p, multipliers, failed = constrain(table, x, p, d, half * forces)
        if failed >= 0:
            return failed
        if abs(half) > 0.05 * abs(d):
            forces = multipliers / half
        before = d
    put(table.members, taken(table.first, q) + x, new_q)
    put(table.members, p, new_p)
    return -1
