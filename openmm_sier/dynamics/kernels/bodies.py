"""Kernels that move bodies and change their momenta.

Each is called as `kernel(n, ...)` for n bodies, which threads share. The function itself has in place of n a range of
the bodies, from `start` to `stop`. It writes its last arguments. Centres q, momenta p, angular momenta L, forces F and
torques are (3, n), attitudes A (3, 3, n), all contiguous: Numba would compile everything once more for another layout.
"""

import math

import numpy as np

from openmm_sier.dynamics.kernels.compilation import called, kernel
from openmm_sier.dynamics.kernels.formulas import (
    SMALL_ANGLE,
    combine,
    cross,
    decay,
    displacing_rotation,
    friction_directions,
    plus,
    rotation_matrix,
    small_sine_cosine,
)
from openmm_sier.dynamics.kernels.long_steps import long_rotation
from openmm_sier.dynamics.kernels.short_steps import free_rotation
from openmm_sier.dynamics.threads import shared

#: Number of bodies in a tile, which are rotated together, and of its rows. A smaller tile leaves instructions that
#: handle several bodies unfilled, a larger one takes longer where bodies are few.
TILE, ROWS = 32, 25


@called
def copy(target, source):
    """Write numbers to as many others."""
    for n in range(len(target)):
        target[n] = source[n]


@shared
@kernel
def rotate(start, stop, A, L, h, turning, rates, new_A):
    """Rotate bodies freely for a time h; return the number of those with an attitude or L that is not finite.

    Args:
        start, stop: range of the bodies.
        A, L: (3, 3, n) and (3, n).
        h: time.
        turning: first body and end of each run of bodies that turn, (m, 2), ascending; the others are points.
        rates: inverse moments, descending, three equal ones for lines, (3, n).
        new_A: (3, 3, n), written.
    """
    return rotate_runs(start, stop, A, L, h, turning, rates, new_A)


@called
def rotate_runs(start, stop, A, L, h, turning, rates, new_A):
    """Rotate a range of bodies; see `rotate`."""
    broken, done = 0, start
    tile = np.ones(ROWS * TILE)
    for run in range(len(turning)):
        first, end = max(start, turning[run, 0]), min(stop, turning[run, 1])
        if first < end:
            keep(done, first, A, new_A)
            broken += rotate_run(first, end, A, L, h, rates, tile, new_A)
            done = end
    keep(done, stop, A, new_A)
    return broken


@called
def keep(start, stop, A, new_A):
    """Write the attitudes of points, which do not turn; see `rotate`."""
    for i in range(3):
        for j in range(3):
            copy(new_A[i, j, start:stop], A[i, j, start:stop])


@called
def rotate_run(start, stop, A, L, h, rates, tile, new_A):
    """Rotate a range of bodies that turn; see `rotate`."""
    broken = 0
    for first in range(start, stop, TILE):
        end = min(first + TILE, stop)
        size = end - first
        for i in range(3):
            for j in range(3):
                row = (3 * i + j) * TILE
                copy(tile[row : row + size], A[i, j, first:end])
            row = (9 + i) * TILE
            copy(tile[row : row + size], L[i, first:end])
            row = (22 + i) * TILE
            copy(tile[row : row + size], rates[i, first:end])
        rotate_tile(tile, h)
        for i in range(3):
            for j in range(3):
                row = (12 + 3 * i + j) * TILE
                copy(new_A[i, j, first:end], tile[row : row + size])
        for n in range(size):
            if tile[21 * TILE + n] == 0:
                broken += rotate_long(first + n, A, L, h, rates, new_A)
    return broken


@called
def rotate_tile(tile, h):
    """Rotate a tile of bodies freely, from its rows A (9), L (3) and rates (3, the last) to others.

    These are the new A (9), and whether it is valid.

    The rows of one array have constant distances, and there is no branch or call that is not inlined. So the compiler
    sees that bodies are independent, and handles several with each instruction.
    """
    for n in range(TILE):
        x = tile[n], tile[TILE + n], tile[2 * TILE + n]
        y = tile[3 * TILE + n], tile[4 * TILE + n], tile[5 * TILE + n]
        z = tile[6 * TILE + n], tile[7 * TILE + n], tile[8 * TILE + n]
        L = tile[9 * TILE + n], tile[10 * TILE + n], tile[11 * TILE + n]
        rates = tile[22 * TILE + n], tile[23 * TILE + n], tile[24 * TILE + n]
        body_L = combine(L, x[0], x[1], x[2]), combine(L, y[0], y[1], y[2]), combine(L, z[0], z[1], z[2])
        turn, _, suffices = free_rotation(body_L, rates, h, small_sine_cosine, SMALL_ANGLE)
        rows = rotation_matrix(turn[0], turn[1], turn[2], turn[3])
        for column in range(3):
            tile[(12 + column) * TILE + n] = combine(rows[0], x[column], y[column], z[column])
            tile[(15 + column) * TILE + n] = combine(rows[1], x[column], y[column], z[column])
            tile[(18 + column) * TILE + n] = combine(rows[2], x[column], y[column], z[column])
        tile[21 * TILE + n] = suffices


@called
def rotate_long(n, A, L, h, rates, new_A):
    """Rotate a body over any time; return whether its attitude or angular momentum is not finite."""
    x, y, z = rows_of(A, n)
    momentum = L[0, n], L[1, n], L[2, n]
    for vector in (momentum, x, y, z):
        for axis in range(3):
            if not math.isfinite(vector[axis]):
                return True
    body_L = (
        combine(momentum, x[0], x[1], x[2]),
        combine(momentum, y[0], y[1], y[2]),
        combine(momentum, z[0], z[1], z[2]),
    )
    w, i, j, k = long_rotation(body_L, (rates[0, n], rates[1, n], rates[2, n]), h)
    put_attitude(n, rotation_matrix(w, i, j, k), (x, y, z), new_A)
    return False


@called
def rows_of(A, n):
    """Return the rows of the attitude matrix of a body: its principal axes in the lab frame."""
    return (
        (A[0, 0, n], A[0, 1, n], A[0, 2, n]),
        (A[1, 0, n], A[1, 1, n], A[1, 2, n]),
        (A[2, 0, n], A[2, 1, n], A[2, 2, n]),
    )


@called
def put_attitude(n, turn, rows, new_A):
    """Write the attitude of a body after a rotation in its frame."""
    x, y, z = rows
    for axis in range(3):
        new_A[0, axis, n] = combine(turn[0], x[axis], y[axis], z[axis])
        new_A[1, axis, n] = combine(turn[1], x[axis], y[axis], z[axis])
        new_A[2, axis, n] = combine(turn[2], x[axis], y[axis], z[axis])


@called
def advance(start, stop, q, p, h, inverse_masses, new_q):
    """Move the centres of a range of bodies for a time h."""
    for x in range(3):
        for n in range(np.uint64(start), np.uint64(stop)):
            new_q[x, n] = q[x, n] + (h * inverse_masses[n]) * p[x, n]
    return 0


@shared
@kernel
def drift(start, stop, q, p, A, L, h, turning, rates, inverse_masses, new_q, new_A):
    """Move centres and `rotate` in one call, since a call costs more than a few bodies."""
    advance(start, stop, q, p, h, inverse_masses, new_q)
    return rotate_runs(start, stop, A, L, h, turning, rates, new_A)


@shared
@kernel
def kick(start, stop, p, L, F, torque, h, q, at, new_p, new_L):
    """Change momenta by forces at points and by torques about these, which act for a time h.

    Args:
        start, stop: range of the bodies.
        p, L, F, torque: (3, n).
        h: time.
        q: centres of the bodies, (3, n), about which angular momenta are.
        at: the points, (3, n); q itself for forces at the centres.
        new_p, new_L: written.
    """
    for n in range(np.uint64(start), np.uint64(stop)):
        force = F[0, n], F[1, n], F[2, n]
        lever = cross((at[0, n] - q[0, n], at[1, n] - q[1, n], at[2, n] - q[2, n]), force)
        for x in range(3):
            new_p[x, n] = p[x, n] + h * force[x]
            new_L[x, n] = L[x, n] + h * (torque[x, n] + lever[x])
    return 0


@shared
@kernel
def hold(start, stop, columns, translates, turns, A, p, L):
    """Remove the parts of momenta and angular momenta along which bodies do not move.

    Args:
        start, stop: range of `columns`.
        columns: the bodies, (k,).
        translates: whether each of all bodies moves along x, y and z, (3, n).
        turns: whether each turns about its principal axes, (3, n).
        A: attitudes, (3, 3, n).
        p, L: of all bodies, (3, n), changed.
    """
    for k in range(np.uint64(start), np.uint64(stop)):
        n = np.uint64(columns[k])
        axes, moment = rows_of(A, n), (L[0, n], L[1, n], L[2, n])
        kept = (0.0, 0.0, 0.0)
        for i in range(3):
            if turns[i, n]:
                x, y, z = axes[i]
                about = combine(moment, x, y, z)
                kept = plus(kept, (about * x, about * y, about * z))
        for x in range(3):
            L[x, n] = kept[x]
            if not translates[x, n]:
                p[x, n] = 0.0
    return 0


@shared
@kernel
def bathe(
    start,
    stop,
    p,
    A,
    L,
    damping,
    rotational_damping,
    widths,
    noise,
    inverse_masses,
    inverse_moments,
    new_p,
    new_L,
):
    """Let a heat bath act on momenta, and on angular momenta in the principal frames; return the energy gained.

    Args:
        start, stop: range of the bodies.
        p, A, L: momenta, attitudes and angular momenta.
        damping, rotational_damping: factors of momenta and of angular momenta.
        widths: standard deviations of the noise of momenta, and of angular momenta in the principal frames, (6, n).
        noise: standard normal numbers, (6, n).
        inverse_masses: (n,).
        inverse_moments: (3, n).
        new_p, new_L: written.
    """
    gain = 0.0
    for n in range(np.uint64(start), np.uint64(stop)):
        energy = 0.0
        for x in range(3):
            new_p[x, n] = damping * p[x, n] + widths[x, n] * noise[x, n]
            energy += new_p[x, n] * new_p[x, n] - p[x, n] * p[x, n]
            new_L[x, n] = rotational_damping * L[x, n]
        energy *= inverse_masses[n]
        for i in range(3):
            along = A[i, 0, n] * L[0, n] + A[i, 1, n] * L[1, n] + A[i, 2, n] * L[2, n]
            twist = widths[3 + i, n] * noise[3 + i, n]
            new_along = rotational_damping * along + twist
            energy += (new_along * new_along - along * along) * inverse_moments[i, n]
            for x in range(3):
                new_L[x, n] += twist * A[i, x, n]
        gain += 0.5 * energy
    return gain


@shared
@kernel
def bathe_by_axes(
    start,
    stop,
    p,
    A,
    L,
    h,
    frictions,
    spreads,
    moves,
    noise,
    inverse_masses,
    inverse_moments,
    new_p,
    new_L,
):
    """Let a heat bath act that has a friction of each axis of each body; return the energy gained.

    Args:
        start, stop: range of the bodies.
        p, A, L: momenta, attitudes and angular momenta.
        h: time, not negative.
        frictions: of translation along the principal axes, and of rotation about them, (6, n).
        spreads: thermal standard deviations of a component of momenta, and of angular momenta about the principal
            axes, (4, n).
        moves: whether each body moves along x, y and z, (3, n).
        noise: standard normal numbers, (6, n).
        inverse_masses: (n,).
        inverse_moments: (3, n).
        new_p, new_L: written.
    """
    gain = 0.0
    for n in range(np.uint64(start), np.uint64(stop)):
        axes = rows_of(A, n)
        along_axes = frictions[0, n], frictions[1, n], frictions[2, n]
        directions, rates = friction_directions(axes, along_axes, (moves[0, n], moves[1, n], moves[2, n]))
        momentum, moment = (p[0, n], p[1, n], p[2, n]), (L[0, n], L[1, n], L[2, n])
        sum_p, sum_L = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        energy = 0.0
        for i in range(3):
            direction = directions[i]
            along = combine(momentum, direction[0], direction[1], direction[2])
            kept, width = decay(rates[i], h)
            new_along = kept * along + width * spreads[0, n] * noise[i, n]
            energy += (new_along * new_along - along * along) * inverse_masses[n]
            sum_p = plus(sum_p, (new_along * direction[0], new_along * direction[1], new_along * direction[2]))
            axis = axes[i]
            about = combine(moment, axis[0], axis[1], axis[2])
            kept, width = decay(frictions[3 + i, n], h)
            new_about = kept * about + width * spreads[1 + i, n] * noise[3 + i, n]
            energy += (new_about * new_about - about * about) * inverse_moments[i, n]
            sum_L = plus(sum_L, (new_about * axis[0], new_about * axis[1], new_about * axis[2]))
        for x in range(3):
            new_p[x, n], new_L[x, n] = sum_p[x], sum_L[x]
        gain += 0.5 * energy
    return gain


@shared
@kernel
def displace(start, stop, q, A, F, torque, shift, inverse_masses, inverse_moments, new_q, new_A):
    """Displace bodies by `shift` times their accelerations.

    Args:
        start, stop: range of the bodies.
        q, A, F, torque: centres, attitudes, forces and torques.
        shift: half the square of a time.
        inverse_masses: (n,).
        inverse_moments: (3, n).
        new_q, new_A: written.
    """
    for n in range(np.uint64(start), np.uint64(stop)):
        x, y, z = rows_of(A, n)
        torque_on_body = torque[0, n], torque[1, n], torque[2, n]
        inverses = inverse_moments[0, n], inverse_moments[1, n], inverse_moments[2, n]
        for axis in range(3):
            new_q[axis, n] = q[axis, n] + (shift * inverse_masses[n]) * F[axis, n]
        put_attitude(n, displacing_rotation(x, y, z, torque_on_body, inverses, shift), (x, y, z), new_A)
    return 0
