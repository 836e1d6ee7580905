"""OpenMM's own methods of a Context, for engines.

`hooks` replaces some methods of Context, so that integrators learn what users do. What an engine does itself is no news
to it. So engines call these, which are OpenMM's whichever module was imported first.
"""

import inspect
from collections.abc import Callable
from typing import Any

import openmm


def own_method(cls: type, name: str) -> Callable[..., Any]:
    """Return a method of a class of OpenMM as it was before `hooks` replaced it."""
    return inspect.unwrap(getattr(cls, name), stop=lambda function: not is_replaced(function))


def is_replaced(function: Callable[..., Any]) -> bool:
    """Return whether a function is what `hooks` has put in the place of a method."""
    return getattr(function, "_of_openmm_sier", False)


def mark_as_replaced(function: Callable[..., Any]) -> None:
    """Let `is_replaced` know a function, which has the method as its `__wrapped__`."""
    function._of_openmm_sier = True  # type: ignore[attr-defined]


get_state = own_method(openmm.Context, "getState")
set_positions = own_method(openmm.Context, "setPositions")
set_velocities = own_method(openmm.Context, "setVelocities")
set_box = own_method(openmm.Context, "setPeriodicBoxVectors")
constrain_positions = own_method(openmm.Context, "applyConstraints")
constrain_velocities = own_method(openmm.Context, "applyVelocityConstraints")
