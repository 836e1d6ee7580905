"""Liquids of rigid molecules of one kind, and bodies in a field, as the kernels of this package take them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

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
        sites: places in the principal axes, nm, (s, 3).
        charges: products of charges with Coulomb's constant, (s, s).
        repulsion, dispersion: coefficients of r^-12 and r^-6, (s, s).
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
    repulsion: np.ndarray
    dispersion: np.ndarray
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
        places: of its atoms in principal axes, ascending moments, nm; the origin is anywhere.
        masses: dalton.
        charges: e.
        depths: well depths of the Lennard-Jones potential, kJ/mol.
        diameters: its diameters, nm.
        molecules: in the box.
        density: molecules in a nm^3.
        temperature: K.
        field: of `Liquid`.
        source: of the parameters.
    """

    places: tuple[tuple[float, float, float], ...]
    masses: tuple[float, ...]
    charges: tuple[float, ...]
    depths: tuple[float, ...]
    diameters: tuple[float, ...]
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
        depths = np.sqrt(np.outer(self.depths, self.depths))
        diameters = np.add.outer(self.diameters, self.diameters) / 2
        box = (self.molecules / self.density) ** (1 / 3)
        far = box / 2 - MARGIN
        return Liquid(
            sites=places,
            charges=COULOMB * np.outer(self.charges, self.charges),
            repulsion=4 * depths * diameters**12,
            dispersion=4 * depths * diameters**6,
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


def tip3p(hydrogen: float) -> dict:
    """Return masses, places and interactions of a TIP3P molecule with hydrogens of a mass, dalton."""
    half, bond = math.radians(104.52 / 2), 0.09572
    x, y = bond * math.sin(half), bond * math.cos(half)
    return {
        "places": ((0.0, 0.0, 0.0), (x, y, 0.0), (-x, y, 0.0)),
        "masses": (18.0154 - 2 * hydrogen, hydrogen, hydrogen),
        "charges": (-0.834, 0.417, 0.417),
        "depths": (0.635968, 0.0, 0.0),
        "diameters": (0.315075, 0.0, 0.0),
    }


MODELS = {
    "water": Model(
        **tip3p(4.0),
        density=33.37,
        temperature=297.0,
        source="TIP3P, Jorgensen et al., J. Chem. Phys. 79, 926 (1983); hydrogens of 4 dalton",
    ),
    "water in a field": Model(
        **tip3p(4.0),
        molecules=1024,
        density=33.37,
        temperature=297.0,
        field=120.0,
        source="V = -c tr A, c = 120 kJ/mol: librations of 50, 87 and 100 fs",
    ),
}
