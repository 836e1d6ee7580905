"""Functions of this package compiled by Numba together with all that they call, and kept on disk (`numba_cache`)."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

#: Sums and products may be contracted, but not reordered, so that NumPy and Numba agree to rounding.
OPTIONS: dict[str, Any] = {"fastmath": {"contract", "nsz"}, "error_model": "numpy", "nogil": True}

#: Functions already given to Numba, by name and whether they are inlined.
_given: dict[tuple[str, bool], Any] = {}


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

    def link(function: FunctionType) -> FunctionType:
        """The function, calling compiled functions."""
        namespace = dict(_globals_of(function, replaced))
        for name, value in namespace.items():
            if isinstance(value, FunctionType):
                key = _name(value, replaced), value.__module__ != loop.__module__
                if key not in _given:
                    _given[key] = numba.njit(link(value), forceinline=key[1], **OPTIONS)
                namespace[name] = _given[key]
        clone = FunctionType(function.__code__, namespace, function.__name__, function.__defaults__)
        # Code from the disk is linked by names, which must not be those of other code that this process has compiled.
        clone.__module__, clone.__qualname__ = function.__module__, _name(function, replaced)
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


def _name(function: FunctionType, replaced: Mapping[Any, Any]) -> str:
    """The function's name with a digest of its code and constants and of all that it calls.

    The cache on disk watches only a loop's own file, and code in it is linked by names.
    """
    seen: dict[FunctionType, None] = {function: None}
    parts = [Path(__file__).read_bytes()]
    for called in (pending := list(seen)):
        code = called.__code__
        parts.append(repr((called.__module__, code.co_code, code.co_consts, code.co_names)).encode())
        for name, value in _globals_of(called, replaced):
            if isinstance(value, FunctionType):
                if value not in seen:
                    seen[value] = None
                    pending.append(value)
            elif not isinstance(value, ModuleType):
                parts.append(f"{name} = {getattr(value, '_fields', value)!r}".encode())
    return f"{function.__name__}_{hashlib.sha256(b''.join(parts)).hexdigest()[:12]}"
