"""Exact free rotation with more digits than double precision, to measure the rounding errors of the exact propagator.

It is the closed form in the paper's notation, Eq. Pmatrix, with its fixed pole and with psi from an elliptic integral
of the third kind that is evaluated once over the whole span; nothing is shared with `rotation.exact`.
"""

from __future__ import annotations

from typing import Any

import mpmath as mp
import numpy as np

#: Decimal digits that are carried.
DIGITS = 34


def squared_deviations(A: np.ndarray, body_L: np.ndarray, moments: np.ndarray, step: float, count: int) -> np.ndarray:
    """Tr[(A - A_ex)(A - A_ex)^T]/6 for bodies that started with their axes along the lab's.

    Args:
        A: attitudes to be judged, (3, 3, n).
        body_L: angular momenta at the start, (3, n), dalton nm^2/ps, the same in both frames.
        moments: principal moments, (3,), ascending and different, dalton nm^2.
        step: ps, a float that is taken to be exact.
        count: steps taken; the time is `count` times `step`.

    Returns:
        (n,), with the rounding of the difference alone.
    """
    squares = np.empty(A.shape[2])
    with mp.workdps(DIGITS):
        time = mp.mpf(step) * count
        for body in range(A.shape[2]):
            P = attitude(body_L[:, body], moments, time)
            squares[body] = sum((mp.mpf(float(A[i, j, body])) - P[i, j]) ** 2 for i in range(3) for j in range(3)) / 6
    return squares


def attitude(body_L: Any, moments: Any, time: Any) -> Any:
    """Attitude after a time of one asymmetric body that started with A = 1, an mpmath matrix of `DIGITS` or more.

    Args:
        body_L: (3,), angular momentum at the start; the state must not be on the separatrix.
        moments: (3,), ascending, different.
        time: number, ps.

    Source: van Zon and Schofield (2007), Eqs. Pmatrix and integral.
    """
    with mp.workdps(max(DIGITS, mp.mp.dps)):
        l, I = [mp.mpf(float(x)) for x in body_L], [mp.mpf(float(x)) for x in moments]
        square = sum(x * x for x in l)
        if sum(x * x / i for x, i in zip(l, I, strict=True)) * I[1] < square:
            # The paper's U*: exchange x and z, reverse y.
            exchange = mp.matrix([[0, 0, 1], [0, -1, 0], [1, 0, 0]])
            return exchange.T * _propagator([l[2], -l[1], l[0]], I[::-1], mp.mpf(time)) * exchange
        return _propagator(l, I, mp.mpf(time))


def _propagator(l: Any, I: Any, time: Any) -> Any:
    """P(t) in a frame in which 2 E I_y > L^2: L~_x keeps its sign, L_perp never vanishes."""
    Ix, Iy, Iz = I
    square = sum(x * x for x in l)
    twice_E = sum(x * x / i for x, i in zip(l, I, strict=True))
    L = mp.sqrt(square)
    side = 1 if l[0] >= 0 else -1
    x_max = side * mp.sqrt(Ix * (square - twice_E * Iz) / (Ix - Iz))
    y_max = mp.sqrt(Iy * (square - twice_E * Ix) / (Iy - Ix))
    z_max = mp.sqrt(Iz * (square - twice_E * Ix) / (Iz - Ix))
    m = (square - twice_E * Ix) * (Iz - Iy) / ((square - twice_E * Iz) * (Ix - Iy))
    rate = side * mp.sign(1 / Ix - 1 / Iz) * mp.sqrt((square - twice_E * Iz) * (Ix - Iy) / (Ix * Iy * Iz))

    start = mp.atan2(l[1] / y_max, l[2] / z_max)
    end, sn, cn, dn = _jacobi(mp.ellipf(start, m) + rate * time, m)
    final = [x_max * dn, y_max * sn, z_max * cn]

    lean = -(z_max**2) / (square - z_max**2)
    mean_w = square / (square - z_max**2) * (mp.ellippi(lean, end, m) - mp.ellippi(lean, start, m)) / rate
    psi = L / Iz * (time + (twice_E * Iz / square - 1) * mean_w)
    c, s = mp.cos(psi), mp.sin(psi)
    return _R1(final, L) * mp.matrix([[c, s, 0], [-s, c, 0], [0, 0, 1]]) * _R1(l, L).T


def _jacobi(u: Any, m: Any) -> tuple[Any, Any, Any, Any]:
    """Amplitude, continued through the periods, and sn, cn, dn."""
    half_period = 2 * mp.ellipk(m)
    turns = mp.nint(u / half_period)
    rest = u - turns * half_period
    sn, cn, dn = (mp.ellipfun(name, rest, m=m) for name in ("sn", "cn", "dn"))
    sign = -1 if int(turns) % 2 else 1
    return turns * mp.pi + mp.asin(sn), sign * sn, sign * cn, dn


def _R1(l: Any, L: Any) -> Any:
    x, y, z = l
    perp = mp.sqrt(x * x + y * y)
    return mp.matrix(
        [
            [x * z / (L * perp), -y / perp, x / L],
            [y * z / (L * perp), x / perp, y / L],
            [-perp / L, 0, z / L],
        ]
    )
