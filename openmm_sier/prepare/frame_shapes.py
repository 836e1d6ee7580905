"""Frames of rigid bodies: two to four masses that are as heavy and as inert as a whole body, for OpenMM's constraints.

A rigid body moves by its mass M, its centre, and the three sums of m x^2 along its principal axes, M a^2, M b^2 and
M c^2, alone. Masses elsewhere that have these have its motion: under the same force and torque, the same acceleration.

Take a fraction f of the mass to the corner e sqrt((1 - f)/f) of an axis, and the rest to -e sqrt(f/(1 - f)). Their mean
is f sqrt((1 - f)/f) - (1 - f) sqrt(f/(1 - f)) = 0, in units of e, and that of their squares (1 - f) + f = 1. So with
e = c the corner and the rest have M c^2 along the shortest axis. The rest is divided in the same way along the next
axis, and what is left then along the last. What is divided later has its mean on the axis, so that sums of m x y are 0.
The rest has a fraction s of the mass, and e = b/sqrt(s) gives it M b^2.

With the fractions 1/4, 1/3 and 1/2 all four masses are equal: the corners of a tetrahedron that is regular but for its
stretching along the axes. Flat bodies need three masses and those on a line two. Where a body is thin, four equal
masses would be nearly in a plane, and a fourth of their distances would hardly tell where: constraints between them
would be nearly redundant. There smaller fractions take corners further out.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import openmm

from openmm_sier.dynamics.species import Species

#: Fractions of the mass, for the longest axis and the two others in this order, with which all masses are equal.
EQUAL = (1 / 2, 1 / 3, 1 / 4)

#: Bodies are thin where an extent is below this part of the longest one; from there on fractions fall with it.
THIN = 1 / 3

#: The least fraction: an atom of carbon in a body of a hundred.
LEAST = 0.01

#: An extent below this part of the longest one is none: in moments it counts by its square, which is rounding.
NO_EXTENT = 1e-5

#: nm. Corners are at least this far from the atoms of their body: Forces may divide by distances also where the energy
#: is 0. Such corners are found in bodies that have atoms there, as N2 has, by one of these factors of the fractions.
CLEAR = 1e-3
FACTORS = (1.0, 0.9, 0.8, 0.7, 0.6)


@dataclass(frozen=True, eq=False)
class FrameShape:
    """Describe the frame of a rigid body.

    Attributes:
        masses: (f,), dalton; f is 2 for a body on a line, 3 for a flat one and 4 otherwise.
        corners: where the masses are in the body's principal frame, (3, f), nm.
        axes: unit vectors x, y, z of the frame in the principal frame, as rows, (3, 3): x along the line between the
            last two corners, y from the middle of these to the one before them.
    """

    masses: np.ndarray
    corners: np.ndarray
    axes: np.ndarray

    @classmethod
    def of(cls, species: Species, places: np.ndarray) -> "FrameShape":
        """Return the frame of a rigid body.

        Args:
            species: its masses and sites, of which at least two are apart.
            places: what corners keep clear of, in the principal frame, (k, 3), nm.
        """
        squares = (species.masses * species.sites**2).sum(axis=1) / species.mass
        # The largest first.
        order = np.argsort(-squares, kind="stable")
        extents = np.sqrt(squares[order])
        extents[extents <= NO_EXTENT * extents[0]] = 0.0
        if np.count_nonzero(species.moments) < 3:
            extents[1:] = 0.0
        axes = np.eye(3)[order]
        axes[2] = np.cross(axes[0], axes[1])
        best = max(_candidates(extents), key=lambda found: min(_clearance(found[1] @ axes, places), CLEAR))
        masses, corners = best
        return cls(species.mass * masses, np.ascontiguousarray((corners @ axes).T), axes)

    def virtual_site(self, particles: list[int], place: np.ndarray) -> openmm.VirtualSite:
        """Return the virtual site at a place in the principal frame, (3,), nm, of the particles of a frame.

        Forces on it are passed on to the frame. The origin is the centre of mass, so that a net force accelerates all
        corners alike and strains no constraint.
        """
        x, y, z = (self.axes @ place).tolist()
        if len(particles) == 2:
            first, second = self.axes[0] @ self.corners
            weight = float((x - second) / (first - second))
            return openmm.TwoParticleAverageSite(*particles, weight, 1 - weight)
        unused = [0.0] * (len(particles) - 3)
        fractions = (self.masses / self.masses.sum()).tolist()
        along_x, along_y = [*unused, 0.0, 1.0, -1.0], [*unused, 1.0, -0.5, -0.5]
        return openmm.LocalCoordinatesSite(particles, fractions, along_x, along_y, openmm.Vec3(x, y, z))


def _candidates(extents: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Give frames of extents (3,), the longest first, by their fractions of the mass, (f,), and corners, (f, 3)."""
    thin = np.clip(extents / (THIN * extents[0]), LEAST, 1.0)
    for factor in FACTORS:
        fractions = np.maximum(np.array(EQUAL) * thin * factor, LEAST)
        if extents[1]:
            # OpenMM's SETTLE wants equal masses beside the first corner of a triangle.
            fractions[0] = EQUAL[0]
        yield _divided(extents, fractions)


def _divided(extents: np.ndarray, fractions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Divide a mass of 1 along the axes, the shortest first."""
    rest, left = np.zeros(3), 1.0
    masses, corners = [], []
    for axis in np.flatnonzero(extents)[::-1]:
        fraction, extent = fractions[axis], extents[axis] / np.sqrt(left)
        corner = rest.copy()
        corner[axis] = extent * np.sqrt((1 - fraction) / fraction)
        rest[axis] = -extent * np.sqrt(fraction / (1 - fraction))
        corners.append(corner)
        masses.append(left * fraction)
        left *= 1 - fraction
    return np.array([*masses, left]), np.array([*corners, rest])


def _clearance(corners: np.ndarray, places: np.ndarray) -> float:
    """Return the smallest distance of a corner (f, 3) from a place (k, 3)."""
    return float(np.linalg.norm(corners[:, None] - places[None], axis=2).min())
