"""Values of OpenMM's quantities."""

from __future__ import annotations

from typing import Any

from openmm import unit


def md(quantity: Any) -> Any:
    """The number or the array of a quantity in OpenMM's units (nm, ps, dalton, kJ/mol, e); numbers are in them."""
    return quantity.value_in_unit_system(unit.md_unit_system) if unit.is_quantity(quantity) else quantity
