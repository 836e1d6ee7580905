"""The exact free rotation as a map."""

import numpy as np

from openmm_sier.dynamics import kernels
from openmm_sier.dynamics.indices import runs
from openmm_sier.dynamics.rotation.axes import checked, not_finite


def exact(A: np.ndarray, L: np.ndarray, moments: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotate rigid bodies freely and exactly, over a time of any length and either sign.

    Args:
        A: attitude matrices, (3, 3, n); rows are the principal axes in the lab frame.
        L: angular momenta in the lab frame, (3, n), dalton nm^2/ps.
        moments: principal moments, (3,) or (3, n), dalton nm^2, in any order. A point has three zeros, a line exactly
            one zero and two equal moments.
        h: time in ps, a float.

    Returns:
        (A, L) after the time h, new arrays; free rotation conserves L.

    Raises:
        ValueError: shapes do not fit, moments are impossible, or a value is not finite.

    Source: van Zon and Schofield (2007), Eqs. 5 (U1) and 9 (Pmatrix); see `openmm_sier.dynamics.kernels.short_steps`.

    A quarter turn about the third axis, and back:

    >>> import numpy as np
    >>> A, L = np.eye(3)[:, :, None], np.array([[0.0], [0.0], [1.0]])
    >>> there, _ = exact(A, L, (1.0, 2.0, 2.5), 2.5 * np.pi / 2)
    >>> (there[:, :, 0].round(9) + 0.0).tolist()
    [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    >>> back, _ = exact(there, L, (1.0, 2.0, 2.5), -2.5 * np.pi / 2)
    >>> bool(abs(back - A).max() < 1e-15)
    True
    """
    axes, A, L, h = checked(A, L, moments, h)
    rows = axes.sort(A)
    new, n = np.empty(A.shape), A.shape[2]
    rates = np.ascontiguousarray(np.broadcast_to(axes.rates.reshape(3, -1), (3, n)))
    broken = kernels.bodies.rotate(n, rows, L, h, runs(rates[0] > 0), rates, new)
    if broken:
        raise not_finite(A, L)
    return axes.unsort(new), L.copy()
