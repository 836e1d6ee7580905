"""Frictions of heat baths: one for all bodies, or those of types, along and about the axes of their bodies."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from openmm_sier.dynamics.bodies import BodySet

#: Friction of all bodies, or by the names of types along the principal axes or about them, 1/ps.
Friction = float | Mapping[str, tuple[float, float, float]]

#: In place of the name of a type: bodies whose type is not named, or that have none.
OTHERS = "default"


def frictions_of(name: str, friction: Friction, bodies: BodySet) -> np.ndarray:
    """Return the friction of each body along or about its principal axes, (3, n), 1/ps.

    Args:
        name: by which users know the friction.
        friction: of all bodies, or of types.
        bodies: the bodies.

    Raises:
        ValueError: a type is named that no body has, or no friction is given for a body.
    """
    result = np.empty((3, bodies.n))
    if not isinstance(friction, Mapping):
        result[:] = friction
        return result
    known = {species.name for species in bodies.species} - {""}
    for unknown in friction.keys() - known - {OTHERS}:
        raise ValueError(
            f"{name} names the type {unknown!r}, but the bodies have {', '.join(sorted(known)) or 'no types'}"
        )
    for species, numbers in zip(bodies.species, bodies.numbers, strict=True):
        rates = friction.get(species.name, friction.get(OTHERS))
        if rates is None:
            raise ValueError(
                f"{name} has no friction for {bodies.describe(int(numbers[0]))}: name its type, or give a friction for "
                f"{OTHERS!r}"
            )
        result[:, numbers] = np.reshape(rates, (3, 1))
    return result


def refuse_uneven_friction(name: str, frictions: np.ndarray, bodies: BodySet) -> None:
    """Refuse frictions that differ within a molecule of points that constraints join.

    The noise on constrained momenta is thermal only where all have one friction.

    Args:
        name: by which users know the friction.
        frictions: of translation, (3, n).
        bodies: the bodies.

    Raises:
        ValueError: frictions differ.
    """
    one, other = bodies.links[0].T
    uneven = np.ptp(np.concatenate([frictions[:, one], frictions[:, other]]), axis=0) > 0
    if uneven.any():
        raise ValueError(
            f"{name} must be one number for {bodies.describe(one[uneven.argmax()])} and "
            f"{bodies.describe(other[uneven.argmax()])}, which a constraint joins"
        )
