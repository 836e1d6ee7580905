"""Kernels between bodies and their atoms, called as those of `bodies`."""

import numpy as np

from openmm_sier.dynamics.kernels.compilation import called, kernel
from openmm_sier.dynamics.kernels.formulas import combine, cross, plus
from openmm_sier.dynamics.threads import shared


@called
def columns_of(A, n):
    """Return the columns of the attitude matrix of a body, which are read once for all of its sites."""
    return (
        (A[0, 0, n], A[1, 0, n], A[2, 0, n]),
        (A[0, 1, n], A[1, 1, n], A[2, 1, n]),
        (A[0, 2, n], A[1, 2, n], A[2, 2, n]),
    )


@called
def lab_frame(vector, columns):
    """Return a vector of the principal frame in the lab frame."""
    x, y, z = columns
    return combine(vector, x[0], x[1], x[2]), combine(vector, y[0], y[1], y[2]), combine(vector, z[0], z[1], z[2])


@called
def arm_of(places, site, columns):
    """Return the place of a site relative to the centre of its body, in the lab frame."""
    return lab_frame((places[0, site], places[1, site], places[2, site]), columns)


@called
def set_of(sets, row):
    """Return a row of the table `Sites.sets` in unsigned numbers, which Numba does not check for negative indices."""
    first, end, size = np.uint64(sets[row, 0]), np.uint64(sets[row, 1]), np.uint64(sets[row, 2])
    return first, end, size, np.uint64(sets[row, 3]), np.uint64(sets[row, 4])


@shared
@kernel
def place(start, stop, q, A, sets, bodies, places, atoms, positions):
    """Write the positions of the atoms of bodies; return the number of bodies with one that is not finite.

    Args:
        start, stop: range of `bodies`.
        q, A: centres and attitudes.
        sets, bodies, places, atoms: of `Sites`.
        positions: of all particles, (N, 3), written.
    """
    broken = 0
    for row in range(len(sets)):
        first, end, size, site, entry = set_of(sets, row)
        for i in range(max(first, np.uint64(start)), min(end, np.uint64(stop))):
            n = np.uint64(bodies[i])
            columns, centre, total = columns_of(A, n), (q[0, n], q[1, n], q[2, n]), 0.0
            offset = entry + (i - first) * size
            for j in range(size):
                x, y, z = plus(centre, arm_of(places, site + j, columns))
                atom = np.uint64(atoms[offset + j])
                positions[atom, 0], positions[atom, 1], positions[atom, 2] = x, y, z
                total += abs(x) + abs(y) + abs(z)
            broken += not total < np.inf
    return broken


@shared
@kernel
def move(start, stop, p, A, L, inverse_masses, inverse_moments, sets, bodies, places, atoms, velocities):
    """Write the velocities (N, 3) of the atoms of bodies with momenta and angular momenta; see `place`."""
    for row in range(len(sets)):
        first, end, size, site, entry = set_of(sets, row)
        for i in range(max(first, np.uint64(start)), min(end, np.uint64(stop))):
            n = np.uint64(bodies[i])
            columns, m = columns_of(A, n), inverse_masses[n]
            x, y, z = columns
            body_omega = (
                inverse_moments[0, n] * (x[0] * L[0, n] + y[0] * L[1, n] + z[0] * L[2, n]),
                inverse_moments[1, n] * (x[1] * L[0, n] + y[1] * L[1, n] + z[1] * L[2, n]),
                inverse_moments[2, n] * (x[2] * L[0, n] + y[2] * L[1, n] + z[2] * L[2, n]),
            )
            omega, v = lab_frame(body_omega, columns), (m * p[0, n], m * p[1, n], m * p[2, n])
            offset = entry + (i - first) * size
            for j in range(size):
                velocity = plus(v, cross(omega, arm_of(places, site + j, columns)))
                atom = np.uint64(atoms[offset + j])
                velocities[atom, 0], velocities[atom, 1], velocities[atom, 2] = velocity
    return 0


@shared
@kernel
def collect(start, stop, vectors, A, sets, bodies, places, weights, atoms, total, moment):
    """Sum weighted vectors, and their moments, over the atoms of bodies; return the number of sums that are not finite.

    Args:
        start, stop: range of `bodies`.
        vectors: of all particles, (N, 3).
        A: attitudes.
        sets, bodies, places, atoms: of `Sites`.
        weights: one for each of `places`.
        total, moment: sums for each body, (3, n), written.
    """
    broken = 0
    for row in range(len(sets)):
        first, end, size, site, entry = set_of(sets, row)
        for i in range(max(first, np.uint64(start)), min(end, np.uint64(stop))):
            n = np.uint64(bodies[i])
            columns, sums, moments = columns_of(A, n), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
            offset = entry + (i - first) * size
            for j in range(size):
                atom, weight = np.uint64(atoms[offset + j]), weights[site + j]
                weighted = weight * vectors[atom, 0], weight * vectors[atom, 1], weight * vectors[atom, 2]
                sums = plus(sums, weighted)
                moments = plus(moments, cross(arm_of(places, site + j, columns), weighted))
            largest = 0.0
            for x in range(3):
                total[x, n], moment[x, n] = sums[x], moments[x]
                largest += abs(sums[x]) + abs(moments[x])
            broken += not largest < np.inf
    return broken
