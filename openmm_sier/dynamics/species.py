"""Geometry shared by bodies of one kind, and its fit to atom positions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from openmm_sier.dynamics.motion import Motion
from openmm_sier.dynamics.sites import AlikeSites, Sites

#: A moment below this fraction of the largest one is that of a line; sites this close to an axis, as a
#: fraction of the largest coordinate, lie on it.
LINEAR_MOMENT = 1e-10
ON_AXIS = 1e-9

#: Largest accepted distance in nm between an atom and its place in the reference geometry. Water models differ by up to
#: 0.0142 nm (OPC and TIP3P-FB), and from crystallographic hydrogens by up to 0.0167 nm (O-H of 0.084 nm, TIP3P-FB).
#: Molecules that are cut by the periodic boundary are off by far more.
FIT_TOLERANCE = 0.02

#: The distance must also be at most this fraction of the shortest distance in the body. Every atom is then nearer to
#: its own place than to that of any other atom, so that none can be mistaken for another.
FIT_FRACTION = 0.25

#: Number of sites up to which all distances are compared.
MOST_COMPARED = 200

#: Sites at most this far apart, in nm, are at one place and need not be distinguished.
ONE_PLACE = 1e-9


#: Moments that differ by more than this part of the largest are not those of the masses; lines are made exact by less.
OTHER_MOMENT = 1e-6

#: Moments about two axes about which a body turns, and not about the third, may differ by this part of the larger one.
EQUAL_MOMENTS = 1e-9

#: A line that is inclined to the z axis by a smaller angle, in radians, is along it.
ALONG = 1e-6

#: Sites this close to an axis, as a fraction of the largest distance from the centre, need no moment about it: a moment
#: of `LINEAR_MOMENT` belongs to sites off by 1e-5. Rotations show at sites that are off by more than a tenth of that.
NEAR_AXIS = 1e-4
SHOWN = 1e-6


def _direction(coordinates: np.ndarray) -> float:
    """Return the sign that brings the first of the outermost atoms along an axis onto its positive side.

    Eigenvectors are defined up to a sign, which rounding decides. The noise of a heat bath is drawn along the axes, so
    runs with one seed would differ between processors.
    """
    distances = np.abs(coordinates)
    # Symmetric atoms are equally far out to rounding.
    first = coordinates[np.argmax(distances >= 0.9 * distances.max())]
    return -1.0 if first < 0 else 1.0


def _last_axis_along_z(A: np.ndarray) -> np.ndarray:
    """Return attitudes (3, 3, m) of lines with the last axis as near to z as it can be, since any across them will do.

    That of a line along z stays as it is.
    """
    line = A[0]
    last = np.array([0.0, 0.0, 1.0])[:, None] - line[2] * line
    length = np.linalg.norm(last, axis=0)
    last = np.where(length > ALONG, last / np.maximum(length, ALONG), A[2])
    return np.stack([line, np.cross(last, line, axis=0), last])


def tensor_of(masses: np.ndarray, arms: np.ndarray) -> np.ndarray:
    """Return the tensor of inertia, (3, 3), of masses (k,) at positions (k, 3) relative to their centre."""
    return np.einsum("k,kx,kx->", masses, arms, arms) * np.eye(3) - np.einsum("k,kx,ky->xy", masses, arms, arms)


def principal_frame(arms: np.ndarray, tensor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return sites in the principal frame, (3, k), and the principal axes as rows, (3, 3), by ascending moments.

    Args:
        arms: positions of the sites relative to the centre of mass, (k, 3).
        tensor: of inertia, (3, 3), in the same frame.
    """
    _, axes = np.linalg.eigh(tensor)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    sites = (arms @ axes).T
    sites[np.abs(sites) <= ON_AXIS * np.abs(sites).max()] = 0.0
    x, y = map(_direction, sites[:2])
    signs = np.array([[x], [y], [x * y]])
    # Adding zero makes zeros positive.
    return signs * sites + 0.0, signs * axes.T + 0.0


class RigidityError(ValueError):
    """Error for atoms that do not form the expected rigid body."""


@dataclass(frozen=True, eq=False)
class Species:
    """Bodies that share one geometry.

    Attributes:
        atoms: particle indices, (m, k): m bodies of k atoms.
        masses: (k,), dalton; atoms may be massless if others are not.
        sites: atom positions in the principal frame, (3, k), nm.
        moments: principal moments, (3,), dalton nm^2, ascending; exact zeros for a line or a point. They may be other
            than those of the masses at the sites.
        name: of the `BodyType`; empty for bodies without one.
        axes: principal axes in the frame of the `BodyType`, as rows, (3, 3); the identity without one.
        motion: along which axes the bodies move, and about which they turn.

    Raises:
        ValueError: the arrays have other shapes, there is no mass, no body has these moments, or the sites do not show
            a rotation that the moments allow, or show one about an axis without moment; or bodies turn about two
            axes with unequal moments, and not about the third.
    """

    atoms: np.ndarray
    masses: np.ndarray
    sites: np.ndarray
    moments: np.ndarray
    name: str = ""
    axes: np.ndarray = field(default_factory=lambda: np.eye(3))
    motion: Motion = Motion.FREE

    def __post_init__(self) -> None:
        k = self.masses.size
        shapes = self.atoms.shape[1:], self.masses.shape, self.sites.shape, self.moments.shape
        if self.atoms.ndim != 2 or k == 0 or shapes != ((k,), (k,), (3, k), (3,)):
            raise ValueError(f"species need atoms (m, k), masses (k,), sites (3, k) and moments (3,), got {shapes}")
        if not (self.masses >= 0).all() or not self.mass > 0:
            raise ValueError(f"a body must have a positive mass, and no atom a negative one, got {self.masses} dalton")
        x, y, z = np.sort(self.moments)
        if x < 0 or z > (x + y) * (1 + OTHER_MOMENT):
            raise ValueError(
                "moments must not be negative, and the largest at most the sum of the others, since no body has other "
                f"ones, got {self.moments} dalton nm^2"
            )
        self._refuse_hidden_rotation()
        turning = self.moments[self.turns]
        if turning.size and not self.turns_freely and np.ptp(turning) > EQUAL_MOMENTS * turning.max():
            raise ValueError(
                f"bodies that turn about two of three axes must have equal moments about these, got {turning} dalton "
                "nm^2: let them turn about one axis, or about all"
            )

    def _refuse_hidden_rotation(self) -> None:
        """Refuse sites from which nobody can read a rotation, and those that a rotation without inertia would move."""
        distances = np.linalg.norm(self.sites, axis=0)
        longest = distances.max()
        turns = self.moments > 0
        off_axes = np.sqrt(np.maximum(distances**2 - self.sites**2, 0.0))
        without_inertia = ~turns & (off_axes.max(axis=1) > NEAR_AXIS * longest)
        if without_inertia.any():
            site = int(off_axes[without_inertia.argmax()].argmax())
            raise ValueError(
                f"site {site} is off an axis about which the body has no moment, so that any torque would turn it "
                "infinitely fast: give moments, which must be above zero about axes that sites are off"
            )
        # The second largest sum of squares along an axis, of which one is the line itself.
        if turns.all() and np.linalg.eigvalsh(self.sites @ self.sites.T)[1] <= (SHOWN * longest) ** 2:
            raise ValueError(
                "all sites lie on a line through the centre of mass, so that positions do not show rotations about it: "
                "add a site off the line, which may be massless and without interactions; or give no moment about the "
                "line"
            )

    @classmethod
    def from_coordinates(
        cls, atoms: ArrayLike, masses: ArrayLike, coordinates: ArrayLike, resolution: float = 0.0
    ) -> Species:
        """Return a species with the geometry of one set of atom positions.

        Args:
            atoms: particle indices, (m, k).
            masses: (k,), dalton, positive.
            coordinates: positions of the k atoms in any frame, (k, 3), nm.
            resolution: distance in nm within which all atoms are moved onto a principal plane.
        """
        masses = np.array(masses, dtype=float)
        r = np.array(coordinates, dtype=float)
        r = r - masses @ r / masses.sum()
        sites, _ = principal_frame(r, tensor_of(masses, r))
        sites[np.abs(sites).max(axis=1) <= resolution] = 0.0
        return cls.from_sites(atoms, masses, sites)

    @classmethod
    def from_sites(cls, atoms: ArrayLike, masses: np.ndarray, sites: np.ndarray) -> Species:
        """Return a species whose moments depend, to the bit, only on its sites (3, k) and masses."""
        sites = np.ascontiguousarray(sites)
        squares = (masses * sites**2).sum(axis=1)
        moments = squares.sum() - squares
        moments[moments <= LINEAR_MOMENT * moments.max()] = 0.0
        return cls(np.array(atoms, dtype=np.int64), masses, sites, moments)

    def of_atoms(self, atoms: ArrayLike) -> Species:
        """Return other bodies, (m, k) particle indices, of the same geometry."""
        return replace(self, atoms=np.array(atoms, dtype=np.int64))

    def mirrored(self) -> Species:
        """Return the mirror image, whose principal axes are the same."""
        return replace(self, sites=np.array([[1.0], [1.0], [-1.0]]) * self.sites)

    @cached_property
    def mass(self) -> float:
        return float(self.masses.sum())

    @property
    def dof(self) -> int:
        """Degrees of freedom of one body: of a free one 3 for a point, 5 for a line and 6 otherwise."""
        return sum(self.motion.translations) + int(np.count_nonzero(self.turns))

    @cached_property
    def turns(self) -> np.ndarray:
        """Whether the bodies turn about each principal axis, (3,)."""
        return (self.moments > 0) & self.motion.rotations

    @property
    def turns_freely(self) -> bool:
        """Whether the bodies turn about all axes about which they have a moment."""
        return bool((self.turns == (self.moments > 0)).all())

    @cached_property
    def tolerance(self) -> float:
        """Largest distance in nm between an atom and its site at which the body is still recognized."""
        if self.sites.shape[1] <= MOST_COMPARED:
            first, second = np.triu_indices(self.sites.shape[1], 1)
        else:
            from scipy.spatial import KDTree

            # Larger distances do not matter.
            first, second = KDTree(self.sites.T).query_pairs(FIT_TOLERANCE / FIT_FRACTION, output_type="ndarray").T
        apart = np.linalg.norm(self.sites[:, first] - self.sites[:, second], axis=0)
        shortest = apart[apart > ONE_PLACE].min(initial=np.inf)
        return float(min(FIT_TOLERANCE, FIT_FRACTION * shortest))

    def fit(self, arms: np.ndarray, previous: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return attitudes (3, 3, m) of m bodies, and the largest distance of an atom from its place, (m,), nm.

        The best rotation in the sense of mass-weighted least squares, from a singular value decomposition (Kabsch,
        Acta Cryst. A 34, 827 (1978)). With massless atoms all have equal weights.

        Args:
            arms: atom positions from the centres of mass, (m, k, 3), nm.
            previous: attitudes that are returned unchanged if they fit to rounding.
        """
        if not self.sites.any():
            attitudes = np.repeat(np.eye(3)[:, :, None], len(arms), axis=2) if previous is None else previous
            return attitudes, np.linalg.norm(arms, axis=2).max(axis=1)
        if previous is not None:
            misfit = self._misfit(arms, previous)
            # Atom positions carry the rounding of coordinates of some nm.
            if misfit.max() < 1e-13 * (1 + np.abs(arms).max()):
                return previous, misfit
        correlation = np.einsum("k,ak,mkx->max", self._weights, self.sites, arms)
        u, _, vt = np.linalg.svd(correlation)
        u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
        attitudes = np.ascontiguousarray((u @ vt).transpose(1, 2, 0))
        if self.moments[0] == 0 and not self.turns_freely:
            attitudes = _last_axis_along_z(attitudes)
        return attitudes, self._misfit(arms, attitudes)

    @cached_property
    def _weights(self) -> np.ndarray:
        return self.masses if self.masses.all() else np.ones_like(self.masses)

    @cached_property
    def has_other_moments(self) -> bool:
        """Whether the moments are not those of the masses at the sites."""
        squares = (self.masses * self.sites**2).sum(axis=1)
        of_masses = squares.sum() - squares
        return not (np.abs(self.moments - of_masses) <= OTHER_MOMENT * self.moments.max()).all()

    def angular_momenta(self, velocities: np.ndarray, A: np.ndarray) -> np.ndarray:
        """Return angular momenta in the lab frame, (3, m), of the rotation that is nearest to the velocities of atoms.

        Args:
            velocities: relative to the centres of mass, (m, k, 3), nm/ps.
            A: attitudes, (3, 3, m).
        """
        along_axes = np.einsum("axm,mkx->mka", A, velocities)
        turning = np.cross(self.sites.T, along_axes).sum(axis=1)
        of_equal_masses = tensor_of(np.ones_like(self.masses), self.sites.T)
        omega = turning @ np.linalg.pinv(of_equal_masses)
        return np.einsum("axm,ma->xm", A, self.moments * omega)

    def _misfit(self, arms: np.ndarray, A: np.ndarray) -> np.ndarray:
        places = np.einsum("ak,axm->mkx", self.sites, A)
        return np.linalg.norm(arms - places, axis=2).max(axis=1)


def sites_of(species: Sequence[Species], bodies: Sequence[np.ndarray]) -> tuple[Sites, np.ndarray]:
    """Return the atoms of bodies, and the fraction of the mass at each site, (k,).

    All points form one set whatever their masses; any other kind of body has a separate set.

    Args:
        species: kinds of body.
        bodies: indices of the bodies of each kind.
    """
    sets, fractions = [], [np.empty(0)]
    kinds = list(zip(species, bodies, strict=True))
    for kind, numbers in kinds:
        if kind.sites.any():
            sets.append(AlikeSites(numbers, kind.atoms, kind.sites))
            fractions.append(kind.masses / kind.mass)
    of_size: dict[int, list[tuple[Species, np.ndarray]]] = {}
    for kind, numbers in kinds:
        if not kind.sites.any():
            of_size.setdefault(len(kind.masses), []).append((kind, numbers))
    for alike in of_size.values():
        points, their_numbers = zip(*alike, strict=True)
        numbers = np.concatenate(their_numbers)
        order = np.argsort(numbers)
        sets.append(AlikeSites(numbers[order], np.concatenate([kind.atoms for kind in points])[order], points[0].sites))
        fractions.append(points[0].masses / points[0].mass)
    return Sites(sets), np.concatenate(fractions)
