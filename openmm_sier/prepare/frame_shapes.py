"""Shapes of frames: two to four masses with the mass, centre and moments of inertia of a rigid body.

The motion of a rigid body depends only on its mass M, its centre, and the three sums of m x^2 along its principal axes,
M a^2, M b^2 and M c^2. Other masses with these values have the same acceleration under the same force and torque.

Take a fraction f of the mass to the corner e sqrt((1 - f)/f) of an axis, and the rest to -e sqrt(f/(1 - f)). Their mean
is f sqrt((1 - f)/f) - (1 - f) sqrt(f/(1 - f)) = 0, in units of e, and that of their squares (1 - f) + f = 1. So with
e = c the corner and the rest have M c^2 along the shortest axis. The rest is divided in the same way along the next
axis, and the remainder along the last. Masses divided later have their mean on the axis, so that sums of m x y are 0.
The rest has a fraction s of the mass, and e = b/sqrt(s) gives it M b^2.

With the fractions 1/4, 1/3 and 1/2 all four masses would be equal, at the corners of a regular tetrahedron stretched
along the axes, which are atoms in a cube. Slightly smaller fractions keep clear of the atoms of symmetric bodies. Flat
bodies need three masses and linear bodies two. If a body is thin, four equal masses would lie nearly in a plane, where
one of their six distances nearly follows from the others: constraints would be nearly redundant. Smaller fractions move
corners further out.
"""

from dataclasses import dataclass

import numpy as np
import openmm

from openmm_sier.dynamics.species import Species

#: Fractions of the mass, from the longest axis to the shortest, and that along the axis of a line. OpenMM's SETTLE
#: requires equal masses at the last two corners of a triangle.
FRACTIONS, OF_LINE = (1 / 2, 0.3, 0.22), 0.4

#: Ratio of an extent to the longest one below which a body is thin, and fractions are reduced in proportion.
THIN = 1 / 3

#: Smallest fraction: a carbon atom in a body of a hundred.
LEAST = 0.01

#: Ratio of an extent to the longest one below which it counts as zero: its square, in moments, is rounding.
NO_EXTENT = 1e-5


@dataclass(frozen=True, eq=False)
class FrameShape:
    """Masses and geometry of the frame of a rigid body.

    Attributes:
        masses: (f,), dalton; f is 2 for a linear body, 3 for a flat one and 4 otherwise.
        corners: positions of the masses in the body's principal frame, (3, f), nm.
        axes: unit vectors x, y, z of the frame in the principal frame, as rows, (3, 3): x along the line between the
            last two corners, y from the middle of these to the one before them.
    """

    masses: np.ndarray
    corners: np.ndarray
    axes: np.ndarray

    @classmethod
    def of(cls, species: Species) -> "FrameShape":
        """Return the frame of a rigid body.

        Args:
            species: the body, with at least two distinct sites.
        """
        # Mean squares of the coordinates of its masses.
        squares = np.maximum(species.moments.sum() / 2 - species.moments, 0.0) / species.mass
        # The largest first.
        order = np.argsort(-squares, kind="stable")
        extents = np.sqrt(squares[order])
        extents[extents <= NO_EXTENT * extents[0]] = 0.0
        if np.count_nonzero(species.moments) < 3:
            extents[1:] = 0.0
        axes = np.eye(3)[order]
        axes[2] = np.cross(axes[0], axes[1])
        thin = np.clip(extents / (THIN * extents[0]), LEAST, 1.0)
        fractions = np.maximum(np.array(FRACTIONS) * thin, LEAST)
        if not extents[1]:
            fractions[0] = OF_LINE
        masses, corners = _divided(extents, fractions)
        return cls(species.mass * masses, np.ascontiguousarray((corners @ axes).T), axes)

    def virtual_site(self, particles: list[int], place: np.ndarray) -> openmm.VirtualSite:
        """Return the virtual site at a place in the principal frame, (3,), nm, of the particles of a frame.

        OpenMM passes its forces on to the frame. The origin is the centre of mass, so that a net force accelerates all
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


def _divided(extents: np.ndarray, fractions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Divide a mass of 1 along the axes, the shortest first."""
    rest, remaining = np.zeros(3), 1.0
    masses, corners = [], []
    for axis in np.flatnonzero(extents)[::-1]:
        fraction, extent = fractions[axis], extents[axis] / np.sqrt(remaining)
        corner = rest.copy()
        corner[axis] = extent * np.sqrt((1 - fraction) / fraction)
        rest[axis] = -extent * np.sqrt(fraction / (1 - fraction))
        corners.append(corner)
        masses.append(remaining * fraction)
        remaining *= 1 - fraction
    return np.array([*masses, remaining]), np.array([*corners, rest])
