"""Independent solutions that the tests compare the package with; nothing here uses the package.

Arrays are component-first, as in the package: attitudes A (3, 3, n) with the principal axes as rows, angular momenta L
(3, n) in the lab frame, moments (3, n). The zero moment of a line stands for its other one, which no state of a line
can tell; a point has three zeros and does not turn.
"""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from scipy.special import ellipj, ellipkinc, elliprf, elliprj

#: A product of rotation matrices, each orthogonal to rounding, is so to some 8 roundings of 1.
ORTHOGONAL = 1e-14


def random_attitudes(rng, n):
    """Uniformly distributed attitudes."""
    # SciPy before 1.16 makes no empty Rotation.
    return np.ascontiguousarray(Rotation.random(max(n, 1), rng=rng).as_matrix()[:n].transpose(1, 2, 0))


def matmul(P, A):
    """P A for matrices stored component-first."""
    return np.einsum("abn,bcn->acn", P, A)


def apply(A, L):
    """A L."""
    return np.einsum("abn,bn->an", A, L)


def orthogonality_error(A):
    """Largest deviation of A A^T from 1."""
    return np.abs(matmul(A, A.transpose(1, 0, 2)) - np.eye(3)[:, :, None]).max()


def worst(difference, angle):
    """Largest element of matrices in units of max(1, angle turned)."""
    return (np.abs(difference).max(axis=(0, 1)) / np.maximum(1, angle)).max()


def rates_of(moments):
    """Inverse moments."""
    whole = np.where(moments > 0, moments, moments.max(axis=0))
    return np.divide(1, whole, out=np.zeros_like(whole), where=whole > 0)


def skew(v):
    """The matrix [v] with [v] u = v x u."""
    x, y, z = v
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


# --- the equations of motion, integrated ------------------------------------------------------------------------


def rotation_by_dop853(A, L, moments, h):
    """A after the time h for one body, A (3, 3), L (3,), moments (3,): dA/dt = -[omega~] A."""
    rates = rates_of(np.asarray(moments, dtype=float)[:, None])[:, 0]

    def derivative(_, flat):
        A = flat.reshape(3, 3)
        return (-skew(rates * (A @ L)) @ A).ravel()

    return solve_ivp(derivative, (0, h), A.ravel(), method="DOP853", rtol=1e-13, atol=1e-15).y[:, -1].reshape(3, 3)


def rotation_by_taylor(A, L, moments, h, dtype=float, order=16, reach=0.2):
    """A and L~ after the time h, from Taylor series of Euler's equations and of the quaternion of the turn.

    It knows no elliptic function and no special case. The steps are such that turn and nutation in one stay below
    `reach`. The poles of L~(t) nearest to the real axis lie at a nutation phase of at least pi/2, so that truncation is
    below (0.2 / 1.57)^17 = 6e-16 of a step.
    """
    A, L, moments = (np.asarray(v, dtype=dtype) for v in (A, L, moments))
    body_L, rates = apply(A, L), rates_of(moments)
    size = np.abs(body_L).max(axis=0)
    size = np.where(size > 0, size, 1)
    unit, w = body_L / size, rates * (size * dtype(h))

    high, low = np.abs(w).max(axis=0), np.abs(w).min(axis=0)
    middle = np.abs(w).sum(axis=0) - high - low
    square = (unit * unit).sum(axis=0)
    energy = (np.abs(w) * unit * unit).sum(axis=0)  # bounds the turn: omega^2 <= 2E / (smallest moment)
    fastest = np.sqrt(high * energy + np.maximum(high * square - energy, 0) * (middle - low))
    steps = np.maximum(np.ceil(fastest / dtype(reach)), 1).astype(int)

    quaternion = np.empty((4, size.size), dtype)
    final = np.empty_like(unit)
    in_order = np.argsort(steps)
    for start in range(0, size.size, 1024):
        block = in_order[start : start + 1024]
        final[:, block], quaternion[:, block] = _taylor_steps(unit[:, block], w[:, block], steps[block], order)
    return matmul(matrix_of_quaternion(quaternion), A), final * size


def _taylor_steps(l, w, steps, order):
    n, dtype = l.shape[1], l.dtype
    w = w / steps
    difference = np.stack([w[2] - w[1], w[0] - w[2], w[1] - w[0]])
    q = np.zeros((4, n), dtype)
    q[0] = 1
    ls, qs, turns = (np.zeros((order + 1, k, n), dtype) for k in (3, 4, 3))
    for done in range(steps.max()):
        ls[0], qs[0], turns[0] = l, q, 0.5 * w * l
        for j in range(order):
            forward, back = ls[: j + 1], ls[j::-1]
            product = np.einsum("kan,kan->an", forward[:, [1, 2, 0]], back[:, [2, 0, 1]])
            ls[j + 1] = difference * product / (j + 1)
            turns[j + 1] = 0.5 * w * ls[j + 1]
            m = np.einsum("kan,kbn->abn", turns[: j + 1], qs[j::-1]) / (j + 1)
            # q' = -(0, omega~/2) q
            qs[j + 1, 0] = m[0, 1] + m[1, 2] + m[2, 3]
            qs[j + 1, 1] = -m[0, 0] - m[1, 3] + m[2, 2]
            qs[j + 1, 2] = -m[1, 0] - m[2, 1] + m[0, 3]
            qs[j + 1, 3] = -m[2, 0] - m[0, 2] + m[1, 1]
        moving = steps > done
        l, q = np.where(moving, ls.sum(axis=0), l), np.where(moving, qs.sum(axis=0), q)
    return l, q


def matrix_of_quaternion(q):
    """Rotation matrices of quaternions (w, x, y, z) of any norm."""
    w, x, y, z = q / np.sqrt((q * q).sum(axis=0))
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


# --- the paper's formulas -----------------------------------------------------------------------------------------


def R1(body_L, middle_sign=+1):
    """The paper's R_1; its element (2, 2) is printed with the sign -1."""
    x, y, z = body_L
    perp, L = np.hypot(x, y), np.sqrt(x * x + y * y + z * z)
    rows = [
        [x * z, -L * y, perp * x],
        [y * z, middle_sign * L * x, perp * y],
        [-perp * perp, 0 * x, perp * z],
    ]
    return np.array(rows) / (L * perp)


def R2(psi):
    """The paper's R_2: body frames turn against the body, so that this is the rotation about z by -psi."""
    c, s, zero, one = np.cos(psi), np.sin(psi), 0 * psi, 1 + 0 * psi
    return np.array([[c, s, zero], [-s, c, zero], [zero, zero, one]])


def paper_propagator(body_L, final_body_L, psi):
    """P of Eq. Pmatrix."""
    return matmul(matmul(R1(final_body_L), R2(psi)), R1(body_L).transpose(1, 0, 2))


def exchange_matrix():
    """U* of the paper: exchanges x and z and reverses y."""
    return np.array([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]])


def in_paper_frame(body_L, moments):
    """Proper matrices U (3, 3, n) to a frame with ordered moments and 2 E Iy > L^2, and L~ and moments there."""
    order = np.argsort(moments, axis=0)
    U = (order[:, None, :] == np.arange(3)[None, :, None]).astype(float)
    U[1] *= np.linalg.det(U.transpose(2, 0, 1))
    l, I = apply(U, body_L), np.take_along_axis(moments, order, axis=0)
    other = I[1] * (l * l / I).sum(axis=0) < (l * l).sum(axis=0)
    U = np.where(other, np.einsum("ab,bcn->acn", exchange_matrix(), U), U)
    return U, apply(U, body_L), np.where(other, I[::-1], I)


def closed_form_rotation(A, L, moments, h):
    """A after the time h by Eq. Pmatrix with SciPy's elliptic functions, for asymmetric bodies off the separatrix.

    L~ is (dn, sn, cn) of a phase that runs on from the initial one, and psi is an elliptic integral of the third kind,
    by Carlson's R_F and R_J.
    """
    U, l, I = in_paper_frame(apply(A, L), moments)
    square = (l * l).sum(axis=0)
    norm = np.sqrt(square)
    u, k = l / norm, norm * h
    a, b, c = 1 / I
    e = (u * u / I).sum(axis=0)

    x_max, y_max, z_max = np.sqrt([(e - c) / (a - c), (a - e) / (a - b), (a - e) / (a - c)])
    rate = np.abs(k) * np.sqrt((a - b) * (e - c))
    modulus = (b - c) * (a - e) / ((a - b) * (e - c))
    side = np.sign(u[0])
    sense = side * np.sign(k * (a - c))
    phase = ellipkinc(np.arctan2(sense * u[1] / y_max, u[2] / z_max), modulus)
    start, (sn, cn, dn, end) = ellipj(phase, modulus)[3], ellipj(phase + rate, modulus)
    final = np.array([side * x_max * dn, sense * y_max * sn, z_max * cn])

    # w = L^2 / L_perp^2 = 1 / (1 - z^2) with z = z_max cn.
    least_perp = (1 - z_max) * (1 + z_max)
    lean = z_max**2 / least_perp
    mean = (third_kind(end, modulus, lean) - third_kind(start, modulus, lean)) / (rate * least_perp)
    P = paper_propagator(u, final, k * (c + (e - c) * mean))
    return matmul(U.transpose(1, 0, 2), matmul(P, matmul(U, A)))


def third_kind(amplitude, m, lean):
    """Int_0^amplitude d theta / ((1 + lean sin^2) sqrt(1 - m sin^2)), for amplitudes of any size."""
    turns = np.round(amplitude / np.pi)
    s, c = np.sin(amplitude - turns * np.pi), np.cos(amplitude - turns * np.pi)

    def carlson(s, c):
        square = s * s
        rest = (c * c, 1 - m * square, np.ones_like(m))
        return s * elliprf(*rest) - lean / 3 * s * square * elliprj(*rest, 1 + lean * square)

    return carlson(s, c) + 2 * turns * carlson(np.ones_like(m), np.zeros_like(m))
