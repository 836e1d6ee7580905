"""TIP4P water with a smooth molecular cut-off: the potential of the paper's liquid, as a force for OpenMM.

The whole interaction of two molecules is multiplied by one function of the distance R of their oxygens,

    V = sum_{I<J} S(R_IJ) v_IJ,     v_IJ = LJ(R_IJ) + sum_ab k q_a q_b / r_ab,

so that a molecule is never cut in two. S falls from 1 to 0 between R_on and R_off with four continuous derivatives:
with fewer, the kinks rather than the integrator would limit a fourth-order scheme.

None of OpenMM's forces does this fast for four sites, since S of one distance multiplies functions of the others (tests
compare with a `CustomCompoundBondForce` over all pairs, some fifty times slower). A `PythonForce` lets Numba do it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import openmm

from studies.paper.pairs import compiled_sum
from studies.units import md

#: k = N_A e^2 / (4 pi eps0), kJ/mol nm; the value that OpenMM uses.
COULOMB = 138.935456

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
        positions = md(state.getPositions(asNumpy=True))
        box = np.diag(md(state.getPeriodicBoxVectors(asNumpy=True)))
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
        sites = np.ascontiguousarray(np.reshape(positions, (-1, SITES, 3)), dtype=float)
        forces = np.zeros_like(sites)
        strengths = COULOMB * np.outer(self._charges(), self._charges())
        box = np.asarray(box, dtype=float)
        energy = compiled_sum()(sites, box, strengths, self.sigma, self.epsilon, self.on, self.off, forces)
        return energy, forces.reshape(-1, 3)

    def check_box(self, box: np.ndarray) -> None:
        """Refuse a box, (3,) in nm, that is so small that a molecule would meet two images of another.

        Raises:
            ValueError: an edge is shorter than twice the cut-off.
        """
        if 2 * self.off > np.min(box):
            raise ValueError(
                f"a cut-off of {self.off} nm needs a box of at least {2 * self.off} nm, got {np.min(box):.4f}"
            )

    def _charges(self) -> tuple[float, float, float]:
        return self.charge, self.charge, -2 * self.charge
