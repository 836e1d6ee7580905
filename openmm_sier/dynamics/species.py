"""The geometry that bodies of one kind share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from openmm_sier.dynamics import fitting

#: A moment below this fraction of the largest one is that of a line; sites this close to an axis, as a
#: fraction of the largest coordinate, lie on it.
LINEAR_MOMENT = 1e-10
ON_AXIS = 1e-9


@dataclass(frozen=True, eq=False)
class Species:
    """All bodies that share one geometry.

    Attributes:
        atoms: particle indices, (m, k): m bodies of k atoms.
        masses: (k,), dalton.
        sites: atom positions in the principal frame, (3, k), nm.
        moments: principal moments, (3,), ascending, dalton nm^2; exact zeros for a line or a point.
    """

    atoms: np.ndarray
    masses: np.ndarray
    sites: np.ndarray
    moments: np.ndarray

    @classmethod
    def from_coordinates(
        cls, atoms: ArrayLike, masses: ArrayLike, coordinates: ArrayLike, resolution: float = 0.0
    ) -> Species:
        """Species whose geometry is that of one set of atom positions.

        Args:
            atoms: particle indices, (m, k).
            masses: (k,), dalton, positive.
            coordinates: positions of the k atoms in any frame, (k, 3), nm.
            resolution: if all atoms are within this distance of a principal plane, in nm, they are put onto it.
        """
        masses = np.array(masses, dtype=float)
        r = np.array(coordinates, dtype=float)
        r = r - masses @ r / masses.sum()
        inertia = np.einsum("k,kx,kx->", masses, r, r) * np.eye(3) - np.einsum("k,kx,ky->xy", masses, r, r)
        _, axes = np.linalg.eigh(inertia)
        axes[:, 2] *= np.sign(np.linalg.det(axes))
        sites = (r @ axes).T
        sites[np.abs(sites) <= ON_AXIS * np.abs(sites).max()] = 0.0
        sites[np.abs(sites).max(axis=1) <= resolution] = 0.0
        return cls.from_sites(atoms, masses, sites)

    @classmethod
    def from_sites(cls, atoms: ArrayLike, masses: np.ndarray, sites: np.ndarray) -> Species:
        """Species whose moments depend, to the bit, on nothing but its sites (3, k) and masses."""
        sites = np.ascontiguousarray(sites)
        squares = (masses * sites**2).sum(axis=1)
        moments = squares.sum() - squares
        moments[moments <= LINEAR_MOMENT * moments.max()] = 0.0
        return cls(np.array(atoms, dtype=np.int64), masses, sites, moments)

    def of_atoms(self, atoms: ArrayLike) -> Species:
        """Other bodies, (m, k) particle indices, of the same geometry."""
        return replace(self, atoms=np.array(atoms, dtype=np.int64))

    def mirrored(self) -> Species:
        """The mirror image, whose principal axes are the same."""
        return replace(self, sites=fitting.MIRROR * self.sites)

    @property
    def mass(self) -> float:
        return float(self.masses.sum())

    @cached_property
    def tolerance(self) -> float:
        """Largest distance in nm of an atom from its place at which the body is still recognized."""
        return fitting.tolerance_of(self.sites)

    @cached_property
    def mirror_distance(self) -> float:
        """Largest distance in nm between an atom and its place in the mirror image; 0 for a planar body."""
        return fitting.distance_from_mirror_image(self.sites, self.masses)

    def fit(self, arms: np.ndarray, kept: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Attitudes (3, 3, m) of m bodies, and for each the largest distance of an atom from its place, (m,), nm.

        Args:
            arms: atom positions from the centres of mass, (m, k, 3), nm.
            kept: attitudes that are returned as they are if they fit to rounding.
        """
        return fitting.fit_attitudes(self.sites, self.masses, arms, kept)

    @property
    def dof(self) -> int:
        """Degrees of freedom of one body, 3 for a point, 5 for a line and 6 otherwise."""
        return 3 + int(np.count_nonzero(self.moments))
