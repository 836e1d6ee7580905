"""Independent solutions that the tests compare the package with; nothing here uses the package.

Attitudes, angular momenta and moments are component-first, as in the package: A (3, 3, n) with the principal axes as
rows, L (3, n) in the lab frame, moments (3, n). A zero moment is that of a line about itself and takes the line's other
moment, which no state of a line can tell; three zeros are a point, which does not turn.
"""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_ivp
from scipy.special import ellipj, ellipkinc, elliprf, elliprj
from scipy.spatial.transform import Rotation


def random_attitudes(rng, n):
    """Uniformly distributed attitude matrices, (3, 3, n)."""
    return np.ascontiguousarray(Rotation.random(n, rng=rng).as_matrix().transpose(1, 2, 0))


def matmul(P, A):
    """Products of matrices stored component-first."""
    return np.einsum("abn,bcn->acn", P, A)


def rates_of(moments):
    """Inverse moments (3, n)."""
    whole = np.where(moments > 0, moments, moments.max(axis=0))
    return np.divide(1, whole, out=np.zeros_like(whole), where=whole > 0)


def orthogonality_error(A):
    """Largest deviation of A A^T from one for each body."""
    return np.abs(matmul(A, A.transpose(1, 0, 2)) - np.eye(3)[:, :, None]).max(axis=(0, 1))


# --- ordinary differential equations ----------------------------------------------------------------------------


def rotation_by_dop853(A, L, moments, h):
    """A after the time h for one body (A (3, 3), L (3,), moments (3,)), from dA/dt = -[omega~] x A."""
    rates = rates_of(np.asarray(moments, dtype=float)[:, None])[:, 0]

    def derivative(_, rows):
        A = rows.reshape(3, 3)
        return -np.cross(rates * (A @ L), A, axisb=0, axisc=0).ravel()

    solution = solve_ivp(derivative, (0, h), A.ravel(), method="DOP853", rtol=1e-13, atol=1e-15)
    return solution.y[:, -1].reshape(3, 3)


def rotation_by_taylor(A, L, moments, h, dtype=np.longdouble, order=16, reach=0.2):
    """(A, L~) after the time h, from the Taylor series of Euler's equations and of the rotation's quaternion.

    It knows no elliptic function and no special case. Each body takes as many steps as keep its turn and nutation in one
    step below `reach`: the nearest pole of L~(t) lies at a nutation phase of pi/2 or more, so that a
    step of 0.2 and order 16 truncates at 0.127^17 = 6e-16.
    """
    A, L, moments = (np.asarray(v, dtype=dtype) for v in (A, L, moments))
    rates, body_L = rates_of(moments), np.einsum("abn,bn->an", A, L)
    # A power of two, so that squares neither overflow nor vanish.
    scale = np.exp2(-np.round(np.log2(np.maximum(np.abs(body_L).max(axis=0), np.finfo(float).tiny))))
    turn = (body_L * scale) * (rates * (h / scale))  # omega~ h
    swing = turn - turn.min(axis=0) + (rates.max(axis=0) - rates.min(axis=0)) * np.abs(L * scale).max(axis=0) * abs(h / scale)
    del swing
    e = (body_L * turn * scale).sum(axis=0) * (rates.max(axis=0) * abs(h) / scale**2 * scale)
    bound = np.sqrt(np.abs(e))
    steps = np.maximum(np.ceil(np.maximum(bound, 0) / dtype(reach)), 1).astype(int)
    return steps
