"""Compiled code on disk, in the cache directory of the user.

It is in `NUMBA_CACHE_DIR` if that is set, otherwise where the platform keeps caches: in `XDG_CACHE_HOME` or `~/.cache`
on Linux, in `~/Library/Caches` on macOS, in `%LOCALAPPDATA%` on Windows. Where nothing can be written, every process
compiles anew.
"""

import hashlib
import os
import pickle
import sys
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any
from uuid import uuid4

import numba
from numba.core import config, serialize
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.misc.appdirs import AppDirs


class UserCache(NullCache):
    """What Numba asks for compiled code of one function.

    Numba's own cache is beside the source file, where uninstalling leaves it behind. It also has an index of signatures
    in each function, which two processes that write at once can mix up. Here each signature has a file of its own,
    whose name says all that the code depends on, so that versions of the package, of Python and of Numba, and machines
    that share a home, cannot meet.

    Args:
        name: of the function; it tells different code apart.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    @property
    def cache_path(self) -> str:
        """The directory of the files."""
        root = vars(config)["CACHE_DIR"] or AppDirs("openmm_sier", appauthor=False).user_cache_dir
        return os.path.join(root, f"openmm_sier-numba-{numba.__version__}")

    def load_overload(self, signature: Any, target: Any) -> Any:
        """The code for a signature, or None."""
        target.refresh()
        try:
            return CompileResult._rebuild(target, *pickle.loads(self._file(signature, target.codegen()).read_bytes()))
        except Exception:
            # There is none, it may not be read, or the machine stopped while it was written: it is compiled anew.
            return None

    def save_overload(self, signature: Any, result: Any) -> None:
        """Keep the code for a signature."""
        path = self._file(signature, result.codegen)
        unfinished = path.with_name(f"{path.name}.{uuid4().hex}")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            unfinished.write_bytes(serialize.dumps(result._reduce()))
            unfinished.replace(path)
        except OSError as error:
            with suppress(OSError):
                unfinished.unlink()
            warnings.warn(
                f"every process compiles its loops anew, since they cannot be kept in {self.cache_path} "
                f"({error.strerror}): let NUMBA_CACHE_DIR name a directory that can be written",
                stacklevel=2,
            )

    def _file(self, signature: Any, codegen: Any) -> Path:
        # Numba's types have names that tell them apart. The magic tuple is the processor.
        depends = repr((signature, codegen.magic_tuple(), sys.implementation.cache_tag))
        return Path(self.cache_path, f"{self._name}.{hashlib.sha256(depends.encode()).hexdigest()[:16]}.nbc")
