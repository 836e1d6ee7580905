"""Liquids of rigid molecules of one kind, and bodies in a field, as the kernels of this package take them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from openmm_sier.dynamics.constants import GAS_CONSTANT

#: Coulomb's constant, kJ/mol nm/e^2.
COULOMB = 138.935458

#: Width of the shell in which pair energies are switched off, nm, and what is left between it and half of the box.
SHELL, MARGIN = 0.12, 1e-3


class Liquid(NamedTuple):
    """Hold what kernels need of a liquid of equal bodies, in a cubic box or each alone in a field.

    Energies of pairs of molecules are switched off between two distances of their centres.

    Attributes:
        sites: places in the principal axes, nm, (3, 3).
        charges: products of charges with Coulomb's constant, (3, 3).
        repulsion, dispersion: coefficients of r^-12 and r^-6 between first sites.
        box: its edge, nm.
        near, far: distances of centres, nm.
        field: c of V = -c tr A in kJ/mol; with 0 bodies act on each other.
        mass: dalton.
        moments: principal moments, none of which is 0, dalton nm^2.
        inverse_moments: one over each of them.
        thermal: k_B T, kJ/mol.
    """

    sites: np.ndarray
    charges: np.ndarray
    repulsion: float
    dispersion: float
    box: float
    near: float
    far: float
    field: float
    mass: float
    moments: np.ndarray
    inverse_moments: np.ndarray
    thermal: float


class Bodies(NamedTuple):
    """Hold the phase point of n bodies, which kernels change in place.

    Attributes:
        q, p: centres and momenta, (n, 3).
        A: attitude matrices, (n, 3, 3).
        L: angular momenta in the lab frame, (n, 3).
    """

    q: np.ndarray
    p: np.ndarray
    A: np.ndarray
    L: np.ndarray


@dataclass(frozen=True, kw_only=True)
class Model:
    """Describe a molecule, and how it is simulated.

    Attributes:
        places: of its three atoms in principal axes, nm; the origin is anywhere.
        masses: dalton.
        charges: e.
        depth: of the well of the Lennard-Jones potential of the first atom, kJ/mol.
        diameter: of that potential, nm.
        molecules: in the box.
        density: molecules in a nm^3.
        temperature: K.
        field: of `Liquid`.
        source: of the parameters.
    """

    places: tuple[tuple[float, float, float], ...]
    masses: tuple[float, ...]
    charges: tuple[float, ...]
    depth: float
    diameter: float
    molecules: int = 64
    density: float
    temperature: float
    field: float = 0.0
    source: str

    def liquid(self) -> Liquid:
        masses, places = np.array(self.masses), np.array(self.places)
        places = places - masses @ places / masses.sum()
        squares = masses @ places**2
        moments = squares.sum() - squares
        box = (self.molecules / self.density) ** (1 / 3)
        far = box / 2 - MARGIN
        return Liquid(
            sites=places,
            charges=COULOMB * np.outer(self.charges, self.charges),
            repulsion=4 * self.depth * self.diameter**12,
            dispersion=4 * self.depth * self.diameter**6,
            box=box,
            near=far - SHELL,
            far=far,
            field=self.field,
            mass=float(masses.sum()),
            moments=moments,
            inverse_moments=1 / moments,
            thermal=GAS_CONSTANT * self.temperature,
        )

    @property
    def degrees(self) -> tuple[int, int]:
        """Return numbers of degrees of freedom of translation and rotation; in a field a molecule only turns."""
        return 0 if self.field else 3, 3

    def start(self, seed: int) -> Bodies:
        """Return molecules on a lattice with thermal momenta, turned at random or, in a field, as it turns them."""
        liquid, n = self.liquid(), self.molecules
        rng = np.random.default_rng(seed)
        side = math.ceil(n ** (1 / 3) - 1e-9)
        lattice = np.stack(np.meshgrid(*[np.arange(side)] * 3), axis=-1).reshape(-1, 3)[:n]
        A = np.tile(np.eye(3), (n, 1, 1)) if self.field else _turned_at_random(rng, n)
        p = rng.normal(size=(n, 3)) * math.sqrt(liquid.thermal * liquid.mass)
        turning = rng.normal(size=(n, 3)) * np.sqrt(liquid.thermal * liquid.moments)
        return Bodies(lattice * (liquid.box / side), p, A, np.einsum("nk,nkx->nx", turning, A))


def _turned_at_random(rng: np.random.Generator, n: int) -> np.ndarray:
    A = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    return A * np.linalg.det(A)[:, None, None]


def hydride(
    bond: float, angle: float, charge: float, depth: float, diameter: float, masses: tuple[float, float]
) -> dict[str, Any]:
    """Return places, masses and interactions of a bent molecule with two bare hydrogens.

    Args:
        bond, angle: its shape, nm and degrees.
        charge: of a hydrogen, e.
        depth, diameter: of the central atom, kJ/mol and nm.
        masses: of the molecule and of a hydrogen, dalton.
    """
    half = math.radians(angle / 2)
    x, y = bond * math.sin(half), bond * math.cos(half)
    whole, hydrogen = masses
    return {
        "places": ((0.0, 0.0, 0.0), (x, y, 0.0), (-x, y, 0.0)),
        "masses": (whole - 2 * hydrogen, hydrogen, hydrogen),
        "charges": (-2 * charge, charge, charge),
        "depth": depth,
        "diameter": diameter,
    }


#: Water with hydrogens of 4 dalton.
TIP3P = hydride(0.09572, 104.52, 0.417, 0.635968, 0.315075, (18.0154, 4.0))
SPCE = hydride(0.1, 109.47, 0.4238, 0.650194, 0.316557, (18.0154, 4.0))

MODELS = {
    "TIP3P": Model(
        **TIP3P,
        density=33.37,
        temperature=297.0,
        source="Jorgensen et al., J. Chem. Phys. 79, 926 (1983); hydrogens of 4 dalton",
    ),
    "TIP3P in a field": Model(
        **TIP3P,
        molecules=1024,
        density=33.37,
        temperature=297.0,
        field=120.0,
        source="V = -c tr A, c = 120 kJ/mol: librations of 50, 87 and 100 fs",
    ),
    "SPC/E": Model(
        **SPCE,
        density=33.37,
        temperature=297.0,
        source="Berendsen et al., J. Phys. Chem. 91, 6269 (1987); hydrogens of 4 dalton",
    ),
    "hydrogen sulphide": Model(
        **hydride(0.134, 92.0, 0.235, 1.046, 0.37, (34.08, 1.008)),
        density=16.77,
        temperature=213.0,
        source="Jorgensen, J. Phys. Chem. 90, 6379 (1986)",
    ),
}
