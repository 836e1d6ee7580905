"""The interaction of two water molecules under a smooth molecular cut-off, and its sum over pairs compiled by Numba.

`switch` and `lennard_jones` have no branches, so that tests execute them on arrays.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numba
import numpy as np

from openmm_sier.dynamics.kernels.compilation import OPTIONS


def switch(distance, on, off):
    """S and S'/R for the distance R of two oxygens: from 1 at `on` to 0 at `off`, four derivatives continuous."""
    width = off - on
    x = np.minimum(np.maximum((distance - on) / width, 0.0), 1.0)
    y = 1 - x
    s = 1 - x**5 * (126 + x * (-420 + x * (540 + x * (-315 + x * 70))))
    return s, (-630 / width) * (x * y) ** 4 / distance


def lennard_jones(square, sigma, epsilon):
    """Energy, and force over distance, for the squared distance of two oxygens."""
    inverse = sigma * sigma / square
    six = inverse * inverse * inverse
    attraction = (4 * epsilon) * six
    repulsion = attraction * six
    return repulsion - attraction, (12 * repulsion - 6 * attraction) / square


@cache
def compiled_sum() -> Callable:
    """`_sum_over_pairs`, compiled."""
    jit = numba.njit(**OPTIONS)
    return jit(_sum_over_pairs(jit(switch), jit(lennard_jones)))


def _sum_over_pairs(switch, lennard_jones):
    """The loop, calling given versions of the formulas."""

    def sum_over_pairs(sites, box, strengths, sigma, epsilon, on, off, forces):
        """Return the energy, and add the forces to `forces`.

        Args:
            sites: (n, 4, 3), nm, O, H, H, M.
            box: (3,), nm.
            strengths: (3, 3), products of the charges of H, H, M, kJ/mol nm.
            sigma, epsilon, on, off: of `MolecularCutoff`.
            forces: (n, 4, 3), kJ/mol/nm.
        """
        total = 0.0
        for i in range(sites.shape[0] - 1):
            for j in range(i + 1, sites.shape[0]):
                x = sites[i, 0, 0] - sites[j, 0, 0]
                y = sites[i, 0, 1] - sites[j, 0, 1]
                z = sites[i, 0, 2] - sites[j, 0, 2]
                image_x = np.rint(x / box[0]) * box[0]
                image_y = np.rint(y / box[1]) * box[1]
                image_z = np.rint(z / box[2]) * box[2]
                x, y, z = x - image_x, y - image_y, z - image_z
                square = x * x + y * y + z * z
                if not square < off * off:
                    continue
                s, slope = switch(np.sqrt(square), on, off)
                energy, along = lennard_jones(square, sigma, epsilon)
                for a in range(1, 4):
                    for b in range(1, 4):
                        dx = sites[i, a, 0] - sites[j, b, 0] - image_x
                        dy = sites[i, a, 1] - sites[j, b, 1] - image_y
                        dz = sites[i, a, 2] - sites[j, b, 2] - image_z
                        inverse = 1 / np.sqrt(dx * dx + dy * dy + dz * dz)
                        coulomb = strengths[a - 1, b - 1] * inverse
                        energy += coulomb
                        f = coulomb * inverse * inverse * s
                        for axis, d in enumerate((dx, dy, dz)):
                            forces[i, a, axis] += f * d
                            forces[j, b, axis] -= f * d
                f = along * s - slope * energy
                for axis, d in enumerate((x, y, z)):
                    forces[i, 0, axis] += f * d
                    forces[j, 0, axis] -= f * d
                total += s * energy
        return total

    return sum_over_pairs
