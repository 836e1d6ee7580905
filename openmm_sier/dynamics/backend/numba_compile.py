"""Functions of this folder compiled by Numba together with all that they call, and kept on disk (`numba_cache`)."""

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any

from openmm_sier.dynamics.backend import constraint_solver, numba_loops

#: Sums and products may be contracted, but not reordered, so that NumPy and Numba agree to rounding.
OPTIONS: dict[str, Any] = {"fastmath": {"contract", "nsz"}, "error_model": "numpy", "nogil": True}

#: Functions on arrays that are faster as loops. Compiled as they are, `lengths_after` makes a drift with constraints
#: 1.03 to 1.14 times as long, `linear_equations` 1.1 to 1.2 times, and `solution` 1.8 times with 15 constraints.
LOOPS: dict[Any, Any] = {
    getattr(constraint_solver, name): getattr(numba_loops, name)
    for name in ("pushed", "lengths_after", "taken", "put", "linear_equations", "solution")
}


def compiled(function: FunctionType) -> Callable[..., Any]:
    """A function compiled, and kept on disk where a directory for it can be written.

    Functions of its own module that it calls are compiled separately; those of other modules, which are formulas for
    one body, are inlined.
    """
    import numba

    from openmm_sier.dynamics.backend.numba_cache import UserCache

    linked = _linked(function)
    dispatcher: Any = numba.njit(linked, **OPTIONS)
    dispatcher._cache = UserCache(linked.__qualname__)
    return dispatcher


@cache
def _called(function: FunctionType, is_inlined: bool) -> Any:
    import numba

    return numba.njit(_linked(function), forceinline=is_inlined, **OPTIONS)


def _linked(function: FunctionType) -> FunctionType:
    """The function, calling compiled functions."""
    namespace = dict(function.__globals__)
    for name in function.__code__.co_names:
        value = namespace.get(name)
        if isinstance(value, FunctionType):
            chosen = LOOPS.get(value, value)
            namespace[name] = _called(chosen, chosen.__module__ != function.__module__)
    linked = FunctionType(function.__code__, namespace, function.__name__, function.__defaults__)
    # Code from the disk is linked by names, which must not be those of other code that this process has compiled.
    linked.__module__, linked.__qualname__ = function.__module__, f"{function.__name__}_{_version()}"
    return linked


@cache
def _version() -> str:
    """A digest of all that is compiled: Numba's own cache would watch a single file."""
    sources = sorted(Path(__file__).parent.glob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:12]
