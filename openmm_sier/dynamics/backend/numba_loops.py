"""Loops for Numba to compile. Nothing else executes them."""

import numpy as np

from openmm_sier.dynamics.backend.constraint_solver import LINEAR
from openmm_sier.dynamics.backend.elliptic import long_series
from openmm_sier.dynamics.backend.formulas import (
    LINE,
    SMALL_ANGLE,
    combine,
    cross,
    displacing_rotation,
    plus,
    rotation_matrix,
    small_sine_cosine,
    spin,
)
from openmm_sier.dynamics.backend.short_steps import free_rotation

#: Bodies that are rotated together, and numbers that each needs for it. A smaller tile leaves instructions that handle
#: several bodies unfilled, a larger one takes longer where bodies are few.
TILE, ROWS = 32, 22


def copy(target, source):
    """Write some numbers to as many others."""
    for n in range(len(target)):
        target[n] = source[n]


def rotate(start, stop, A, L, h, edges, rates, out, far):
    """Rotate bodies freely; return how many are beyond the formula, and set `far` for those.

    Args:
        start, stop: range of the bodies.
        A, L: (3, 3, n) and (3, n).
        h: time.
        edges: the first body of each kind, and the end of the last one, (m + 1,).
        rates: inverse moments of each kind, descending, zeros for points, (m, 3).
        out: (3, 3, n), valid where `far` is not set.
        far: (n,), bool.
    """
    left = 0
    tile = np.ones(ROWS * TILE)
    for kind in range(len(rates)):
        first, end = max(start, edges[kind]), min(stop, edges[kind + 1])
        if first >= end:
            continue
        if rates[kind, 0] > 0:
            left += rotate_kind(first, end, A, L, h, rates[kind], tile, out, far)
        else:
            keep(first, end, A, out, far)
    return left


def keep(start, stop, A, out, far):
    """Write the attitudes of points, which do not turn; see `rotate`."""
    for i in range(3):
        for j in range(3):
            copy(out[i, j, start:stop], A[i, j, start:stop])
    far[start:stop] = False


def rotate_kind(start, stop, A, L, h, rates, tile, out, far):
    """Do what `rotate` does, for bodies with the same rates, (3,)."""
    left = 0
    for first in range(start, stop, TILE):
        end = min(first + TILE, stop)
        size = end - first
        for i in range(3):
            for j in range(3):
                row = (3 * i + j) * TILE
                copy(tile[row : row + size], A[i, j, first:end])
            row = (9 + i) * TILE
            copy(tile[row : row + size], L[i, first:end])
        rotate_tile(tile, (rates[0], rates[1], rates[2]), h)
        for i in range(3):
            for j in range(3):
                row = (12 + 3 * i + j) * TILE
                copy(out[i, j, first:end], tile[row : row + size])
        for n in range(size):
            far[first + n] = tile[21 * TILE + n] == 0
            left += far[first + n]
    return left


def rotate_tile(tile, rates, h):
    """Rotate a tile of bodies freely, from its rows A (9) and L (3) to others: new A (9), and whether it is valid.

    There is one array with constant distances between its rows, and no branch or call that is not inlined. So the
    compiler sees that bodies are independent, and handles several with each instruction.
    """
    for n in range(TILE):
        x = tile[n], tile[TILE + n], tile[2 * TILE + n]
        y = tile[3 * TILE + n], tile[4 * TILE + n], tile[5 * TILE + n]
        z = tile[6 * TILE + n], tile[7 * TILE + n], tile[8 * TILE + n]
        L = tile[9 * TILE + n], tile[10 * TILE + n], tile[11 * TILE + n]
        body_L = combine(L, x[0], x[1], x[2]), combine(L, y[0], y[1], y[2]), combine(L, z[0], z[1], z[2])
        turn, _, reached = free_rotation(body_L, rates, h, long_series, small_sine_cosine, SMALL_ANGLE)
        rows = rotation_matrix(turn[0], turn[1], turn[2], turn[3])
        for column in range(3):
            tile[(12 + column) * TILE + n] = combine(rows[0], x[column], y[column], z[column])
            tile[(15 + column) * TILE + n] = combine(rows[1], x[column], y[column], z[column])
            tile[(18 + column) * TILE + n] = combine(rows[2], x[column], y[column], z[column])
        tile[21 * TILE + n] = reached


def advance(start, stop, q, p, h, inverse_masses, new_q):
    """Move centres for a time h, for a range of the bodies."""
    for x in range(3):
        for n in range(np.uint64(start), np.uint64(stop)):
            new_q[x, n] = q[x, n] + (h * inverse_masses[n]) * p[x, n]
    return 0


def drift(start, stop, q, p, A, L, h, edges, rates, inverse_masses, new_q, new_A, far):
    """Do `advance` and `rotate` in one call, since calls cost more than a few bodies do."""
    advance(start, stop, q, p, h, inverse_masses, new_q)
    return rotate(start, stop, A, L, h, edges, rates, new_A, far)


def kick(start, stop, p, L, F, torque, h, new_p, new_L):
    """Do what `NumpyBackend.kick` does by forces at the centres, for a range of the bodies."""
    for x in range(3):
        for n in range(np.uint64(start), np.uint64(stop)):
            new_p[x, n] = p[x, n] + h * F[x, n]
            new_L[x, n] = L[x, n] + h * torque[x, n]
    return 0


def kick_elsewhere(start, stop, p, L, F, torque, h, q, at, new_p, new_L):
    """Do what `NumpyBackend.kick` does by forces at other points, for a range of the bodies."""
    for n in range(np.uint64(start), np.uint64(stop)):
        force = F[0, n], F[1, n], F[2, n]
        lever = cross((at[0, n] - q[0, n], at[1, n] - q[1, n], at[2, n] - q[2, n]), force)
        for x in range(3):
            new_p[x, n] = p[x, n] + h * force[x]
            new_L[x, n] = L[x, n] + h * (torque[x, n] + lever[x])
    return 0


def bathe(
    start, stop, p, A, L, kept, kept_turning, widths, noise, inverse_masses, inverse_moments, new_p, new_L, gained
):
    """Do what `NumpyBackend.bathe` does, for a range of the bodies."""
    for n in range(np.uint64(start), np.uint64(stop)):
        energy = 0.0
        for x in range(3):
            new_p[x, n] = kept * p[x, n] + widths[x, n] * noise[x, n]
            energy += new_p[x, n] * new_p[x, n] - p[x, n] * p[x, n]
            new_L[x, n] = kept_turning * L[x, n]
        energy *= inverse_masses[n]
        for i in range(3):
            along = A[i, 0, n] * L[0, n] + A[i, 1, n] * L[1, n] + A[i, 2, n] * L[2, n]
            twist = widths[3 + i, n] * noise[3 + i, n]
            new_along = kept_turning * along + twist
            energy += (new_along * new_along - along * along) * inverse_moments[i, n]
            for x in range(3):
                new_L[x, n] += twist * A[i, x, n]
        gained[n] = 0.5 * energy
    return 0


def displace(start, stop, q, A, F, torque, shift, inverse_masses, inverse_moments, new_q, new_A):
    """Do what `RigidBodies.displaced` does, for a range of the bodies; writes q (3, n) and A (3, 3, n)."""
    for n in range(np.uint64(start), np.uint64(stop)):
        x = (A[0, 0, n], A[0, 1, n], A[0, 2, n])
        y = (A[1, 0, n], A[1, 1, n], A[1, 2, n])
        z = (A[2, 0, n], A[2, 1, n], A[2, 2, n])
        turn = (torque[0, n], torque[1, n], torque[2, n])
        inverses = (inverse_moments[0, n], inverse_moments[1, n], inverse_moments[2, n])
        rows = displacing_rotation(x, y, z, turn, inverses, shift)
        for axis in range(3):
            new_q[axis, n] = q[axis, n] + (shift * inverse_masses[n]) * F[axis, n]
            new_A[0, axis, n] = combine(rows[0], x[axis], y[axis], z[axis])
            new_A[1, axis, n] = combine(rows[1], x[axis], y[axis], z[axis])
            new_A[2, axis, n] = combine(rows[2], x[axis], y[axis], z[axis])
    return 0


def columns_of(A, n):
    """Return the columns of the attitude matrix of a body, to be read once for all of its sites."""
    return (
        (A[0, 0, n], A[1, 0, n], A[2, 0, n]),
        (A[0, 1, n], A[1, 1, n], A[2, 1, n]),
        (A[0, 2, n], A[1, 2, n], A[2, 2, n]),
    )


def lab_frame(vector, columns):
    """Return a vector of the principal frame in the lab frame."""
    x, y, z = columns
    return combine(vector, x[0], x[1], x[2]), combine(vector, y[0], y[1], y[2]), combine(vector, z[0], z[1], z[2])


def arm_of(places, site, columns):
    """Return the place of a site relative to the centre of its body, in the lab frame."""
    return lab_frame((places[0, site], places[1, site], places[2, site]), columns)


def set_of(sets, row):
    """Return a row of the table `Sites.sets`, in unsigned numbers, for which Numba looks for no negative index."""
    first, end, size = np.uint64(sets[row, 0]), np.uint64(sets[row, 1]), np.uint64(sets[row, 2])
    return first, end, size, np.uint64(sets[row, 3]), np.uint64(sets[row, 4])


def place(start, stop, q, A, sets, places, atoms, positions):
    """Do what `NumpyBackend.place` does, for a range of the bodies; see `Sites` for `sets`, `places` and `atoms`.

    Return how many bodies have an atom whose position is not finite.
    """
    broken = 0
    for row in range(len(sets)):
        first, end, size, site, entry = set_of(sets, row)
        for n in range(max(first, np.uint64(start)), min(end, np.uint64(stop))):
            columns, centre, total = columns_of(A, n), (q[0, n], q[1, n], q[2, n]), 0.0
            own = entry + (n - first) * size
            for j in range(size):
                x, y, z = plus(centre, arm_of(places, site + j, columns))
                atom = np.uint64(atoms[own + j])
                positions[atom, 0], positions[atom, 1], positions[atom, 2] = x, y, z
                total += abs(x) + abs(y) + abs(z)
            broken += not total < np.inf
    return broken


def move(start, stop, p, A, L, inverse_masses, inverse_moments, sets, places, atoms, velocities):
    """Do what `NumpyBackend.move` does, for a range of the bodies; see `place`."""
    for row in range(len(sets)):
        first, end, size, site, entry = set_of(sets, row)
        for n in range(max(first, np.uint64(start)), min(end, np.uint64(stop))):
            columns, m = columns_of(A, n), inverse_masses[n]
            x, y, z = columns
            turning = (
                inverse_moments[0, n] * (x[0] * L[0, n] + y[0] * L[1, n] + z[0] * L[2, n]),
                inverse_moments[1, n] * (x[1] * L[0, n] + y[1] * L[1, n] + z[1] * L[2, n]),
                inverse_moments[2, n] * (x[2] * L[0, n] + y[2] * L[1, n] + z[2] * L[2, n]),
            )
            omega, v = lab_frame(turning, columns), (m * p[0, n], m * p[1, n], m * p[2, n])
            own = entry + (n - first) * size
            for j in range(size):
                moved = plus(v, cross(omega, arm_of(places, site + j, columns)))
                atom = np.uint64(atoms[own + j])
                velocities[atom, 0], velocities[atom, 1], velocities[atom, 2] = moved
    return 0


def collect(start, stop, vectors, A, sets, places, weights, atoms, total, moment):
    """Do what `NumpyBackend.collect` does, for a range of the bodies; see `place`.

    Return how many bodies have a sum that is not finite.
    """
    broken = 0
    for row in range(len(sets)):
        first, end, size, site, entry = set_of(sets, row)
        for n in range(max(first, np.uint64(start)), min(end, np.uint64(stop))):
            columns, sums, moments = columns_of(A, n), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
            own = entry + (n - first) * size
            for j in range(size):
                atom, weight = np.uint64(atoms[own + j]), weights[site + j]
                weighted = weight * vectors[atom, 0], weight * vectors[atom, 1], weight * vectors[atom, 2]
                sums = plus(sums, weighted)
                moments = plus(moments, cross(arm_of(places, site + j, columns), weighted))
            largest = 0.0
            for x in range(3):
                total[x, n], moment[x, n] = sums[x], moments[x]
                largest += abs(sums[x]) + abs(moments[x])
            broken += not largest < np.inf
    return broken


def turn_groups(edges, part, m, q, at, F):
    """Do what `NumpyBackend.turn_groups` does."""
    for g in range(len(edges) - 1):
        mass, centre, torque = 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        for k in range(edges[g], edges[g + 1]):
            n = np.uint64(part[k])
            mass += m[k]
            centre = plus(centre, (m[k] * q[0, n], m[k] * q[1, n], m[k] * q[2, n]))
            lever = at[0, n] - q[0, n], at[1, n] - q[1, n], at[2, n] - q[2, n]
            torque = plus(torque, cross(lever, (F[0, n], F[1, n], F[2, n])))
        centre = centre[0] / mass, centre[1] / mass, centre[2] / mass
        xx = yy = zz = xy = yz = zx = 0.0
        for k in range(edges[g], edges[g + 1]):
            n = np.uint64(part[k])
            x, y, z = q[0, n] - centre[0], q[1, n] - centre[1], q[2, n] - centre[2]
            xx, yy, zz = xx + m[k] * (x * x), yy + m[k] * (y * y), zz + m[k] * (z * z)
            xy, yz, zx = xy + m[k] * (x * y), yz + m[k] * (y * z), zx + m[k] * (z * x)
        turned, determinant, half = spin((xx, yy, zz, xy, yz, zx), torque)
        if determinant <= LINE * half**3:
            turned, determinant = torque, half
        for k in range(edges[g], edges[g + 1]):
            n = np.uint64(part[k])
            force = cross(turned, (q[0, n] - centre[0], q[1, n] - centre[1], q[2, n] - centre[2]))
            for axis in range(3):
                F[axis, n] += m[k] / determinant * force[axis]


def pushed(ends, multipliers, bonds, p):
    """Do what `constraint_solver.pushed` does."""
    out = p.copy()
    for axis in range(3):
        for c in range(ends.shape[1]):
            impulse = multipliers[c] * bonds[axis, c]
            out[axis, np.uint64(ends[0, c])] += impulse
            out[axis, np.uint64(ends[1, c])] -= impulse
    return out


def lengths_after(table, x, p, d):
    """Do what `constraint_solver.lengths_after` does."""
    ends, squares = table.ends, table.squares
    reached, lacking = x + (d * table.inverse_masses) * p, np.empty(len(squares))
    for c in range(len(squares)):
        i, j = np.uint64(ends[0, c]), np.uint64(ends[1, c])
        bond = reached[0, i] - reached[0, j], reached[1, i] - reached[1, j], reached[2, i] - reached[2, j]
        lacking[c] = squares[c] - (bond[0] * bond[0] + bond[1] * bond[1] + bond[2] * bond[2])
    return reached, lacking


def taken(columns, vectors):
    """Do what `constraint_solver.taken` does."""
    out = np.empty((3, len(columns)))
    for axis in range(3):
        for c in range(len(columns)):
            out[axis, c] = vectors[axis, np.uint64(columns[c])]
    return out


def put(columns, values, vectors):
    """Do what `constraint_solver.put` does."""
    for axis in range(3):
        for c in range(len(columns)):
            vectors[axis, np.uint64(columns[c])] = values[axis, c]


def linear_equations(table, bonds):
    """Do what `constraint_solver.linear_equations` does."""
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


def multiply(rows, columns, matrix, x, image):
    """Write the product with a sparse matrix, which has its diagonal; returns its scalar product with x."""
    image[:] = 0.0
    for k in range(len(rows)):
        image[np.uint64(rows[k])] += matrix[k] * x[np.uint64(columns[k])]
    size = 0.0
    for c in range(len(x)):
        size += x[c] * image[c]
    return size


def solution(table, matrix, scale, wanted, reduction):
    """Do what `constraint_solver.solution` does, without temporary arrays."""
    rows, columns = table.rows, table.columns
    work = np.zeros((5, len(wanted)))
    x, residual, image, direction, along = work[0], work[1], work[2], work[3], work[4]
    residual[:] = scale * wanted
    size = multiply(rows, columns, matrix, residual, image)
    direction[:], along[:] = residual, image
    enough = reduction**2 * size
    for _ in range(LINEAR):
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
