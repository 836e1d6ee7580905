"""Kernels of motion with distance constraints, which are all solved at once.

Momenta that satisfy the constraints to first order follow from linear equations for multipliers along the bonds, with
the matrix G M^-1 G^T. It is symmetric, sparse, well conditioned for bonds of molecules, and singular where constraints
are redundant. The method of conjugate residuals (Stiefel, Comment. Math. Helv. 29, 157 (1955)) needs only products with
it, and redundant multipliers do not disturb it. Three digits take some 4 iterations for bonds to hydrogens and 10 for
all bonds of a chain.

Positions x, relative to the first atom of each component, and momenta p are (3, atoms), bonds (3, constraints). So the
rounding of bonds and total momentum does not depend on where in the box the atoms are.
"""

import numpy as np

from openmm_sier.dynamics.kernels.compilation import called, kernel
from openmm_sier.dynamics.kernels.formulas import LINE, cross, plus, spin

#: Relative tolerance of each linear solution. Less is useless, since the equations are linearized.
REDUCTION = 1e-3

#: The same for projections. They are made twice, so that only rounding remains.
FULL_REDUCTION = 1e-10

#: Relative residual. The update after a smaller one is the last.
CLOSE = 1e-11

#: Largest numbers of linear and nonlinear iterations, reached only without a solution.
LINEAR, NONLINEAR = 400, 40

#: The same of linear iterations, for each constraint of the largest component. A chain of n beads in one line takes n
#: of them without rounding.
LINEAR_EACH = 4


@called
def take(columns, vectors):
    """Return some columns of vectors (3, n)."""
    out = np.empty((3, len(columns)))
    for axis in range(3):
        for c in range(len(columns)):
            out[axis, c] = vectors[axis, np.uint64(columns[c])]
    return out


@called
def put(columns, values, vectors):
    """Write some columns of vectors (3, n)."""
    for axis in range(3):
        for c in range(len(columns)):
            vectors[axis, np.uint64(columns[c])] = values[axis, c]


@called
def differences(ends, x):
    """Return vectors (3, c) from the second to the first end of each constraint."""
    return take(ends[0], x) - take(ends[1], x)


@called
def dots(a, b):
    """Return scalar products (c,) of vectors (3, c)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@called
def with_impulses(ends, multipliers, bonds, p):
    """Return momenta (3, atoms) after multipliers (c,) along bonds (3, c) act on first ends, oppositely on second."""
    out = p.copy()
    for axis in range(3):
        for c in range(ends.shape[1]):
            impulse = multipliers[c] * bonds[axis, c]
            out[axis, np.uint64(ends[0, c])] += impulse
            out[axis, np.uint64(ends[1, c])] -= impulse
    return out


@called
def linear_equations(table, bonds):
    """Return elements of G M^-1 G^T, scaled to a diagonal of ones, and the factors of its rows and columns."""
    ends, inverse_masses = table.ends, table.inverse_masses
    rows, columns, weights = table.rows, table.columns, table.weights
    scale, matrix = np.empty(ends.shape[1]), np.empty(len(rows))
    for c in range(len(scale)):
        both = inverse_masses[np.uint64(ends[0, c])] + inverse_masses[np.uint64(ends[1, c])]
        square = bonds[0, c] * bonds[0, c] + bonds[1, c] * bonds[1, c] + bonds[2, c] * bonds[2, c]
        scale[c] = 1 / np.sqrt(square * both)
    for k in range(len(rows)):
        i, j = np.uint64(rows[k]), np.uint64(columns[k])
        dot = bonds[0, i] * bonds[0, j] + bonds[1, i] * bonds[1, j] + bonds[2, i] * bonds[2, j]
        matrix[k] = weights[k] * (scale[i] * scale[j]) * dot
    return matrix, scale


@called
def multiply(rows, columns, matrix, x, image):
    """Write the product of a sparse matrix, whose diagonal is stored, and x; return its scalar product with x."""
    for c in range(len(image)):
        image[c] = 0.0
    for k in range(len(rows)):
        image[np.uint64(rows[k])] += matrix[k] * x[np.uint64(columns[k])]
    size = 0.0
    for c in range(len(x)):
        size += x[c] * image[c]
    return size


@called
def solution(table, matrix, scale, changes, reduction):
    """Return multipliers that change rates along the bonds by `changes`, (c,), up to a share `reduction` of these."""
    rows, columns = table.rows, table.columns
    work = np.zeros((5, len(changes)))
    x, residual, image, direction, along = work[0], work[1], work[2], work[3], work[4]
    for c in range(len(x)):
        residual[c] = scale[c] * changes[c]
    size = multiply(rows, columns, matrix, residual, image)
    for c in range(len(x)):
        direction[c], along[c] = residual[c], image[c]
    enough = reduction**2 * size
    for _ in range(max(LINEAR, LINEAR_EACH * table.largest)):
        if not size > enough:
            break
        square = 0.0
        for c in range(len(x)):
            square += along[c] * along[c]
        step = size / square
        for c in range(len(x)):
            x[c] += step * direction[c]
            residual[c] -= step * along[c]
        last, size = size, multiply(rows, columns, matrix, residual, image)
        if not size > enough:
            break
        for c in range(len(x)):
            direction[c] = residual[c] + (size / last) * direction[c]
            along[c] = image[c] + (size / last) * along[c]
    return scale * x


@called
def residuals_after(table, x, p, d):
    """Return the squared lengths less those at positions x + d M^-1 p, (c,)."""
    ends, squares = table.ends, table.squares
    reached, residuals = x + (d * table.inverse_masses) * p, np.empty(len(squares))
    for c in range(len(squares)):
        i, j = np.uint64(ends[0, c]), np.uint64(ends[1, c])
        bond = reached[0, i] - reached[0, j], reached[1, i] - reached[1, j], reached[2, i] - reached[2, j]
        residuals[c] = squares[c] - (bond[0] * bond[0] + bond[1] * bond[1] + bond[2] * bond[2])
    return residuals


@called
def largest_error(residuals, squares):
    """Return the largest relative error of a squared length, and its constraint; inf and the first if not finite."""
    largest, worst = 0.0, 0
    for c in range(len(residuals)):
        error = abs(residuals[c]) / squares[c]
        if not error < np.inf:
            return np.inf, c
        if error > largest:
            largest, worst = error, c
    return largest, worst


@called
def constrain(table, x, p, d, guess):
    """Return momenta with which x + d M^-1 p satisfies the constraints, changed along their gradients at x.

    Args:
        guess: multipliers to begin with, (c,).

    Returns:
        (positions, momenta, multipliers, the most violated constraint if there is no solution, or -1).
    """
    before = differences(table.ends, x)
    matrix, scale = linear_equations(table, before)
    p = with_impulses(table.ends, guess, before, p)
    multipliers, worst = guess, -1
    for _ in range(NONLINEAR):
        residuals = residuals_after(table, x, p, d)
        error, violated = largest_error(residuals, table.squares)
        if error == np.inf:
            # The last finite errors show the constraint that has no solution, unless free motion is not finite.
            return x, p, multipliers, violated if worst < 0 else worst
        worst = violated
        change = solution(table, matrix, scale, (0.5 / d) * residuals, REDUCTION)
        multipliers = multipliers + change
        p = with_impulses(table.ends, change, before, p)
        if error < CLOSE:
            return x + (d * table.inverse_masses) * p, p, multipliers, -1
    return x, p, multipliers, worst


@called
def relative(table, q):
    """Return positions (3, atoms) from the first atom of each component, of bodies at q (3, n)."""
    return take(table.members, q) - take(table.first, q)


@called
def tangent(table, x, p):
    """Return momenta (3, atoms) without their part along the constraints."""
    bonds = differences(table.ends, x)
    matrix, scale = linear_equations(table, bonds)
    for _ in range(2):
        rates = dots(bonds, differences(table.ends, table.inverse_masses * p))
        change = solution(table, matrix, scale, -rates, FULL_REDUCTION)
        p = with_impulses(table.ends, change, bonds, p)
    return p


@kernel
def equations(table, q):
    """Return the elements of the matrix of the constraints of bodies at q (3, n), see `linear_equations`."""
    return linear_equations(table, differences(table.ends, relative(table, q)))[0]


@kernel
def project(table, q, p, new_p):
    """Write momenta, or forces, of constrained bodies without what acts along the constraints; all are (3, n)."""
    put(table.members, tangent(table, relative(table, q), take(table.members, p)), new_p)


@kernel
def displace(table, q, push, new_q):
    """Write positions q + M^-1 push, corrected along the bonds at q; return the most violated constraint, or -1."""
    impulses, no_guess = take(table.members, push), np.zeros(len(table.squares))
    x, _, _, failed = constrain(table, relative(table, q), impulses, 1.0, no_guess)
    put(table.members, take(table.first, q) + x, new_q)
    return failed


@kernel
def drift(table, q, p, times, new_q, new_p):
    """Write positions and momenta after RATTLE steps of given times; return the most violated constraint, or -1.

    Momenta are not projected: the multipliers of the next step remove their part along the bonds.
    """
    x, p = relative(table, q), take(table.members, p)
    forces, before = np.zeros(len(table.squares)), 0.0
    for d in times:
        # Momenta are those in the middle of the last step.
        half = 0.5 * (d + before)
        x, p, multipliers, failed = constrain(table, x, p, d, half * forces)
        if failed >= 0:
            return failed
        if abs(half) > 0.05 * abs(d):
            forces = multipliers / half
        before = d
    put(table.members, take(table.first, q) + x, new_q)
    put(table.members, p, new_p)
    return -1


@kernel
def turn_groups(edges, members, m, q, at, F):
    """Add forces (3, n) that turn each group of points rigidly, and exert the torques of displaced forces.

    A group on a line does not rotate about it, and the torque on a single point is lost.

    Args:
        edges: the first member of each group, and the end of the last one.
        members: columns of the members, group by group, (k,).
        m: their masses, (k,).
        q, at: positions, and the points at which the forces act, (3, n).
        F: (3, n), changed.
    """
    for g in range(len(edges) - 1):
        mass, centre, torque = 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        for k in range(edges[g], edges[g + 1]):
            n = np.uint64(members[k])
            mass += m[k]
            centre = plus(centre, (m[k] * q[0, n], m[k] * q[1, n], m[k] * q[2, n]))
            lever = at[0, n] - q[0, n], at[1, n] - q[1, n], at[2, n] - q[2, n]
            torque = plus(torque, cross(lever, (F[0, n], F[1, n], F[2, n])))
        centre = centre[0] / mass, centre[1] / mass, centre[2] / mass
        xx = yy = zz = xy = yz = zx = 0.0
        for k in range(edges[g], edges[g + 1]):
            n = np.uint64(members[k])
            x, y, z = q[0, n] - centre[0], q[1, n] - centre[1], q[2, n] - centre[2]
            xx, yy, zz = xx + m[k] * (x * x), yy + m[k] * (y * y), zz + m[k] * (z * z)
            xy, yz, zx = xy + m[k] * (x * y), yz + m[k] * (y * z), zx + m[k] * (z * x)
        acceleration, determinant, half = spin((xx, yy, zz, xy, yz, zx), torque)
        if determinant <= LINE * half**3:
            acceleration, determinant = torque, half
        for k in range(edges[g], edges[g + 1]):
            n = np.uint64(members[k])
            force = cross(acceleration, (q[0, n] - centre[0], q[1, n] - centre[1], q[2, n] - centre[2]))
            for axis in range(3):
                F[axis, n] += m[k] / determinant * force[axis]
