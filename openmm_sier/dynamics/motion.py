"""Translations and rotations that bodies have: those of a free body, or fewer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

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
