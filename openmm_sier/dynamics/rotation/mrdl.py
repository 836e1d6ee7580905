"""The free-rotation map MRDL, to which van Zon and Schofield (2007) compare theirs."""

import numpy as np

from openmm_sier.dynamics.rotation.axes import checked
from openmm_sier.dynamics.rotation.exact import exact
from openmm_sier.dynamics.vectors import body_frame

#: The factors, as principal axis (0 has the smallest moment, 2 the largest) and fraction of the step.
FACTORS = ((0, 0.5), (1, 0.5), (2, 1.0), (1, 0.5), (0, 0.5))


def mrdl(A: np.ndarray, L: np.ndarray, moments: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotate freely by the splitting of McLachlan, Reich, Dullweber and Leimkuhler: second order, symplectic, L exact.

    The kinetic energy is split into the parts of the principal axes; each part turns the body about its axis by the
    angle h L~_k / I_k. The order of the factors makes a difference: here the axis of the smallest moment is outermost
    and that of the largest in the middle, which is the order whose errors are nearest to those in the paper.

    Arguments, result and errors are those of `exact`. Linear bodies have only one moment and nothing to split: they
    turn exactly, and so do bodies at rest and points.

    Source: A. Dullweber, B. Leimkuhler and R. McLachlan, J. Chem. Phys. 107, 5840 (1997); S. Reich, Fields Inst.
    Commun. 10, 181 (1996).

    >>> A, L = np.eye(3)[:, :, None], np.array([[0.3], [0.2], [0.1]])
    >>> errors = [abs(mrdl(A, L, (1, 2, 2.5), h)[0] - exact(A, L, (1, 2, 2.5), h)[0]).max() for h in (0.2, 0.1)]
    >>> round(errors[0] / errors[1])  # of one step: third order
    8
    """
    axes, A, L, h = checked(A, L, moments, h)
    rows = np.array(axes.sort(A))
    body_L = body_frame(rows, L)
    for axis, fraction in FACTORS:
        _turn_about_axis(axis, fraction * h * axes.rates[axis] * body_L[axis], rows, body_L)
    new = axes.unsort(rows)
    moments = np.reshape(np.asarray(moments, dtype=float), (3, -1))
    linear = (moments == 0).any(axis=0) & (moments > 0).any(axis=0)
    if linear.any():
        moments, linear = np.broadcast_to(moments, L.shape), np.broadcast_to(linear, A.shape[2:])
        new[:, :, linear], _ = exact(A[:, :, linear], L[:, linear], moments[:, linear], h)
    return new, L.copy()


def _turn_about_axis(axis: int, angle: np.ndarray, rows: np.ndarray, body_L: np.ndarray) -> None:
    """Turn bodies about a principal axis, in place: the other two axes in the lab, and L~, since L is constant."""
    j, k = (axis + 1) % 3, (axis + 2) % 3
    c, s = np.cos(angle), np.sin(angle)
    for v in (rows, body_L):
        vj = c * v[j] + s * v[k]
        v[k] = c * v[k] - s * v[j]
        v[j] = vj
