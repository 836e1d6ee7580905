"""Compilation by Numba, and the compiled code that is kept on disk by Numba's own cache.

The cache is in `NUMBA_CACHE_DIR` if that is set, and otherwise where the platform keeps caches: in `XDG_CACHE_HOME` or
`~/.cache` on Linux, in `~/Library/Caches` on macOS, in `%LOCALAPPDATA%` on Windows. Numba would choose the folder of
the sources, where `pip uninstall` leaves its files behind, and with them an empty package of this name.
"""

import hashlib
import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from threading import Timer
from typing import Any

import numba
from numba.core.caching import FunctionCache

#: Numba's settings, by the names of its environment variables.
config: Any = numba.config

#: Sums and products may be contracted, but not reordered, so that results of processors agree to rounding.
OPTIONS: dict[str, Any] = {"fastmath": {"contract", "nsz"}, "error_model": "numpy", "nogil": True}

#: Seconds after which a user is told why the program waits.
PATIENCE = 2.0

#: Compiles a function into each kernel that calls it.
inlined = numba.njit(forceinline=True, **OPTIONS)

#: Compiles a function that kernels call.
called = numba.njit(**OPTIONS)


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function compiled by Numba at its first call, and kept on disk where a directory can be written.

    Where there can be no cache, every process compiles.
    """
    if config.DISABLE_JIT:
        return function
    compiled: Any = numba.njit(function, **OPTIONS)
    try:
        with _cache_directory():
            # What `cache=True` sets.
            compiled._cache = _Cache(function)
    except RuntimeError as error:
        _warn_of_no_cache(error)
    is_new = True

    def call(*arguments: Any) -> Any:
        nonlocal is_new
        if not is_new:
            return compiled(*arguments)
        with _announced():
            result = compiled(*arguments)
        is_new = False
        return result

    return call


class _Cache(FunctionCache):
    """Numba's cache on disk, whose files may be damaged, and whose disk may be full.

    Numba raises what goes wrong with them, from the call of a kernel. To catch it there would take every error in a
    kernel, or a fault of the machine, for one of its files, and compile all again.
    """

    def load_overload(self, *arguments: Any) -> Any:
        """Return what is kept, or None; a damaged cache, such as one of a machine that stopped, is begun anew."""
        try:
            return super().load_overload(*arguments)
        except Exception:
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, *arguments: Any) -> None:
        """Keep what is compiled, if that is possible."""
        try:
            super().save_overload(*arguments)
        except Exception as error:
            _warn_of_no_cache(error)


@contextmanager
def _announced() -> Iterator[None]:
    """Say what the program waits for, if it takes long."""
    timer = Timer(PATIENCE, _announce)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@cache
def _announce() -> None:
    """Say once that kernels are compiled."""
    logging.getLogger(__name__).warning(
        f"Compiling the motion of bodies for this processor, which can take a minute. {_directory()} keeps it for "
        "later runs."
    )


def _warn_of_no_cache(error: Exception) -> None:
    warnings.warn(
        f"each process compiles its kernels again, since they cannot be kept on disk ({error}): set NUMBA_CACHE_DIR to "
        "a directory that can be written",
        stacklevel=4,
    )


@contextmanager
def _cache_directory() -> Iterator[None]:
    """Let Numba keep the functions that are made meanwhile in our directory."""
    before, config.CACHE_DIR = config.CACHE_DIR, str(_directory())
    try:
        yield
    finally:
        config.CACHE_DIR = before


def _directory() -> Path:
    """Return the directory for what is compiled of the present sources.

    Numba itself watches the file of a kernel, and not those of the functions that it calls.
    """
    return Path(config.CACHE_DIR or _user_cache() / "openmm_sier") / _digest()


def _user_cache() -> Path:
    """Return the directory where the platform keeps a user's caches."""
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


@cache
def _digest() -> str:
    """Return a digest of the sources of all that is compiled."""
    folder = Path(__file__).parent
    sources = (*sorted(folder.glob("*.py")), folder.parent / "vectors.py")
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:12]
