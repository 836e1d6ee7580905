"""Kernels: forces, torques and curvature of the potential of small liquids, and steps with a heat bath within."""

from __future__ import annotations

import math

import numba
import numpy as np

from openmm_sier.dynamics.kernels.formulas import SMALL_ANGLE, rotation_matrix, small_sine_cosine
from openmm_sier.dynamics.kernels.long_steps import long_rotation
from openmm_sier.dynamics.kernels.short_steps import free_rotation

#: Compiles a function; results need not agree to rounding between processors.
compiled = numba.njit(fastmath=True, error_model="numpy")

#: How a drift turns bodies. HALVES: exactly, half before the bath and half after it. EXACT_MEAN, RATTLE_MEAN: at once,
#: by the mean of the angular momenta before and after the bath, exactly or by a step of RATTLE. BETWEEN_MEAN: by that
#: mean too, with a part of the time by RATTLE, whose error is that of a whole step by half.
HALVES, EXACT_MEAN, RATTLE_MEAN, BETWEEN_MEAN = 0, 1, 2, 3

#: The part of the time by RATTLE, the cube root of a half: a step's error of the motion is of third order.
BETWEEN = 0.5 ** (1 / 3)

#: What `follow` samples, each a column: the potential energy V, kinetic energies, |F|^2/m and torque^2/I, the traces of
#: the Hessian of V over masses, the rates at which motion changes V; and of free rotation the error of a step of RATTLE
#: with what a bath of friction 1 makes of it.
COLUMNS = (
    "potential",
    "kinetic_translation",
    "kinetic_rotation",
    "square_translation",
    "square_rotation",
    "trace_translation",
    "trace_rotation",
    "power_translation",
    "power_rotation",
    "rattle",
    "rattle_bath",
)

#: Sites of a molecule; the compiler unrolls loops of a constant length.
SITES = 3

#: Iterations of RATTLE, and the change of Gibbs' vector that ends them.
ITERATIONS, CONVERGED = 100, 1e-14


@compiled
def switch(near, far, R):
    """Return the factor of a pair's energy at a distance of centres, and its first and second derivatives."""
    if near >= R:
        return 1.0, 0.0, 0.0
    scale = 1 / (far - near)
    t = (R - near) * scale
    value = 1 - t * t * t * (10 - 15 * t + 6 * t * t)
    return value, -30 * t * t * (1 - t) ** 2 * scale, -60 * t * (1 - t) * (1 - 2 * t) * scale * scale


@compiled
def turning_curvature(A, n, inverse_moments, arm, d, slope, bend):
    """Return the trace of the Hessian of one pair of sites over moments, for turns of the body of one of them.

    Args:
        A, n: attitudes, and the number of the body.
        inverse_moments: (3,).
        arm: place of the site from the centre.
        d: from the other site to this one.
        slope, bend: u'/r and (u'' - u'/r)/r^2 of the energy u of the pair.
    """
    trace = 0.0
    for k in range(3):
        x, y, z = A[n, k, 0], A[n, k, 1], A[n, k, 2]
        v = y * arm[2] - z * arm[1], z * arm[0] - x * arm[2], x * arm[1] - y * arm[0]
        c = y * v[2] - z * v[1], z * v[0] - x * v[2], x * v[1] - y * v[0]
        along = v[0] * d[0] + v[1] * d[1] + v[2] * d[2]
        square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
        bent = c[0] * d[0] + c[1] * d[1] + c[2] * d[2]
        trace += inverse_moments[k] * (bend * along * along + slope * (square + bent))
    return trace


@compiled
def pairs(sites, charges, repulsion, dispersion, lengths, inverse_mass, inverse_moments, q, A, arms, F, torque, traces):
    """Write forces and torques of a liquid; return the potential energy.

    All is in one function, since calls with arrays cost more than a pair does.

    Args:
        sites, charges, repulsion, dispersion: of Liquid.
        lengths: its box, near and far.
        inverse_mass, inverse_moments: of a molecule.
        q, A: centres and attitudes.
        arms: (n, SITES, 3), written: places of sites from centres.
        F, torque: (n, 3), written.
        traces: (2,), written: traces of the Hessian over mass and moments; none are computed for (0,).
    """
    n = q.shape[0]
    box, near, far = lengths
    for i in range(n):
        for s in range(SITES):
            for x in range(3):
                arms[i, s, x] = sites[s, 0] * A[i, 0, x] + sites[s, 1] * A[i, 1, x] + sites[s, 2] * A[i, 2, x]
    F[:] = 0.0
    torque[:] = 0.0
    V, straight, turning = 0.0, 0.0, 0.0
    for i in range(n):
        for j in range(i):
            X, Y, Z = q[i, 0] - q[j, 0], q[i, 1] - q[j, 1], q[i, 2] - q[j, 2]
            X -= box * round(X / box)
            Y -= box * round(Y / box)
            Z -= box * round(Z / box)
            square = X * X + Y * Y + Z * Z
            if square >= far * far:
                continue
            R = math.sqrt(square)
            factor, slope, bend = switch(near, far, R)
            u, divergence = 0.0, 0.0
            fx, fy, fz = 0.0, 0.0, 0.0
            jx, jy, jz = 0.0, 0.0, 0.0
            for s in range(SITES):
                ax, ay, az = arms[i, s, 0], arms[i, s, 1], arms[i, s, 2]
                sx, sy, sz = 0.0, 0.0, 0.0
                for t in range(SITES):
                    bx, by, bz = arms[j, t, 0], arms[j, t, 1], arms[j, t, 2]
                    dx, dy, dz = X + ax - bx, Y + ay - by, Z + az - bz
                    inverse = 1 / (dx * dx + dy * dy + dz * dz)
                    coulomb = charges[s, t] * math.sqrt(inverse)
                    repelled, attracted = 0.0, 0.0
                    if s == 0 and t == 0:
                        sixth = inverse * inverse * inverse
                        repelled = repulsion * sixth * sixth
                        attracted = dispersion * sixth
                    u += coulomb + repelled - attracted
                    push = (coulomb + 12 * repelled - 6 * attracted) * inverse
                    px, py, pz = push * dx, push * dy, push * dz
                    sx += px
                    sy += py
                    sz += pz
                    jx -= by * pz - bz * py
                    jy -= bz * px - bx * pz
                    jz -= bx * py - by * px
                    if len(traces):
                        curved = (3 * coulomb + 168 * repelled - 48 * attracted) * inverse * inverse
                        divergence += curved / inverse - 3 * push
                        d, back = (dx, dy, dz), (-dx, -dy, -dz)
                        trace = turning_curvature(A, i, inverse_moments, (ax, ay, az), d, -push, curved)
                        trace += turning_curvature(A, j, inverse_moments, (bx, by, bz), back, -push, curved)
                        turning += factor * trace
                fx += sx
                fy += sy
                fz += sz
                torque[i, 0] += factor * (ay * sz - az * sy)
                torque[i, 1] += factor * (az * sx - ax * sz)
                torque[i, 2] += factor * (ax * sy - ay * sx)
            torque[j, 0] += factor * jx
            torque[j, 1] += factor * jy
            torque[j, 2] += factor * jz
            V += factor * u
            along = (X * fx + Y * fy + Z * fz) / R
            straight += 2 * inverse_mass * (factor * divergence - 2 * slope * along + u * (bend + 2 * slope / R))
            inward = slope * u / R
            fx, fy, fz = factor * fx - inward * X, factor * fy - inward * Y, factor * fz - inward * Z
            F[i, 0] += fx
            F[i, 1] += fy
            F[i, 2] += fz
            F[j, 0] -= fx
            F[j, 1] -= fy
            F[j, 2] -= fz
    if len(traces):
        traces[0], traces[1] = straight, turning
    return V


@compiled
def field(c, rates, A, F, torque, traces):
    """Do what `pairs` does, for bodies each alone in the field V = -c tr A."""
    F[:] = 0.0
    traces[:] = 0.0
    V = 0.0
    for n in range(A.shape[0]):
        V -= c * (A[n, 0, 0] + A[n, 1, 1] + A[n, 2, 2])
        for x in range(3):
            y, z = (x + 1) % 3, (x + 2) % 3
            torque[n, x] = c * (A[n, z, y] - A[n, y, z])
            if len(traces):
                traces[1] += c * rates[x] * (A[n, y, y] + A[n, z, z])
    return V


@compiled
def potential(liquid, bodies, arms, F, torque, traces):
    """Write forces and torques, see `pairs`; return the potential energy."""
    if liquid.field > 0:
        return field(liquid.field, liquid.inverse_moments, bodies.A, F, torque, traces)
    interactions = liquid.sites, liquid.charges, liquid.repulsion, liquid.dispersion
    lengths, inverses = (liquid.box, liquid.near, liquid.far), (1 / liquid.mass, liquid.inverse_moments)
    return pairs(*interactions, lengths, *inverses, bodies.q, bodies.A, arms, F, torque, traces)


@compiled
def in_body(A, vector, n):
    """Return a vector (n, 3) of one body in its principal axes."""
    x, y, z = vector[n, 0], vector[n, 1], vector[n, 2]
    return (
        A[n, 0, 0] * x + A[n, 0, 1] * y + A[n, 0, 2] * z,
        A[n, 1, 0] * x + A[n, 1, 1] * y + A[n, 1, 2] * z,
        A[n, 2, 0] * x + A[n, 2, 1] * y + A[n, 2, 2] * z,
    )


@compiled
def turn(A, n, rows):
    """Turn the attitude of one body by a rotation in its frame."""
    for x in range(3):
        a, b, c = A[n, 0, x], A[n, 1, x], A[n, 2, x]
        for k in range(3):
            A[n, k, x] = rows[k][0] * a + rows[k][1] * b + rows[k][2] * c


@compiled
def turn_exactly(A, L, n, rates, h):
    """Turn one body freely for a time; L is its angular momentum in principal axes."""
    if L[0] * L[0] + L[1] * L[1] + L[2] * L[2] == 0:
        return
    turned, _, reached = free_rotation(L, rates, h, small_sine_cosine, SMALL_ANGLE)
    if not reached:
        turned = long_rotation(L, rates, h)
    turn(A, n, rotation_matrix(turned[0], turned[1], turned[2], turned[3]))


@compiled
def turn_by_rattle(A, L, n, I, rates, h):
    """Turn one body by a step of RATTLE, see `openmm_sier.dynamics.rotation.rattle`; L is as of `turn_exactly`."""
    a, b, c = 0.5 * h * L[0], 0.5 * h * L[1], 0.5 * h * L[2]
    x, y, z = rates[0] * a, rates[1] * b, rates[2] * c
    for _ in range(ITERATIONS):
        u, v, w = x, y, z
        scale = 1 + u * u + v * v + w * w
        x = rates[0] * (a * scale - (I[2] - I[1]) * v * w)
        y = rates[1] * (b * scale - (I[0] - I[2]) * w * u)
        z = rates[2] * (c * scale - (I[1] - I[0]) * u * v)
        if abs(x - u) + abs(y - v) + abs(z - w) < CONVERGED:
            break
    turn(A, n, rotation_matrix(1.0, -x, -y, -z))


@compiled
def bathe(p, L, A, n, kept, widths):
    """Let the bath act on one body.

    Args:
        p, L, A: of Bodies.
        n: number of the body.
        kept: factors of momentum and angular momentum.
        widths: standard deviations of what angular momentum gains along principal axes, and momentum, (4,).
    """
    for x in range(3):
        p[n, x] = kept[0] * p[n, x] + widths[3] * np.random.normal()  # noqa: NPY002
        L[n, x] *= kept[1]
    for k in range(3):
        gained = widths[k] * np.random.normal()  # noqa: NPY002
        for x in range(3):
            L[n, x] += gained * A[n, k, x]


@compiled
def turn_around_bath(p, L, A, n, I, inverse_moments, h, kept, widths, rotation):
    """Turn one body freely for a time, with the bath in the middle."""
    if rotation == HALVES:
        turn_exactly(A, in_body(A, L, n), n, inverse_moments, 0.5 * h)
        bathe(p, L, A, n, kept, widths)
        turn_exactly(A, in_body(A, L, n), n, inverse_moments, 0.5 * h)
        return
    x, y, z = L[n, 0], L[n, 1], L[n, 2]
    bathe(p, L, A, n, kept, widths)
    u, v, w = L[n, 0], L[n, 1], L[n, 2]
    L[n, 0], L[n, 1], L[n, 2] = 0.5 * (x + u), 0.5 * (y + v), 0.5 * (z + w)
    if rotation == EXACT_MEAN:
        turn_exactly(A, in_body(A, L, n), n, inverse_moments, h)
    elif rotation == RATTLE_MEAN:
        turn_by_rattle(A, in_body(A, L, n), n, I, inverse_moments, h)
    else:
        rest = 0.5 * (1 - BETWEEN) * h
        turn_exactly(A, in_body(A, L, n), n, inverse_moments, rest)
        turn_by_rattle(A, in_body(A, L, n), n, I, inverse_moments, BETWEEN * h)
        turn_exactly(A, in_body(A, L, n), n, inverse_moments, rest)
    L[n, 0], L[n, 1], L[n, 2] = u, v, w


@compiled
def rattle_energy(L, rates):
    """Return the error of the energy that a step h of RATTLE conserves in free rotation, over h^2, and its change.

    It is (|w|^2 w.L - (L x w) I^-1 (L x w)) / 24 with w = I^-1 L, a quartic in L. The change is the rate at which a
    bath of friction 1 changes it, over kT and per kT: the two parts of -4 E + kT sum_k I_k d^2 E / dL_k^2.

    Args:
        L: angular momentum in principal axes.
        rates: inverse moments.
    """
    energy, second = 0.0, 0.0
    for j in range(3):
        y = L[j] * L[j]
        k, l = (j + 1) % 3, (j + 2) % 3
        energy += y * y * rates[j] ** 3
        second += 12 * y * rates[j] ** 2
        # The pair of axes k and l: both orders of |w|^2 w.L, less the gyroscopic term about the axis j.
        a, b = L[k] * L[k], L[l] * L[l]
        factor = rates[k] * rates[l] * (rates[k] + rates[l]) - rates[j] * (rates[l] - rates[k]) ** 2
        energy += factor * a * b
        second += 2 * factor * (b / rates[k] + a / rates[l])
    return energy / 24, second / 24


@compiled
def sample(liquid, bodies, F, torque, V, traces, h, row):
    """Write what is sampled at the end of a step, see `COLUMNS`; momenta there lag half a kick behind."""
    row[:] = 0.0
    row[0] = V
    rates = liquid.inverse_moments
    for n in range(bodies.q.shape[0]):
        L, push = in_body(bodies.A, bodies.L, n), in_body(bodies.A, torque, n)
        for x in range(3):
            p = bodies.p[n, x]
            row[1] += 0.5 * p * p / liquid.mass
            row[2] += 0.5 * L[x] * L[x] * rates[x]
            row[3] += F[n, x] * F[n, x] / liquid.mass
            row[4] += push[x] * push[x] * rates[x]
            row[7] -= F[n, x] * (p + 0.5 * h * F[n, x]) / liquid.mass
            row[8] -= push[x] * (L[x] + 0.5 * h * push[x]) * rates[x]
        energy, second = rattle_energy(L, rates)
        row[9] += energy
        row[10] += liquid.thermal * second - 4 * energy
    if len(traces):
        row[5] = traces[0]
        row[6] = traces[1]


@compiled
def follow(seed, liquid, bodies, h, steps, every, friction, turning_friction, rotation, has_traces, rows):
    """Make steps, each a kick, and a drift with the bath in its middle.

    Args:
        seed: of the noise.
        liquid, bodies: Liquid and Bodies, which move.
        h: step, ps.
        steps: their number, a multiple of `every`.
        every: steps between two samples.
        friction, turning_friction: of translation and rotation, 1/ps.
        rotation: HALVES, EXACT_MEAN, RATTLE_MEAN or BETWEEN_MEAN.
        has_traces: whether traces of the Hessian are sampled.
        rows: samples, (steps / every, columns), written.
    """
    # Within compiled code this generator is Numba's.
    np.random.seed(seed)  # noqa: NPY002
    n = bodies.q.shape[0]
    arms = np.empty((n, SITES, 3))
    F, torque = np.empty((n, 3)), np.empty((n, 3))
    traces, none = np.empty(2), np.empty(0)
    kept = math.exp(-friction * h), math.exp(-turning_friction * h)
    widths = np.empty(4)
    widths[:3] = np.sqrt((1 - kept[1] ** 2) * liquid.thermal * liquid.moments)
    widths[3] = math.sqrt((1 - kept[0] ** 2) * liquid.thermal * liquid.mass)
    q, p, A, L = bodies.q, bodies.p, bodies.A, bodies.L
    I, inverse_moments = liquid.moments, liquid.inverse_moments
    half = 0.5 * h / liquid.mass
    potential(liquid, bodies, arms, F, torque, none)
    for step in range(steps):
        for i in range(n):
            for x in range(3):
                p[i, x] += h * F[i, x]
                L[i, x] += h * torque[i, x]
                q[i, x] += half * p[i, x]
            turn_around_bath(p, L, A, i, I, inverse_moments, h, kept, widths, rotation)
            for x in range(3):
                q[i, x] += half * p[i, x]
        is_sampled = (step + 1) % every == 0
        wanted = traces if is_sampled and has_traces else none
        V = potential(liquid, bodies, arms, F, torque, wanted)
        if is_sampled:
            sample(liquid, bodies, F, torque, V, wanted, h, rows[step // every])
