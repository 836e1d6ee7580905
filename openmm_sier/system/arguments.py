"""Check and convert arguments of integrators."""

import math
import numbers
import operator
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.schemes import CATALOGUE, Scheme

#: Values of the argument `bodies` of `prepare_system`, which asks only for the particles of each body.
Bodies = BodySet | Sequence[Sequence[int]] | None

#: Values of the argument `fastForceGroups` of integrators: numbers of groups, or a bit mask.
ForceGroups = Iterable[int] | int

#: A quantity of OpenMM, or a number in the unit of the argument.
Quantity = unit.Quantity | float

#: A friction in 1/ps, or by the names of types a number or three.
Frictions = Quantity | Mapping[str, Any]

#: Positions (N, 3) in nm, such as OpenMM's lists of Vec3, or a quantity of these.
Positions = unit.Quantity | np.ndarray | Sequence[Sequence[float]]

#: Number of force groups in OpenMM.
GROUPS = 32


def checked_bodies(bodies: Bodies) -> Bodies:
    """Return bodies as `RigidBodies`, lists of integers, or None.

    Raises:
        TypeError: `bodies` is none of these, or a mask of booleans.
    """
    return bodies if bodies is None or isinstance(bodies, BodySet) else checked_clusters(bodies)


def checked_clusters(bodies: Any) -> list[list[int]]:
    """Return bodies as lists of integers.

    Raises:
        TypeError: `bodies` is something else, or a mask of booleans.
    """
    try:
        clusters = [list(cluster) for cluster in bodies]
        types = set(map(type, chain.from_iterable(clusters)))
        if types - {int}:
            clusters = [list(map(operator.index, cluster)) for cluster in clusters]
    except TypeError:
        raise TypeError(f"bodies must be RigidBodies or lists of particle indices, got {bodies!r}") from None
    if bool in types:
        raise TypeError("bodies must be RigidBodies or lists of particle indices, got a mask of True and False")
    return clusters


def rigid_bodies(bodies: Any) -> BodySet | None:
    """Return the argument `bodies` of an integrator.

    Raises:
        TypeError: it is neither `RigidBodies` nor None.
    """
    if bodies is None or isinstance(bodies, BodySet):
        return bodies
    raise TypeError(
        f"bodies must be RigidBodies, got {repr(bodies)[:80]}. Bodies named by their particles take their shape from "
        "positions: bodies=RigidBodies.from_system(system, topology, rigid, positions)"
    )


def checked_system(system: Any) -> openmm.System:
    """Return an openmm.System unchanged, and refuse anything else.

    Raises:
        TypeError: `system` is something else, such as a Simulation.
    """
    if isinstance(system, openmm.System):
        return system
    remedy = ""
    if hasattr(system, "system") or hasattr(system, "getSystem"):
        remedy = ": give the System itself, before the Simulation or Context is made"
    raise TypeError(f"system must be an openmm.System, got a {type(system).__name__}{remedy}")


def checked_positions(positions: Any, n: int) -> np.ndarray:
    """Return a copy of positions, a quantity or numbers in nm, as an array of shape (n, 3).

    Raises:
        ValueError: `positions` has another shape.
    """
    factor = 1.0
    if unit.is_quantity(positions):
        factor = positions.unit.conversion_factor_to(unit.nanometer)
        # `value_in_unit` would copy lists deeply, vector by vector.
        positions = positions._value
    if isinstance(positions, list) and set(map(type, positions)) == {openmm.Vec3}:
        coordinates = vectors_to_array(positions)
    else:
        coordinates = np.array(positions, dtype=float)
    coordinates *= factor
    if coordinates.shape != (n, 3):
        raise ValueError(f"positions must have the shape ({n}, 3), one row per particle, got {coordinates.shape}")
    return coordinates


def vectors_to_array(vectors: Sequence[openmm.Vec3]) -> np.ndarray:
    """Return vectors as OpenMM gives them as an array, (N, 3), ten times as fast as `np.array`."""
    return np.fromiter(chain.from_iterable(vectors), float, 3 * len(vectors)).reshape(-1, 3)


def checked_scheme(scheme: Any) -> Scheme:
    """Return a scheme for a Scheme or its case-insensitive name.

    Raises:
        ValueError: no scheme has that name.
        TypeError: `scheme` is neither.
    """
    if isinstance(scheme, Scheme):
        return scheme
    if not isinstance(scheme, str):
        raise TypeError(f"scheme must be a Scheme or its name, as in SIERIntegrator(0.004, SIER4G), got {scheme!r}")
    if (named := CATALOGUE.get(scheme.lower())) is None:
        names = ", ".join(entry.name for entry in CATALOGUE.values())
        raise ValueError(f"scheme must be one of {names}, got {scheme!r}")
    return named


def step_size(size: Any) -> float:
    """Return a step in ps, from a quantity or a number; see `quantity_to_float`."""
    if unit.is_quantity(size) and size.unit.is_compatible(unit.kelvin):
        raise TypeError(
            f"stepSize must be a time, got the temperature {size}. For a heat bath use "
            "SIERLangevinIntegrator(300*kelvin, 1/picosecond, 4*femtoseconds)"
        )
    size = quantity_to_float("stepSize", size, unit.picosecond, "ps")
    if size < 0:
        raise ValueError(f"stepSize must not be negative, got {size} ps. To run backwards, reverse the velocities")
    return size


def quantity_to_float(name: str, value: Any, of: unit.Unit, symbol: str) -> float:
    """Return a finite number in a unit, from a quantity or a plain number."""
    if unit.is_quantity(value):
        if not value.unit.is_compatible(of):
            raise TypeError(f"{name} must be in units like {symbol}, got {value}")
        value = value.value_in_unit(of)
    # float() would accept strings, which hides a missing conversion, and take True for 1.
    wrong = TypeError(f"{name} must be a quantity or a number in {symbol}, got {value!r}")
    if isinstance(value, str | bytes | bool):
        raise wrong
    try:
        value = float(value)
    except OverflowError:
        value = math.inf
    except (TypeError, ValueError):
        raise wrong from None
    if not math.isfinite(value):
        raise ValueError(f"{name} must be finite, got {value} {symbol}")
    return value


def along_axes(name: str, value: Any, of: unit.Unit, symbol: str) -> tuple[float, float, float]:
    """Return numbers in a unit along three axes, none negative, from three or from one for all axes.

    Raises:
        ValueError: there are neither one nor three, or a number is negative or not finite.
        TypeError: a value is no number, or its quantity has the wrong dimension.
    """
    try:
        values = [value] * 3 if isinstance(value, str) else list(value)
    except TypeError:
        values = [value] * 3
    if len(values) != 3:
        raise ValueError(f"{name} must be one number or three, along the axes of the body, got {value!r}")
    x, y, z = (quantity_to_float(name, each, of, symbol) for each in values)
    if min(x, y, z) < 0:
        raise ValueError(f"{name} must not be negative, got {value} {symbol}")
    return x, y, z


def whole_number(name: str, value: Any, least: int = 0, most: float = math.inf) -> int:
    """Return a nonnegative integer within bounds, from an int or an integral float.

    Raises:
        ValueError: `value` is something else, True and False included, or out of bounds.
    """
    is_whole = isinstance(value, numbers.Integral) or (isinstance(value, numbers.Real) and float(value).is_integer())
    if not is_whole or isinstance(value, bool) or value < 0:
        raise ValueError(f"{name} must be a whole number of at least 0, got {value!r}")
    if value < least:
        raise ValueError(f"{name} must be at least {least}, got {value}")
    if value > most:
        raise ValueError(f"{name} must be at most {most}, got {value}")
    return int(value)


def group_mask(name: str, groups: ForceGroups) -> int:
    """Return force groups as a bit mask, from a set of numbers or a mask.

    Raises:
        ValueError: a group is not from 0 to 31.
        TypeError: `groups` is neither a set of numbers nor a mask.
    """
    if isinstance(groups, int):
        if not 0 <= groups < 2**GROUPS:
            raise ValueError(f"{name} must be a set of force groups or a bit mask below 2^{GROUPS}, got {groups}")
        return groups
    try:
        group_numbers = {operator.index(group) for group in groups}
    except TypeError:
        raise TypeError(f"{name} must be a set of force groups, such as {{1}}, got {groups!r}") from None
    if wrong := [group for group in group_numbers if not 0 <= group < GROUPS]:
        raise ValueError(f"{name} must be from 0 to {GROUPS - 1}, got {wrong[0]}")
    return sum(1 << group for group in group_numbers)


def groups_of(mask: int) -> list[int]:
    """Return the force groups of a bit mask, ascending."""
    return [group for group in range(GROUPS) if mask >> group & 1]
