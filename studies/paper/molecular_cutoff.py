"""TIP4P water with a smooth molecular cut-off: the potential of the paper's liquid, as a force for OpenMM.

The whole interaction of two molecules is multiplied by one function of the distance R of their oxygens,

    V = sum_{I<J} S(R_IJ) v_IJ,     v_IJ = LJ(R_IJ) + sum_ab k q_a q_b / r_ab,

so that a molecule is never cut in two. S falls from 1 to 0 between R_on and R_off with four continuous derivatives:
with fewer, the kinks rather than the integrator would limit a fourth-order scheme.

None of OpenMM's forces does this fast for four sites, since S of one distance multiplies functions of the others (tests
compare with a `CustomCompoundBondForce` over all pairs, some fifty times slower). A `PythonForce` lets NumPy do it, or
Numba where it is installed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import openmm

from studies.paper.pairs import compiled_sum, lennard_jones, switch

#: k = N_A e^2 / (4 pi eps0), kJ/mol nm; the value that OpenMM uses.
COULOMB = 138.935456

#: Pairs handled at a time, so that the temporaries stay in cache.
BLOCK = 2048

SITES = 4  # O, H, H, M


@dataclass(frozen=True)
class MolecularCutoff:
    """Energy and forces of 4-site water under a smooth molecular cut-off, in a cubic or rectangular box.

    Attributes:
        sigma, epsilon: Lennard-Jones parameters of the oxygens, nm and kJ/mol.
        charge: of a hydrogen, e; the site M carries twice its opposite.
        on, off: distances in nm between which the interaction is switched off.
    """

    sigma: float
    epsilon: float
    charge: float
    on: float
    off: float

    def __post_init__(self) -> None:
        if not 0 < self.on < self.off:
            raise ValueError(f"the cut-off needs 0 < on < off, got on = {self.on} nm and off = {self.off} nm")

    def __call__(self, state: openmm.State) -> tuple[float, np.ndarray]:
        """Energy and forces of a State with positions and box, as `openmm.PythonForce` asks for them."""
        positions = state.getPositions(asNumpy=True)._value
        box = np.diag(state.getPeriodicBoxVectors(asNumpy=True)._value)
        return self.energy_and_forces(positions, box)

    def energy_and_forces(self, positions: np.ndarray, box: np.ndarray) -> tuple[float, np.ndarray]:
        """Potential energy and forces.

        Args:
            positions: (4 n, 3), nm, the sites O, H, H, M of one molecule after another, molecules whole.
            box: edge lengths, (3,), nm, each at least twice `off`.

        Returns:
            (energy, forces): kJ/mol, and (4 n, 3) in kJ/mol/nm with those on M not yet passed on to its parents.

        Raises:
            ValueError: the box is too small for the cut-off.
        """
        self.check_box(box)
        if (add := compiled_sum()) is not None:
            sites = np.ascontiguousarray(np.reshape(positions, (-1, SITES, 3)), dtype=float)
            forces = np.zeros_like(sites)
            strengths = COULOMB * np.outer(self._charges(), self._charges())
            box = np.asarray(box, dtype=float)
            energy = add(sites, box, strengths, self.sigma, self.epsilon, self.on, self.off, forces)
            return energy, forces.reshape(-1, 3)
        return self._by_numpy(positions, box)

    def _by_numpy(self, positions: np.ndarray, box: np.ndarray) -> tuple[float, np.ndarray]:
        sites = np.ascontiguousarray(np.reshape(positions, (-1, SITES, 3)).transpose(2, 1, 0))
        n = sites.shape[2]
        forces = np.zeros((3, SITES, n))
        energy = 0.0
        # Sites that meet, as they do when steps are too long, give forces that are not finite; integrators handle that.
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for i, j in _pairs_within(sites[:, 0], box, self.off):
                energy += self._add_block(sites, i, j, box, forces)
        return energy, forces.transpose(2, 1, 0).reshape(-1, 3)

    def check_box(self, box: np.ndarray) -> None:
        """Refuse a box, (3,) in nm, that is so small that a molecule would meet two images of another.

        Raises:
            ValueError: an edge is shorter than twice the cut-off.
        """
        if 2 * self.off > np.min(box):
            raise ValueError(
                f"a cut-off of {self.off} nm needs a box of at least {2 * self.off} nm, got {np.min(box):.4f}"
            )

    def _add_block(self, sites: np.ndarray, i: np.ndarray, j: np.ndarray, box: np.ndarray, forces: np.ndarray) -> float:
        """Energy of the pairs (i, j); their forces are added to `forces`, (3, 4, n)."""
        here, there = np.take(sites, i, axis=2), np.take(sites, j, axis=2)
        oxygens = here[:, 0] - there[:, 0]
        image = np.rint(oxygens / box[:, None]) * box[:, None]
        oxygens -= image
        there += image[:, None]
        square = (oxygens * oxygens).sum(axis=0)
        s, slope = switch(np.sqrt(square), self.on, self.off)

        pair_energy, along_oxygens = lennard_jones(square, self.sigma, self.epsilon)
        along_oxygens *= s
        F_here, F_there = np.zeros_like(here), np.zeros_like(there)
        for a, b, strength in self._charge_pairs():
            d = here[:, a] - there[:, b]
            inverse = 1 / np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
            coulomb = strength * inverse
            pair_energy += coulomb
            d *= coulomb * inverse * inverse * s
            F_here[:, a] += d
            F_there[:, b] -= d
        oxygens *= along_oxygens - slope * pair_energy
        F_here[:, 0] += oxygens
        F_there[:, 0] -= oxygens
        _scatter(F_here, i, forces)
        _scatter(F_there, j, forces)
        return float(s @ pair_energy)

    def _charges(self) -> tuple[float, float, float]:
        return self.charge, self.charge, -2 * self.charge

    def _charge_pairs(self) -> list[tuple[int, int, float]]:
        charges = dict(enumerate(self._charges(), start=1))
        return [(a, b, COULOMB * qa * qb) for a, qa in charges.items() for b, qb in charges.items()]


def _pairs_within(oxygens: np.ndarray, box: np.ndarray, cutoff: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Index arrays (i, j), i < j, of the pairs of points (3, n) nearer than the cut-off, in blocks."""
    n = oxygens.shape[1]
    rows = max(1, math.ceil(4 * BLOCK / n))
    edges = box[:, None, None]
    for start in range(0, n - 1, rows):
        d = oxygens[:, start : start + rows, None] - oxygens[:, None, start + 1 :]
        d -= np.rint(d / edges) * edges
        near = (d * d).sum(axis=0) < cutoff * cutoff
        i, j = np.nonzero(np.triu(near))
        for first in range(0, i.size, BLOCK):
            part = slice(first, first + BLOCK)
            yield i[part] + start, j[part] + start + 1


def _scatter(values: np.ndarray, index: np.ndarray, total: np.ndarray) -> None:
    """total[:, :, index] += values, with repeated indices."""
    n = total.shape[2]
    for component in range(3):
        for site in range(SITES):
            total[component, site] += np.bincount(index, values[component, site], n)
