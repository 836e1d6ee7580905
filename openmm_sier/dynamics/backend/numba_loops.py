"""Loops over bodies for Numba to compile, which call `formulas` for one body at a time. Nothing else executes them."""

from __future__ import annotations

import numpy as np

from openmm_sier.dynamics.backend.formulas import LINE, combine, cross, displacing_rotation, rotation_matrix, spin

#: Bodies that are rotated together, and numbers that each needs for it, 22 kB in all, for the nearest cache.
TILE, ROWS = 128, 22


def rotate_body(body_L, rates, h):
    """Stands for `of_body` of the rotor that a loop is compiled for."""
    raise NotImplementedError


def span(start, stop):
    """Numbers of bodies, unsigned: for signed ones each access would check if it counts from the end of the array.

    That takes time, and keeps the compiler from handling several bodies with each instruction.
    """
    return range(np.uint64(start), np.uint64(stop))


def copy(target, sign, source):
    """Write `sign` times some numbers to as many others."""
    for n in range(len(target)):
        target[n] = sign * source[n]


def rotate(start, stop, A, L, h, frame, out, far):
    """Free rotation of bodies with equal moments; returns how many are beyond the formula, and sets `far` for those.

    Args:
        start, stop: range of the bodies.
        A, L: (3, 3, n) and (3, n).
        h: time.
        frame: rates (3,), order (3,) and parity () of `top.Top`.
        out: (3, 3, n), valid where `far` is not set.
        far: (n,), bool.
    """
    rates, order, parity = frame
    left = 0
    tile = np.ones(ROWS * TILE)
    for first in range(start, stop, TILE):
        end = min(first + TILE, stop)
        size = end - first
        for i in range(3):
            sign = parity if i == 1 else 1.0
            for j in range(3):
                row = (3 * i + j) * TILE
                copy(tile[row : row + size], sign, A[order[i], j, first:end])
            row = (9 + i) * TILE
            copy(tile[row : row + size], 1.0, L[i, first:end])
        rotate_tile(tile, (rates[0], rates[1], rates[2]), h)
        for i in range(3):
            sign = parity if i == 1 else 1.0
            for j in range(3):
                row = (12 + 3 * i + j) * TILE
                copy(out[order[i], j, first:end], sign, tile[row : row + size])
        for n in range(size):
            far[first + n] = tile[21 * TILE + n] == 0
            left += far[first + n]
    return left


def rotate_tile(tile, rates, h):
    """Free rotation of a tile of bodies, from rows of it to others: A (9 rows), L (3), new A (9), whether it is valid.

    There is one array with constant distances between its rows, and no branch or call that is not inlined. So the
    compiler sees that bodies are independent, and handles several with each instruction.
    """
    for n in range(TILE):
        x = tile[n], tile[TILE + n], tile[2 * TILE + n]
        y = tile[3 * TILE + n], tile[4 * TILE + n], tile[5 * TILE + n]
        z = tile[6 * TILE + n], tile[7 * TILE + n], tile[8 * TILE + n]
        L = tile[9 * TILE + n], tile[10 * TILE + n], tile[11 * TILE + n]
        body_L = combine(L, x[0], x[1], x[2]), combine(L, y[0], y[1], y[2]), combine(L, z[0], z[1], z[2])
        turn, reached = rotate_body(body_L, rates, h)
        rows = rotation_matrix(turn[0], turn[1], turn[2], turn[3])
        for column in range(3):
            tile[(12 + column) * TILE + n] = combine(rows[0], x[column], y[column], z[column])
            tile[(15 + column) * TILE + n] = combine(rows[1], x[column], y[column], z[column])
            tile[(18 + column) * TILE + n] = combine(rows[2], x[column], y[column], z[column])
        tile[21 * TILE + n] = reached


def drift(start, stop, q, p, A, L, h, inverse_masses, frame, new_q, new_A, far):
    """Free motion of bodies with equal moments; returns what `rotate` does.

    Args:
        start, stop: range of the bodies.
        q, p, A, L: (3, n), and A (3, 3, n).
        h: time.
        inverse_masses: (n,).
        frame: of `rotate`; the rates of points are zero.
        new_q, new_A, far: written, the last two as by `rotate`.
    """
    for x in range(3):
        for n in span(start, stop):
            new_q[x, n] = q[x, n] + (h * inverse_masses[n]) * p[x, n]
    if frame[0][0] > 0:
        return rotate(start, stop, A, L, h, frame, new_A, far)
    far[start:stop] = False
    new_A[:, :, start:stop] = A[:, :, start:stop]
    return 0


def kick(start, stop, p, L, F, torque, h, new_p, new_L):
    """Momenta and angular momenta after forces and torques have acted for a time, (3, n) each."""
    for x in range(3):
        for n in span(start, stop):
            new_p[x, n] = p[x, n] + h * F[x, n]
            new_L[x, n] = L[x, n] + h * torque[x, n]


def displace(start, stop, q, A, F, torque, shift, inverse_masses, inverse_moments, new_q, new_A):
    """Bodies displaced by `shift` times their accelerations: q (3, n) and A (3, 3, n), written in the same shapes."""
    for n in span(start, stop):
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


def kick_from(start, stop, p, L, F, torque, arm, h, new_p, new_L):
    """As `kick`, by forces that act at a distance `arm` (3, n) from the centres."""
    for n in span(start, stop):
        force = (F[0, n], F[1, n], F[2, n])
        lever = cross((arm[0, n], arm[1, n], arm[2, n]), force)
        for x in range(3):
            new_p[x, n] = p[x, n] + h * force[x]
            new_L[x, n] = L[x, n] + h * (torque[x, n] + lever[x])


def turn_groups(start, stop, edges, part, m, q, torques, F):
    """As `NumpyBackend.turn_groups`, for a range of the groups."""
    for g in span(start, stop):
        members = span(edges[g], edges[g + np.uint64(1)])
        mass = cx = cy = cz = tx = ty = tz = 0.0
        for k in members:
            n = np.uint64(part[k])
            mass, cx, cy, cz = mass + m[k], cx + m[k] * q[0, n], cy + m[k] * q[1, n], cz + m[k] * q[2, n]
            tx, ty, tz = tx + torques[0, n], ty + torques[1, n], tz + torques[2, n]
        cx, cy, cz = cx / mass, cy / mass, cz / mass
        xx = yy = zz = xy = yz = zx = 0.0
        for k in members:
            n = np.uint64(part[k])
            x, y, z = q[0, n] - cx, q[1, n] - cy, q[2, n] - cz
            xx, yy, zz = xx + m[k] * x * x, yy + m[k] * y * y, zz + m[k] * z * z
            xy, yz, zx = xy + m[k] * x * y, yz + m[k] * y * z, zx + m[k] * z * x
        turned, determinant, half = spin((xx, yy, zz, xy, yz, zx), (tx, ty, tz))
        if determinant <= LINE * half**3:
            turned, determinant = (tx, ty, tz), half
        for k in members:
            n = np.uint64(part[k])
            force = cross(turned, (q[0, n] - cx, q[1, n] - cy, q[2, n] - cz))
            for axis in range(3):
                F[axis, n] += m[k] / determinant * force[axis]


def place(start, stop, first, q, A, sites, atoms, positions):
    """Positions of the atoms of bodies; returns how many bodies have one that is not finite.

    Args:
        start, stop: range of the bodies.
        first: number of the body that the first row of `atoms` belongs to: the species' first.
        q, A: (3, n) and (3, 3, n).
        sites: (3, k).
        atoms: (m, k).
        positions: (N, 3), written.
    """
    broken = 0
    offset = np.uint64(first)
    for n in span(start, stop):
        total = 0.0
        for j in range(atoms.shape[1]):
            site = (sites[0, j], sites[1, j], sites[2, j])
            atom = np.uint64(atoms[n - offset, j])
            for x in range(3):
                positions[atom, x] = q[x, n] + combine(site, A[0, x, n], A[1, x, n], A[2, x, n])
                total += abs(positions[atom, x])
        broken += not total < np.inf
    return broken


def move(start, stop, first, p, A, L, inverse_masses, inverse_moments, sites, atoms, velocities):
    """Velocities (N, 3) of the atoms of bodies, written.

    p and L are (3, n), the inverse masses (n,) and the inverse moments (3, n), the rest as for `place`.
    """
    offset = np.uint64(first)
    for n in span(start, stop):
        spin = (L[0, n], L[1, n], L[2, n])
        along = (
            inverse_moments[0, n] * combine(spin, A[0, 0, n], A[0, 1, n], A[0, 2, n]),
            inverse_moments[1, n] * combine(spin, A[1, 0, n], A[1, 1, n], A[1, 2, n]),
            inverse_moments[2, n] * combine(spin, A[2, 0, n], A[2, 1, n], A[2, 2, n]),
        )
        turn = (
            combine(along, A[0, 0, n], A[1, 0, n], A[2, 0, n]),
            combine(along, A[0, 1, n], A[1, 1, n], A[2, 1, n]),
            combine(along, A[0, 2, n], A[1, 2, n], A[2, 2, n]),
        )
        for j in range(atoms.shape[1]):
            site = (sites[0, j], sites[1, j], sites[2, j])
            x = combine(site, A[0, 0, n], A[1, 0, n], A[2, 0, n])
            y = combine(site, A[0, 1, n], A[1, 1, n], A[2, 1, n])
            z = combine(site, A[0, 2, n], A[1, 2, n], A[2, 2, n])
            swing = cross(turn, (x, y, z))
            for axis in range(3):
                velocities[np.uint64(atoms[n - offset, j]), axis] = inverse_masses[n] * p[axis, n] + swing[axis]


def collect(start, stop, first, vectors, A, sites, weights, atoms, total, moment):
    """Sums over the atoms of bodies of weighted vectors (N, 3) and of their moments, (3, n) each, written.

    The rest as for `place`. Returns how many bodies have a sum that is not finite.
    """
    broken = 0
    offset = np.uint64(first)
    for n in span(start, stop):
        fx = fy = fz = tx = ty = tz = 0.0
        for j in range(atoms.shape[1]):
            site = (sites[0, j], sites[1, j], sites[2, j])
            x = combine(site, A[0, 0, n], A[1, 0, n], A[2, 0, n])
            y = combine(site, A[0, 1, n], A[1, 1, n], A[2, 1, n])
            z = combine(site, A[0, 2, n], A[1, 2, n], A[2, 2, n])
            atom = np.uint64(atoms[n - offset, j])
            f = (weights[j] * vectors[atom, 0], weights[j] * vectors[atom, 1], weights[j] * vectors[atom, 2])
            turn = cross((x, y, z), f)
            fx, fy, fz = fx + f[0], fy + f[1], fz + f[2]
            tx, ty, tz = tx + turn[0], ty + turn[1], tz + turn[2]
        total[0, n], total[1, n], total[2, n] = fx, fy, fz
        moment[0, n], moment[1, n], moment[2, n] = tx, ty, tz
        broken += not abs(fx) + abs(fy) + abs(fz) + abs(tx) + abs(ty) + abs(tz) < np.inf
    return broken
