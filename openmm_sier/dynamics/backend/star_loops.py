"""Stars: constraint clusters of one centre bonded to k leaves, such as a carbon and its hydrogens.

A star is described by its bond vectors r_b = x_b - x_centre and their rates u_b, and by its centre of mass, which moves
freely. With B_bc = delta_bc / m_b + 1 / m_centre, forces of multipliers lambda_b along the bonds change the rates by
sum_c B_bc lambda_c r_c; rounding depends on bond lengths alone, not on where in the box the star is.

NumPy and Numba execute the same functions: they index arrays whose shapes NumPy extends by an axis of m stars. So r
and u have the shape (k, 3) or (k, 3, m), multipliers (k,) or (k, m), matrices (k, k) or (k, k, m), and what belongs
to the centre is a scalar or (m,). Two functions differ: `largest`, so that NumPy goes on until all stars have
converged, and `leaves_of`, so that Numba compiles the loops anew for each k and unrolls them.
"""

from __future__ import annotations

import numpy as np

#: Newton's iteration ends with the update that follows a relative residual below this. That update squares it, to
#: rounding.
CLOSE = 1e-7

#: More iterations than this mean that there is no solution nearby.
ITERATIONS = 30


def largest(value):
    """The largest value of all stars, NaN if one is NaN; for a single star the value itself."""
    return np.max(value)


def leaves_of(array):
    """The number of leaves, which compiled code has as a constant."""
    return array.shape[0]


def open_star(q, p, centre, leaves, light, heavy, r, u):
    """Bond vectors and their rates, written to r and u, from positions q and momenta p, (3, n).

    Args:
        centre, leaves: columns of q; leaves is (k,) or (k, m).
        light, heavy: inverse masses of leaves and centre.
    """
    for x in range(3):
        for b in range(leaves_of(r)):
            r[b, x] = q[x, leaves[b]] - q[x, centre]
            u[b, x] = p[x, leaves[b]] * light[b] - p[x, centre] * heavy


def close_positions(q, p, t, centre, leaves, light, heavy, r, new_q):
    """Positions of a star with bond vectors r whose centre of mass has moved freely from (q, p) for the time t."""
    k = leaves_of(r)
    for x in range(3):
        mass, moved = 1 / heavy, t * p[x, centre]
        for b in range(k):
            mass = mass + 1 / light[b]
            moved = moved + t * p[x, leaves[b]] + ((q[x, leaves[b]] - q[x, centre]) - r[b, x]) / light[b]
        new = q[x, centre] + moved / mass
        new_q[x, centre] = new
        for b in range(k):
            new_q[x, leaves[b]] = new + r[b, x]


def close_momenta(p, centre, leaves, light, heavy, u, new_p):
    """Momenta of a star whose bonds have the rates u and whose total momentum is that of p."""
    k = leaves_of(u)
    for x in range(3):
        mass, momentum, inner = 1 / heavy, p[x, centre], 0.0 * heavy
        for b in range(k):
            mass = mass + 1 / light[b]
            momentum = momentum + p[x, leaves[b]]
            inner = inner + u[b, x] / light[b]
        velocity = (momentum - inner) / mass
        rest = momentum
        for b in range(k):
            new = (velocity + u[b, x]) / light[b]
            rest = rest - new
            new_p[x, leaves[b]] = new
        new_p[x, centre] = rest


def accelerate(r, multipliers, light, heavy, u):
    """Add sum_c B_bc multipliers_c r_c to the rates u."""
    k = leaves_of(r)
    for x in range(3):
        common = multipliers[0] * r[0, x]
        for b in range(1, k):
            common = common + multipliers[b] * r[b, x]
        common = heavy * common
        for b in range(k):
            u[b, x] = u[b, x] + (common + light[b] * multipliers[b] * r[b, x])


def reach(r, u, d, multipliers, light, heavy, out):
    """Write r + d (u + sum_c B_bc multipliers_c r_c)."""
    k = leaves_of(r)
    for x in range(3):
        common = multipliers[0] * r[0, x]
        for b in range(1, k):
            common = common + multipliers[b] * r[b, x]
        common = heavy * common
        for b in range(k):
            out[b, x] = r[b, x] + d * (u[b, x] + common + light[b] * multipliers[b] * r[b, x])


def gram(left, right, light, heavy, matrix):
    """Write the matrix (left_b . right_c) B_bc, whose product with multipliers along `right` is seen along `left`."""
    k = leaves_of(left)
    for b in range(k):
        for c in range(k):
            dot = left[b, 0] * right[c, 0] + left[b, 1] * right[c, 1] + left[b, 2] * right[c, 2]
            if b == c:
                matrix[b, c] = dot * (heavy + light[b])
            else:
                matrix[b, c] = dot * heavy


def solve(matrix, values):
    """Solve matrix . x = values in place by elimination, the result in `values`.

    Each leaf has a bond of its own, so that the matrix is close to a positive definite one and needs no pivoting.
    """
    k = leaves_of(values)
    for b in range(k):
        for c in range(b + 1, k):
            factor = matrix[c, b] / matrix[b, b]
            for e in range(b + 1, k):
                matrix[c, e] = matrix[c, e] - factor * matrix[b, e]
            values[c] = values[c] - factor * values[b]
    for b in range(k - 1, -1, -1):
        for c in range(b + 1, k):
            values[b] = values[b] - matrix[b, c] * values[c]
        values[b] = values[b] / matrix[b, b]


def project_rates(r, light, heavy, matrix, values, u):
    """Take from the rates u what changes the lengths of the bonds r, in the metric of the masses."""
    k = leaves_of(r)
    gram(r, r, light, heavy, matrix)
    for b in range(k):
        values[b] = -(r[b, 0] * u[b, 0] + r[b, 1] * u[b, 1] + r[b, 2] * u[b, 2])
    solve(matrix, values)
    accelerate(r, values, light, heavy, u)


def centripetal(r, u, light, heavy, matrix, values):
    """Write the multipliers that keep the bond lengths in free motion to second order in time."""
    k = leaves_of(r)
    gram(r, r, light, heavy, matrix)
    for b in range(k):
        values[b] = -(u[b, 0] * u[b, 0] + u[b, 1] * u[b, 1] + u[b, 2] * u[b, 2])
    solve(matrix, values)


def constrain(r, u, d, squares, light, heavy, multipliers, matrix, values, out):
    """Newton's iteration for multipliers along r that give the bonds r + d (u + ...) their squared lengths.

    Args:
        multipliers: the first guess, replaced by the solution.
        out: the bonds reached, written.

    Returns:
        Whether it converged.
    """
    k = leaves_of(r)
    for _ in range(ITERATIONS):
        reach(r, u, d, multipliers, light, heavy, out)
        worst = 0.0 * squares[0]
        for b in range(k):
            values[b] = squares[b] - (out[b, 0] * out[b, 0] + out[b, 1] * out[b, 1] + out[b, 2] * out[b, 2])
            worst = np.maximum(worst, np.abs(values[b]) / squares[b])
        gram(out, r, light, heavy, matrix)
        solve(matrix, values)
        for b in range(k):
            multipliers[b] = multipliers[b] + values[b] / (2 * d)
        if largest(worst) < CLOSE:
            reach(r, u, d, multipliers, light, heavy, out)
            return True
    return False


def turn(r, u, t, squares):
    """Exact free motion of a star of one bond, which rotates in a plane at a constant rate; changes r and u."""
    length = np.sqrt(squares[0])
    size = np.sqrt(r[0, 0] * r[0, 0] + r[0, 1] * r[0, 1] + r[0, 2] * r[0, 2])
    rate = np.sqrt(u[0, 0] * u[0, 0] + u[0, 1] * u[0, 1] + u[0, 2] * u[0, 2]) / length
    # At rest the bond keeps its direction, whatever that of u.
    safe = np.maximum(rate, 1e-300)
    c, s = np.cos(rate * t), np.sin(rate * t)
    for x in range(3):
        along = r[0, x] * (length / size)
        across = u[0, x] / safe
        r[0, x] = along * c + across * s
        u[0, x] = u[0, x] * c - along * (rate * s)


def drift_star(q, p, times, total, star, scratch, new_q, new_p):
    """Geodesic motion of a star by RATTLE steps, or exactly where it has one bond.

    Between two steps the velocity is not projected: the multipliers of the next step remove its part along the bonds.

    Args:
        q, p: (3, n).
        times: lengths of the RATTLE steps.
        total: their sum, not 0.
        star: (centre, leaves, light, heavy, squares), see `open_star`.
        scratch: (r, u, out, multipliers, guess, values, matrix), arrays to work in.
        new_q, new_p: (3, n), of which the columns of the star are written.

    Returns:
        Whether the constraints were solved; nothing is written otherwise.
    """
    centre, leaves, light, heavy, squares = star
    r, u, out, multipliers, guess, values, matrix = scratch
    k = leaves_of(r)
    open_star(q, p, centre, leaves, light, heavy, r, u)
    if k == 1:
        project_rates(r, light, heavy, matrix, values, u)
        turn(r, u, total, squares)
    else:
        centripetal(r, u, light, heavy, matrix, guess)
        before = 0.0
        for d in times:
            # Velocities are those of the middle of the step before.
            half = 0.5 * (d + before)
            for b in range(k):
                multipliers[b] = half * guess[b]
            if not constrain(r, u, d, squares, light, heavy, multipliers, matrix, values, out):
                return False
            accelerate(r, multipliers, light, heavy, u)
            for b in range(k):
                if abs(half) > 0.05 * abs(d):
                    guess[b] = multipliers[b] / half
                for x in range(3):
                    r[b, x] = out[b, x]
            before = d
        project_rates(r, light, heavy, matrix, values, u)
    close_positions(q, p, total, centre, leaves, light, heavy, r, new_q)
    close_momenta(p, centre, leaves, light, heavy, u, new_p)
    return True


def displace_star(q, push, shift, star, scratch, new_q):
    """A star moved by shift M^-1 push and put back onto its constraints along the bonds; see `drift_star`."""
    centre, leaves, light, heavy, squares = star
    r, u, out, multipliers, _, values, matrix = scratch
    open_star(q, push, centre, leaves, light, heavy, r, u)
    for b in range(leaves_of(r)):
        multipliers[b] = 0.0 * squares[b]
        for x in range(3):
            u[b, x] = shift * u[b, x]
    if not constrain(r, u, 1.0, squares, light, heavy, multipliers, matrix, values, out):
        return False
    close_positions(q, push, shift, centre, leaves, light, heavy, out, new_q)
    return True


def project_star(q, p, star, scratch, new_p):
    """The momenta, or forces, of a star without what acts along its bonds; see `drift_star`."""
    centre, leaves, light, heavy, _ = star
    r, u, _, _, _, values, matrix = scratch
    open_star(q, p, centre, leaves, light, heavy, r, u)
    project_rates(r, light, heavy, matrix, values, u)
    close_momenta(p, centre, leaves, light, heavy, u, new_p)


def scratch_of(k):
    """Arrays to work in for one star."""
    return (
        np.empty((k, 3)),
        np.empty((k, 3)),
        np.empty((k, 3)),
        np.empty(k),
        np.empty(k),
        np.empty(k),
        np.empty((k, k)),
    )


def drift_stars(q, p, times, total, centres, leaves, light, heavy, squares, new_q, new_p):
    """`drift_star` for m stars: leaves, light and squares are (k, m). Returns the first that failed, or -1."""
    scratch = scratch_of(leaves_of(leaves))
    for n in range(len(centres)):
        star = (centres[n], leaves[:, n], light[:, n], heavy[n], squares[:, n])
        if not drift_star(q, p, times, total, star, scratch, new_q, new_p):
            return n
    return -1


def displace_stars(q, push, shift, centres, leaves, light, heavy, squares, new_q):
    """`displace_star` for m stars; returns the first that failed, or -1."""
    scratch = scratch_of(leaves_of(leaves))
    for n in range(len(centres)):
        star = (centres[n], leaves[:, n], light[:, n], heavy[n], squares[:, n])
        if not displace_star(q, push, shift, star, scratch, new_q):
            return n
    return -1


def project_stars(q, p, centres, leaves, light, heavy, squares, new_p):
    """`project_star` for m stars."""
    scratch = scratch_of(leaves_of(leaves))
    for n in range(len(centres)):
        star = (centres[n], leaves[:, n], light[:, n], heavy[n], squares[:, n])
        project_star(q, p, star, scratch, new_p)


#: The functions that are called from outside.
LOOPS = (drift_stars, displace_stars, project_stars)
