"""Frictions of a heat bath from diffusion constants of bodies."""

import numpy as np
from openmm import unit

from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.system.arguments import Quantity, along_axes, quantity_to_float
from openmm_sier.system.body_types import BodyType


def translational_friction(kind: BodyType, diffusion: Quantity, temperature: Quantity) -> unit.Quantity:
    """Return the friction with which a bath gives bodies of a type a diffusion constant, kT/(m D).

    >>> rod = BodyType("rod", [[-0.2, 0, 0], [0, 0, 0], [0.2, 0, 0]], [12, 16, 12])
    >>> friction = translational_friction(rod, (0.0025, 0.00125, 0.00125), 300*kelvin)
    >>> print(*(rate.format("%.2f") for rate in friction))
    24.94 /ps 49.89 /ps 49.89 /ps
    >>> integrator = SIERLangevinIntegrator(300*kelvin, {"rod": friction}, 4*femtoseconds)

    It is that of a body which no other one touches. Steps of h make diffusion faster by (gamma h/2) coth(gamma h/2).

    Args:
        kind: the type.
        diffusion: one number, or three along the principal axes of the body, by ascending moments, all above zero; a
            quantity or numbers in nm^2/ps.
        temperature: of the bath, a quantity or a number in K.

    Returns:
        Three frictions, a quantity in 1/ps, for `frictionCoeff` of `SIERLangevinIntegrator`.

    Raises:
        ValueError: a number is not positive or not finite.
        TypeError: a quantity has the wrong dimension.
    """
    values = along_axes("diffusion", diffusion, unit.nanometer**2 / unit.picosecond, "nm^2/ps")
    inertia = np.full(3, kind.mass)
    return _friction(values, inertia, temperature)


def rotational_friction(kind: BodyType, diffusion: Quantity, temperature: Quantity) -> unit.Quantity:
    """Return the friction with which a bath gives bodies of a type a rotational diffusion constant, kT/(I D).

    >>> rod = BodyType("rod", [[-0.2, 0, 0], [0, 0, 0], [0.2, 0, 0]], [12, 16, 12])
    >>> print(*(rate.format("%.2f") for rate in rotational_friction(rod, 0.1, 300*kelvin)))
    0.00 /ps 25.98 /ps 25.98 /ps

    See `translational_friction`, also for errors.

    Args:
        kind: the type.
        diffusion: one number, or three about the principal axes, by ascending moments, a quantity or numbers in
            rad^2/ps. Those about axes about which the body does not turn have no effect.
        temperature: of the bath, a quantity or a number in K.

    Returns:
        Three frictions, a quantity in 1/ps, for `rotationalFriction` of `SIERLangevinIntegrator`.
    """
    values = along_axes("diffusion", diffusion, unit.picosecond**-1, "rad^2/ps")
    return _friction(values, kind.principal_moments, temperature)


def _friction(diffusion: tuple[float, float, float], inertia: np.ndarray, temperature: Quantity) -> unit.Quantity:
    """Return kT/(inertia D) along or about three axes; 0 for those without inertia."""
    if not min(diffusion) > 0:
        raise ValueError(f"diffusion must be above zero: zero would need an infinite friction, got {diffusion}")
    thermal = GAS_CONSTANT * quantity_to_float("temperature", temperature, unit.kelvin, "K")
    if not thermal > 0:
        raise ValueError(f"temperature must be above zero, got {temperature}")
    products = inertia * diffusion
    frictions = np.divide(thermal, products, out=np.zeros(3), where=products > 0)
    return unit.Quantity(tuple(frictions.tolist()), unit.picosecond**-1)
