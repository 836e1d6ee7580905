"""Functions of this package compiled by Numba together with all that they call, and kept on disk (`numba_cache`)."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

#: Sums and products may be contracted, but not reordered, so that NumPy and Numba agree to rounding.
OPTIONS: dict[str, Any] = {"fastmath": {"contract", "nsz"}, "error_model": "numpy", "nogil": True}

#: Formulas already given to Numba.
_formulas: dict[FunctionType, Any] = {}


def compiled(loop: FunctionType, replaced: Mapping[Any, Any]) -> Callable[..., Any]:
    """A loop compiled, and kept on disk where a directory for it can be written.

    Args:
        loop: the function. Those of its own module that it calls are compiled separately; those of other modules, which
            are formulas for one body, are inlined.
        replaced: placeholder functions, and those that replace them.

    Returns:
        A function of the loop's signature.
    """
    import numba

    from openmm_sier.dynamics.backend.numba_cache import UserCache

    helpers: dict[FunctionType, Any] = {}

    def link(function: FunctionType) -> FunctionType:
        """The function, calling compiled functions."""
        namespace = dict(_globals_of(function, replaced))
        for name, value in namespace.items():
            if isinstance(value, FunctionType):
                formula = value.__module__ != loop.__module__
                linked = _formulas if formula else helpers
                if value not in linked:
                    linked[value] = numba.njit(link(value), forceinline=formula, **OPTIONS)
                namespace[name] = linked[value]
        clone = FunctionType(
            function.__code__, namespace, function.__name__, function.__defaults__, function.__closure__
        )
        # Code from the disk is linked by names, which must not be those of other code that this process has compiled.
        clone.__module__ = function.__module__
        clone.__qualname__ = f"{function.__name__}_{_digest(function, replaced)}"
        return clone

    clone = link(loop)
    dispatcher: Any = numba.njit(clone, **OPTIONS)
    dispatcher._cache = UserCache(clone.__qualname__)
    return dispatcher


def _globals_of(function: FunctionType, replaced: Mapping[Any, Any]) -> Iterator[tuple[str, Any]]:
    """The names that a function's code looks up, and what they stand for."""
    for name in function.__code__.co_names:
        if name in function.__globals__:
            value = function.__globals__[name]
            yield name, replaced.get(value, value) if isinstance(value, FunctionType) else value


def _digest(loop: FunctionType, replaced: Mapping[Any, Any]) -> str:
    """A name for the code and constants of a loop and of all that it calls."""
    seen: dict[FunctionType, None] = {loop: None}
    parts = [Path(__file__).read_bytes()]
    for function in (pending := list(seen)):
        code = function.__code__
        enclosed = [cell.cell_contents for cell in function.__closure__ or ()]
        parts.append(repr((code.co_code, code.co_consts, code.co_names, enclosed)).encode())
        for name, value in _globals_of(function, replaced):
            if isinstance(value, FunctionType):
                if value not in seen:
                    seen[value] = None
                    pending.append(value)
            elif not isinstance(value, ModuleType):
                parts.append(f"{name} = {value!r}".encode())
    return hashlib.sha256(b"".join(parts)).hexdigest()[:12]
