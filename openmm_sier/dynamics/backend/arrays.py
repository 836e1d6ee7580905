"""Sums over the atoms of bodies and positions of them, executed by NumPy: the counterparts of the compiled loops.

Sites are sums of principal axes, so that all that depends on the number of sites are products with small constant
matrices, and few calls remain: small sets of bodies pay for every call.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from openmm_sier.dynamics.backend import kernels

if TYPE_CHECKING:
    from openmm_sier.dynamics.bodies import Species

#: Bodies handled at a time, so that temporaries stay in cache and no linear algebra library starts threads.
BLOCK = 2048


def place(species: Species, part: slice, q, A, positions) -> bool:
    """Write the positions (N, 3) of the atoms of a species' part of the bodies, at q (3, n) and A (3, 3, n).

    Returns:
        Whether a centre is not finite.
    """
    for block, columns in _blocks(species, part):
        for column, arm in zip(columns, _products(species.sites.T, A[:, :, block]), strict=True):
            positions[column] = (q[:, block] + arm).T
    return not _finite(q[:, part])


def move(species: Species, part: slice, v, omega, A, velocities) -> None:
    """Write the velocities (N, 3) of the atoms of a species that moves with v and turns with omega, both (3, n)."""
    for block, columns in _blocks(species, part):
        for column, arm in zip(columns, _products(species.sites.T, A[:, :, block]), strict=True):
            velocities[column] = (v[:, block] + np.stack(kernels.cross(omega[:, block], arm))).T


def collect(species: Species, part: slice, vectors, A, weights, total, moment) -> bool:
    """Write the sums (3, n) of weighted vectors (N, 3) over the atoms of each body, and of their moments.

    With sites r = sum_a s_a A_a the moment sum_j r_j x f_j is sum_a A_a x M_a, M_a = sum_j s_aj f_j.

    Returns:
        Whether a sum is not finite.
    """
    axes, coordinates = species.extents
    factors = weights * coordinates
    for block, columns in _blocks(species, part):
        on_sites = np.empty((len(columns), *total[:, block].shape))
        for values, column in zip(on_sites, columns, strict=True):
            values[:] = vectors[column].T
        sums = _products(factors, on_sites)
        total[:, block] = sums[0]
        if axes:
            # outer[x, y] = sum_a A_ax M_ay
            outer = sum(A[axis][:, None, block] * M for axis, M in zip(axes, sums[1:], strict=True))
            for x, y, z in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
                np.subtract(outer[y, z], outer[z, y], out=moment[x, block])
    return not (_finite(total[:, part]) and _finite(moment[:, part]))


def _finite(vectors) -> bool:
    """Whether all components (3, n) are finite, as their sum shows if it does not overflow; einsum does not warn."""
    return math.isfinite(np.einsum("ij->", vectors)) or bool(np.isfinite(vectors).all())


def _products(factors, vectors):
    """Sums of vectors (k, 3, n) with factors (j, k), as (j, 3, n)."""
    return (factors @ vectors.reshape(vectors.shape[0], -1)).reshape(-1, *vectors.shape[1:])


def _blocks(species: Species, part: slice) -> Iterator[tuple[slice, list]]:
    """Slices of a species' bodies, and for each site what picks their atoms out of an array of particles."""
    n = species.atoms.shape[0]
    if n <= BLOCK:
        yield part, species.columns
        return
    for start in range(0, n, BLOCK):
        stop = min(start + BLOCK, n)
        columns = [_part(column, slice(start, stop)) for column in species.columns]
        yield slice(part.start + start, part.start + stop), columns


def _part(column, block: slice):
    """What picks the atoms of some of the bodies."""
    if isinstance(column, slice):
        step = column.step or 1
        return slice(column.start + step * block.start, column.start + step * (block.stop - 1) + 1, step)
    return column[block]
