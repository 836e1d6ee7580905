"""The formulas of `openmm_sier.kernels` compiled by Numba, one body at a time.

Numba is an extra (`openmm-sier[fast]`). Where it is installed it is used; the environment variable OPENMM_SIER_NUMBA=0
keeps it out. Compiled code is cached on disk.
"""

from __future__ import annotations

import hashlib
import os
from contextlib import contextmanager
from functools import cache
from importlib import util
from inspect import getsource
from types import FunctionType, SimpleNamespace
from typing import Any

import numpy as np

from openmm_sier import elliptic, kernels
from openmm_sier.kernels import combine, cross, motion, rotation_matrix, short_turn

#: Sums and products may be contracted, but not reordered: NumPy and Numba agree to rounding.
OPTIONS: dict[str, Any] = {"fastmath": {"contract", "nsz"}, "error_model": "numpy", "nogil": True}


#: Whether compiled code may be used.
_allowed = os.environ.get("OPENMM_SIER_NUMBA", "1") != "0"


def executor() -> SimpleNamespace | None:
    """The compiled loops over bodies, or None where NumPy is to execute the kernels."""
    return _loops() if _allowed else None


@contextmanager
def disabled():
    """Within this NumPy executes the kernels."""
    global _allowed
    before, _allowed = _allowed, False
    try:
        yield
    finally:
        _allowed = before


@cache
def _loops() -> SimpleNamespace | None:
    if util.find_spec("numba") is None:
        return None
    import numba

    namespace: dict = {"np": np}
    for function in kernels.ELEMENTWISE:
        namespace[function.__name__] = numba.njit(_with_globals(function, namespace), **OPTIONS)
    # The cache on disk knows of the source of the loops alone, so that their names tell of the kernels' source.
    digest = hashlib.sha256((getsource(kernels) + getsource(elliptic)).encode()).hexdigest()[:12]
    loops = SimpleNamespace()
    for loop in (rotate, place, move, collect):
        clone = _with_globals(loop, namespace)
        clone.__qualname__ = f"{loop.__name__}_{digest}"
        setattr(loops, loop.__name__, numba.njit(clone, cache=True, **OPTIONS))
    return loops


def _with_globals(function, namespace):
    """The function, calling what stands in another namespace."""
    clone = FunctionType(function.__code__, namespace, function.__name__, function.__defaults__)
    clone.__module__, clone.__qualname__ = function.__module__, function.__qualname__
    return clone


def rotate(A, L, rates, order, parity, h, rules, limits, out, far):
    """Free rotation of bodies with equal moments; `far` is set for those that the series do not reach.

    Args:
        A, L: (3, 3, n) and (3, n).
        rates, order, parity: of `openmm_sier.rotor.Top`, shapes (3,), (3,) and ().
        h: time.
        rules: the two quadratures, each (end weight, nodes).
        limits: largest squared phases of the two, bounds of |L|^2, bound of the turn.
        out: (3, 3, n), written where `far` is not set.
        far: (n,), bool.
    """
    first, second = rules
    near_limit, far_limit, low, high, cap = limits
    a, b, c = rates[0], rates[1], rates[2]
    o0, o1, o2 = order[0], order[1], order[2]
    for n in range(A.shape[2]):
        lx, ly, lz = L[0, n], L[1, n], L[2, n]
        x = combine((lx, ly, lz), A[o0, 0, n], A[o0, 1, n], A[o0, 2, n])
        y = combine((lx, ly, lz), A[o1, 0, n], A[o1, 1, n], A[o1, 2, n]) * parity
        z = combine((lx, ly, lz), A[o2, 0, n], A[o2, 1, n], A[o2, 2, n])
        square = x * x + y * y + z * z
        far[n] = True
        if not (square >= low and square <= high):
            continue
        norm = np.sqrt(square)
        inverse = 1 / norm
        u = (x * inverse, y * inverse, z * inverse)
        k = norm * h
        moved = motion((a, b, c), u, k)
        phase = max(moved[3], moved[4])
        if not (phase <= far_limit and abs(k) * a <= cap):
            continue
        far[n] = False
        if phase <= near_limit:
            (w, i, j, l), _ = short_turn((a, b, c), moved, u, k, first[0], first[1])
        else:
            (w, i, j, l), _ = short_turn((a, b, c), moved, u, k, second[0], second[1])
        rows = rotation_matrix(w, i, j, l)
        for column in range(3):
            A0, A1, A2 = A[o0, column, n], parity * A[o1, column, n], A[o2, column, n]
            out[o0, column, n] = combine(rows[0], A0, A1, A2)
            out[o1, column, n] = parity * combine(rows[1], A0, A1, A2)
            out[o2, column, n] = combine(rows[2], A0, A1, A2)


def place(q, A, sites, atoms, positions):
    """Positions of the atoms of bodies: q (3, n), A (3, 3, n), sites (3, k), atoms (n, k), positions (N, 3) written."""
    for n in range(atoms.shape[0]):
        for j in range(atoms.shape[1]):
            site = (sites[0, j], sites[1, j], sites[2, j])
            atom = atoms[n, j]
            for x in range(3):
                positions[atom, x] = q[x, n] + combine(site, A[0, x, n], A[1, x, n], A[2, x, n])


def move(v, omega, A, sites, atoms, velocities):
    """Velocities of the atoms of bodies: v and omega (3, n), the rest as for `place`, velocities (N, 3) written."""
    for n in range(atoms.shape[0]):
        turn = (omega[0, n], omega[1, n], omega[2, n])
        for j in range(atoms.shape[1]):
            site = (sites[0, j], sites[1, j], sites[2, j])
            x = combine(site, A[0, 0, n], A[1, 0, n], A[2, 0, n])
            y = combine(site, A[0, 1, n], A[1, 1, n], A[2, 1, n])
            z = combine(site, A[0, 2, n], A[1, 2, n], A[2, 2, n])
            swing = cross(turn, (x, y, z))
            for axis in range(3):
                velocities[atoms[n, j], axis] = v[axis, n] + swing[axis]


def collect(vectors, A, sites, weights, atoms, total, moment):
    """Sums over the atoms of bodies of weighted vectors (N, 3) and of their moments, (3, n) each, written."""
    for n in range(atoms.shape[0]):
        fx = fy = fz = tx = ty = tz = 0.0
        for j in range(atoms.shape[1]):
            site = (sites[0, j], sites[1, j], sites[2, j])
            x = combine(site, A[0, 0, n], A[1, 0, n], A[2, 0, n])
            y = combine(site, A[0, 1, n], A[1, 1, n], A[2, 1, n])
            z = combine(site, A[0, 2, n], A[1, 2, n], A[2, 2, n])
            atom = atoms[n, j]
            f = (weights[j] * vectors[atom, 0], weights[j] * vectors[atom, 1], weights[j] * vectors[atom, 2])
            turn = cross((x, y, z), f)
            fx, fy, fz = fx + f[0], fy + f[1], fz + f[2]
            tx, ty, tz = tx + turn[0], ty + turn[1], tz + turn[2]
        total[0, n], total[1, n], total[2, n] = fx, fy, fz
        moment[0, n], moment[1, n], moment[2, n] = tx, ty, tz
