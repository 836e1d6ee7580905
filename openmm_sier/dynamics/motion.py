"""Translations and rotations that bodies have: those of a free body, or fewer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from openmm_sier.dynamics.vectors import body_frame, combine

#: For each of three axes, whether there is motion along it or about it.
Axes = tuple[bool, bool, bool]

EVERY: Axes = (True, True, True)
NONE: Axes = (False, False, False)


@dataclass(frozen=True)
class Motion:
    """The translations and rotations that a rigid body has.

    >>> Motion.IN_PLANE
    Motion(translations=(True, True, False), rotations=(False, False, True))

    Forces and torques along the other axes have no effect, as if frictionless bearings held the body. Momenta along
    these axes are zero, and hold no heat.

    Attributes:
        translations: whether its centre moves along x, y and z.
        rotations: whether it turns about each of its principal axes, which are in the order of ascending moments. A
            body turns about all of them, about none, about one, or about two with equal moments.

    Raises:
        TypeError: either is not three values of True or False.
    """

    translations: Axes = EVERY
    rotations: Axes = EVERY

    #: A free body.
    FREE: ClassVar[Motion]
    #: A body that turns about its centre, which stays in its place.
    ROTATING: ClassVar[Motion]
    #: A body that keeps its orientation.
    TRANSLATING: ClassVar[Motion]
    #: A body that stays in its place.
    PINNED: ClassVar[Motion]
    #: A body that moves along x and y and turns about its last principal axis, which must be along z. It is that across
    #: a flat body, and one of those across a line.
    IN_PLANE: ClassVar[Motion]

    def __post_init__(self) -> None:
        for name in ("translations", "rotations"):
            object.__setattr__(self, name, _axes(name, getattr(self, name)))


def _axes(name: str, values: Sequence[bool]) -> Axes:
    """Return three values of True or False as a tuple.

    Raises:
        TypeError: they are something else.
    """
    allowed = np.asarray(values)
    if allowed.dtype != bool or allowed.shape != (3,):
        raise TypeError(f"{name} must be three values of True or False, one for each axis, got {values!r}")
    x, y, z = allowed.tolist()
    return x, y, z


Motion.FREE = Motion()
Motion.ROTATING = Motion(translations=NONE)
Motion.TRANSLATING = Motion(rotations=NONE)
Motion.PINNED = Motion(NONE, NONE)
Motion.IN_PLANE = Motion((True, True, False), (False, False, True))


class Bearings:
    """Bearings of bodies that do not move along or turn about all axes; they take up forces and torques along the rest.

    They take up momenta too, such as those of velocities that a user sets.

    Attributes:
        columns: of the bodies with bearings, ascending, (k,).
    """

    def __init__(self, translations: np.ndarray, rotations: np.ndarray, columns: np.ndarray) -> None:
        """
        Args:
            translations: whether each of all bodies moves along x, y and z, (3, n).
            rotations: whether each turns about its principal axes, (3, n).
            columns: of the bodies with bearings, ascending, (k,).
        """
        self.columns = columns
        self._translations = translations[:, columns]
        self._rotations = rotations[:, columns]

    def remove(self, p: np.ndarray, L: np.ndarray, A: np.ndarray) -> None:
        """Remove the parts that bearings take up from momenta or forces, and angular momenta or torques, (3, n)."""
        held = self.columns
        frames = A[:, :, held]
        p[:, held] *= self._translations
        L[:, held] = combine(self._rotations * body_frame(frames, L[:, held]), *frames)
