"""Compilation by Numba, with its cache of compiled code on disk.

The cache is in `NUMBA_CACHE_DIR` if that is set, and otherwise where the platform keeps caches: in `XDG_CACHE_HOME` or
`~/.cache` on Linux, in `~/Library/Caches` on macOS, in `%LOCALAPPDATA%` on Windows. Numba would choose the folder of
the sources, where `pip uninstall` leaves its files behind, and with them an empty package of this name.

Code in the cache is executed, so that a directory is used only if nobody else can write it.
"""

import hashlib
import logging
import os
import stat
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from threading import Timer
from typing import Any

import numba
from numba.core import event as events
from numba.core.caching import FunctionCache
from numba.core.runtime import rtsys

#: Numba's settings, by the names of its environment variables.
config: Any = numba.config

#: Sums and products may be contracted, but not reordered, so that results of processors agree to rounding.
OPTIONS: dict[str, Any] = {"fastmath": {"contract", "nsz"}, "error_model": "numpy", "nogil": True}

#: Seconds of compilation after which a message is logged.
PATIENCE = 2.0

#: Compiles a function into each kernel that calls it.
inlined = numba.njit(forceinline=True, **OPTIONS)

#: Compiles a function that kernels call.
called = numba.njit(**OPTIONS)


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that Numba compiles at its first call, and stores on disk.

    Without a directory that can be written, every process compiles.
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
    return compiled


class _Cache(FunctionCache):
    """Numba's cache on disk, which continues if files are damaged or the disk is full.

    Numba raises such errors from the call of a kernel, where they cannot be distinguished from errors of the kernel.
    """

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Return compiled code, or None; a damaged cache, as of a machine that stopped, is cleared.

        Numba's method first registers all functions that Numba can compile, which takes half a second. Compiled code
        needs only its memory manager.
        """
        try:
            rtsys.initialize(target)
            return self._load_overload(signature, target)
        except Exception:
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, *arguments: Any) -> None:
        """Store compiled code if possible."""
        try:
            super().save_overload(*arguments)
        except Exception as error:
            _warn_of_no_cache(error)


class _Announcer(events.Listener):
    """A listener to Numba's compiler, which logs a message if the compilation of a kernel takes long."""

    def __init__(self) -> None:
        self._timers: dict[Any, Timer] = {}

    def on_start(self, event: Any) -> None:
        dispatcher = event.data["dispatcher"]
        # Loops that Numba lifts have no cache.
        if isinstance(getattr(dispatcher, "_cache", None), _Cache):
            timer = Timer(PATIENCE, _announce)
            timer.daemon = True
            timer.start()
            self._timers[dispatcher] = timer

    def on_end(self, event: Any) -> None:
        timer = self._timers.pop(event.data["dispatcher"], None)
        if timer is not None:
            timer.cancel()


events.register("numba:compile", _Announcer())


@cache
def _announce() -> None:
    """Log once that kernels are compiled."""
    logging.getLogger(__name__).warning(
        f"Compiling the motion of bodies for this processor, which can take a minute. {_directory()} keeps it for "
        "later runs."
    )


def _warn_of_no_cache(error: Exception) -> None:
    warnings.warn(
        f"each process compiles its kernels again, since they cannot be kept on disk ({error}): set NUMBA_CACHE_DIR to "
        "a directory that you alone can write",
        stacklevel=4,
    )


@contextmanager
def _cache_directory() -> Iterator[None]:
    """Let Numba store functions that are compiled meanwhile in the directory of this package.

    Raises:
        RuntimeError: the directory cannot be made, or others can write it.
    """
    before, config.CACHE_DIR = config.CACHE_DIR, str(_private(_directory()))
    try:
        yield
    finally:
        config.CACHE_DIR = before


def _private(folder: Path) -> Path:
    """Return a directory, made if there is none, that only this user can write.

    Raises:
        RuntimeError: it cannot be made, or others can write it.
    """
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat()
    except OSError as error:
        raise RuntimeError(str(error)) from error
    # Windows gives each user a cache that others cannot write.
    if sys.platform != "win32" and (status.st_uid != os.geteuid() or status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)):
        raise RuntimeError(f"other users can write {folder}")
    return folder


def _directory() -> Path:
    """Return the directory for compiled code of the present sources.

    Numba itself checks the file of a kernel, and not those of the functions that it calls.
    """
    return Path(config.CACHE_DIR or _user_cache() / "openmm_sier") / _digest()


def _user_cache() -> Path:
    """Return the platform's directory of a user's caches."""
    if sys.platform == "win32":
        return _absolute("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    if sys.platform == "darwin":
        return _home() / "Library" / "Caches"
    return _absolute("XDG_CACHE_HOME") or _home() / ".cache"


def _absolute(variable: str) -> Path | None:
    """Return a directory from the environment; None if it is not set, or relative, which XDG says to ignore."""
    path = Path(os.environ.get(variable, ""))
    return path if path.is_absolute() else None


def _home() -> Path:
    """Return the user's home directory."""
    import pwd

    try:
        return _absolute("HOME") or Path(pwd.getpwuid(os.getuid()).pw_dir)
    except KeyError:
        raise RuntimeError("this user has no home directory") from None


@cache
def _digest() -> str:
    """Return a digest of all compiled sources."""
    folder = Path(__file__).parent
    sources = (*sorted(folder.glob("*.py")), folder.parent / "vectors.py")
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:12]
