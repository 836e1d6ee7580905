"""Distances of phase points of rigid bodies, and a test whether a map is symplectic."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from openmm_sier import BodyState
from tests.support.oracles import skew


def distance(one, other):
    """Largest difference of two states, each quantity in its own scale."""
    parts = (("q", 0.1), ("p", 10.0), ("A", 1.0), ("L", 0.3))
    return max(np.abs(getattr(one, name) - getattr(other, name)).max() / scale for name, scale in parts)


def reversed_momenta(state):
    return replace(state, p=-state.p, L=-state.L)


# Tangent vectors (dq, dp, dphi, dL) of one body, with dphi the turn in the lab frame: A exp([dphi])^T. The canonical
# one-form is p.dq + L.dphi. Turns do not commute: d(dphi)(1, 2) = dphi_1 x dphi_2, and so minus its derivative is
#     dq_1.dp_2 - dp_1.dq_2 + dphi_1.dL_2 - dL_1.dphi_2 - L.(dphi_1 x dphi_2).

#: Units of dq, dp, dphi and dL in which one unit is a large change of a water molecule.
UNITS = np.repeat([0.05, 20.0, 0.5, 2.0], 3)


def symplectic_form(state):
    """Matrix of the form in the tangent coordinates of all bodies, in `UNITS`."""
    n = state.q.shape[1]
    form = np.zeros((12 * n, 12 * n))
    for i in range(n):
        block = np.zeros((12, 12))
        block[0:3, 3:6] = block[6:9, 9:12] = np.eye(3)
        block[3:6, 0:3] = block[9:12, 6:9] = -np.eye(3)
        # L.(a x b) = a.(b x L) = -a.[L] b
        block[6:9, 6:9] = skew(state.L[:, i])
        form[12 * i : 12 * i + 12, 12 * i : 12 * i + 12] = block * np.outer(UNITS, UNITS)
    return form


def displaced(state, tangent):
    d = (tangent.reshape(-1, 12) * UNITS).T
    A = np.stack([state.A[:, :, i] @ Rotation.from_rotvec(d[6:9, i]).as_matrix().T for i in range(d.shape[1])], axis=2)
    return BodyState(state.q + d[:3], state.p + d[3:6], A, state.L + d[9:])


def tangent_between(base, other):
    turns = np.einsum("abn,acn->nbc", other.A, base.A)  # R' R^T with R = A^T
    d = [other.q - base.q, other.p - base.p, Rotation.from_matrix(turns).as_rotvec().T, other.L - base.L]
    return (np.concatenate(d).T / UNITS).ravel()


def jacobian(flow, state, width=2e-3):
    """Derivative of a flow in tangent coordinates, by central differences of fourth order."""
    base, columns = flow(state), []
    for direction in np.eye(12 * state.q.shape[1]):
        one, two = (
            tangent_between(base, flow(displaced(state, size * direction)))
            - tangent_between(base, flow(displaced(state, -size * direction)))
            for size in (width, 2 * width)
        )
        columns.append((8 * one - two) / (12 * width))
    return np.array(columns).T


def symplectic_defect(flow, state):
    J = jacobian(flow, state)
    return np.abs(J.T @ symplectic_form(flow(state)) @ J - symplectic_form(state)).max()
