"""The free rotation of constrained velocity Verlet: one step of RATTLE."""

import numpy as np

from openmm_sier.dynamics.constraints import ConstraintError
from openmm_sier.dynamics.rotation.axes import checked
from openmm_sier.dynamics.vectors import body_frame, rotation_matrix, turned

#: Largest number of iterations, and the change, relative to the largest component, below which they have converged.
#: Each iteration multiplies the error by about half the angle of the step, which is below 0.1 for water at 2 fs.
ITERATIONS, ROUNDING = 200, 4e-16


def rattle(A: np.ndarray, L: np.ndarray, moments: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotate freely by one step of RATTLE, solved to rounding: second order, symplectic, L exact.

    Kicks and this map make up constrained velocity Verlet, as SETTLE or RATTLE perform it on all atoms of a rigid
    molecule: `SIERIntegrator(h, SIER2, rotation=rattle)`. RATTLE's constraints on a rigid body are those of the
    discrete Moser-Veselov equations, h L~ = axial(Q J - J Q^T), in which Q is the rotation of the step and J the matrix
    of second moments. With Gibbs' vector g of Q, whose length is the tangent of half the angle, they are

        I g + g x I g = (h/2) (1 + g^2) L~.

    Arguments, result and errors are those of `exact`. Linear bodies and points are allowed.

    Source: R. I. McLachlan and A. Zanna, Found. Comput. Math. 5, 87 (2005).

    Raises:
        ConstraintError: the step is too long for the equations to be solved.

    >>> A, L = np.eye(3)[:, :, None], np.array([[0.3], [0.2], [0.1]])
    >>> there, _ = rattle(A, L, (1, 2, 2.5), 0.1)
    >>> back, _ = rattle(there, L, (1, 2, 2.5), -0.1)
    >>> bool(abs(back - A).max() < 1e-15)
    True
    """
    _, A, L, h = checked(A, L, moments, h)
    g = _half_turn(body_frame(A, L), np.reshape(np.asarray(moments, dtype=float), (3, -1)), h)
    # The lab, seen from the body, turns back.
    return turned(rotation_matrix(1.0, *-g), A), L.copy()


def _half_turn(body_L: np.ndarray, moments: np.ndarray, h: float) -> np.ndarray:
    """Return Gibbs' vector (3, n) of the rotation of a step.

    Args:
        body_L: angular momenta in the body frame, (3, n).
        moments: principal moments, (3, n) or (3, 1); 0 about the axis of a linear body.
        h: step.
    """
    inverse = np.divide(1.0, moments, out=np.zeros_like(moments), where=moments > 0)
    half = 0.5 * h * body_L
    g = inverse * half
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(ITERATIONS):
            last, g = g, inverse * (half * (1 + (g * g).sum(axis=0)) - np.cross(g, moments * g, axis=0))
            change = np.abs(g - last).max(axis=0, initial=0.0)
            if (has_converged := change <= ROUNDING * np.abs(g).max(axis=0, initial=0.0)).all():
                return g
    # Rounding may change the last bit of a body for ever.
    if not (has_converged | (change <= 8 * ROUNDING * np.abs(g).max(axis=0))).all():
        raise ConstraintError(f"RATTLE does not converge for body {int(has_converged.argmin())} in a step of {h:g}")
    return g
