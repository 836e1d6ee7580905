"""Functions of this folder compiled by Numba together with all that they call, and kept on disk by Numba's own cache.

The cache is in `NUMBA_CACHE_DIR` if that is set, and otherwise where the platform keeps caches: in `XDG_CACHE_HOME` or
`~/.cache` on Linux, in `~/Library/Caches` on macOS, in `%LOCALAPPDATA%` on Windows. Numba would choose the folder of
the sources, where `pip uninstall` leaves its files behind, and with them an empty package of this name.
"""

import hashlib
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
    """Return a function compiled, and kept on disk where a directory for it can be written.

    Functions of its own module that it calls are compiled separately; those of other modules, which are formulas for
    one body, are inlined.
    """
    return with_cache(_linked(function))


def with_cache(function: FunctionType) -> Callable[..., Any]:
    """Return a function compiled by Numba, which goes on without a cache where that fails.

    Numba raises what goes wrong with its files: one that was cut off when the machine stopped, a full disk. A damaged
    cache is begun anew, once.
    """
    import numba

    try:
        with _cache_directory():
            chosen = numba.njit(function, cache=True, **OPTIONS)
    except RuntimeError as error:
        _tell_of_no_cache(error)
        return numba.njit(function, **OPTIONS)

    def call(*arguments: Any) -> Any:
        nonlocal chosen
        try:
            return chosen(*arguments)
        except Exception:
            try:
                chosen.recompile()
                return chosen(*arguments)
            except OSError as error:
                _tell_of_no_cache(error)
            chosen = numba.njit(function, **OPTIONS)
            return chosen(*arguments)

    return call


def _tell_of_no_cache(error: Exception) -> None:
    warnings.warn(
        f"each process compiles its loops again, since they cannot be kept on disk ({error}): set NUMBA_CACHE_DIR to "
        "a directory that can be written",
        stacklevel=4,
    )


@contextmanager
def _cache_directory() -> Iterator[None]:
    """Let Numba choose the user's cache directory for the functions that are made meanwhile."""
    import numba

    config: Any = numba.config
    before = config.CACHE_DIR
    config.CACHE_DIR = before or str(_user_cache() / "openmm_sier")
    try:
        yield
    finally:
        config.CACHE_DIR = before


def _user_cache() -> Path:
    """Return the directory where the platform keeps a user's caches."""
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


@cache
def _called(function: FunctionType, is_inlined: bool) -> Any:
    import numba

    return numba.njit(_linked(function), forceinline=is_inlined, **OPTIONS)


def _linked(function: FunctionType) -> FunctionType:
    """Return the function with compiled functions in place of those that it calls.

    So formulas are plain functions, which NumPy executes without Numba being imported.
    """
    namespace = dict(function.__globals__)
    for name in function.__code__.co_names:
        value = namespace.get(name)
        if isinstance(value, FunctionType):
            chosen = LOOPS.get(value, value)
            namespace[name] = _called(chosen, chosen.__module__ != function.__module__)
    linked = FunctionType(function.__code__, namespace, function.__name__, function.__defaults__)
    # Numba's cache finds code by this name, and watches the file of the function alone.
    linked.__module__, linked.__qualname__ = function.__module__, f"{function.__name__}_{_version()}"
    return linked


@cache
def _version() -> str:
    """Return a digest of all that is compiled."""
    sources = sorted(Path(__file__).parent.glob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:12]
