"""Library between OpenMM and OpenCL: compilation, preloading, and counts."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

SOURCE = Path(__file__).with_name("commands.c")

#: The compiled library.
LIBRARY = f"{SOURCE.stem}.so"

#: What C compilers are called.
COMPILERS = ("cc", "gcc", "clang")


class Commands(NamedTuple):
    """Commands that differ only in their sizes.

    Attributes:
        kind: kernel, read, write, copy, map or wait.
        kernel: its name.
        is_blocking: whether OpenMM goes on only when it is done, and with it everything that was sent before.
        number: how many.
        bytes: of all of them.
    """

    kind: str
    kernel: str
    is_blocking: bool
    number: int
    bytes: int


class _Struct(ctypes.Structure):
    """`struct command` of commands.c."""

    _fields_ = (
        ("kind", ctypes.c_char * 16),
        ("kernel", ctypes.c_char * 112),
        ("is_blocking", ctypes.c_int),
        ("number", ctypes.c_long),
        ("bytes", ctypes.c_long),
    )


def compiler() -> str | None:
    """Return the C compiler that the environment variable CC names, or one that is on the PATH."""
    names = [os.environ.get("CC"), *COMPILERS]
    return next((path for name in names if name and (path := shutil.which(name))), None)


def build(folder: Path, source: Path = SOURCE) -> Path:
    """Compile a library into a folder, and return its path.

    Raises:
        OSError: there is no C compiler, or it fails.
    """
    if (program := compiler()) is None:
        raise OSError(f"no C compiler is on the PATH, neither of {', '.join(COMPILERS)}, nor named by CC: install one")
    path = folder.resolve() / f"{source.stem}.so"
    line = [program, "-O2", "-shared", "-fPIC", "-o", str(path), str(source), "-ldl", "-pthread"]
    process = subprocess.run(line, capture_output=True, text=True, check=False)
    if process.returncode:
        raise OSError(f"{program} cannot compile {source.name}: {process.stderr}")
    return path


class Shim:
    """The library in this process, which was started with it in LD_PRELOAD."""

    def __init__(self) -> None:
        """
        Raises:
            OSError: the library is not in this process.
        """
        self._library = ctypes.CDLL(None)
        if not hasattr(self._library, "stop_counting"):
            raise OSError("this process was started without the library of commands.c in LD_PRELOAD")
        self._library.stop_counting.restype = ctypes.POINTER(_Struct)
        for time_of in (self._library.seconds_in_opencl, self._library.seconds_in_steps):
            time_of.restype = ctypes.c_double

    def counted(self, action: Callable[[], object]) -> list[Commands]:
        """Do something, and return the commands that it sends."""
        self.finish()
        self._library.start_counting()
        number = ctypes.c_int()
        try:
            action()
        finally:
            commands = self._library.stop_counting(ctypes.byref(number))
        return [
            Commands(each.kind.decode(), each.kernel.decode(), bool(each.is_blocking), each.number, each.bytes)
            for each in commands[: number.value]
        ]

    def finish(self) -> None:
        """Wait for the device."""
        self._library.finish_commands()

    def python_time(self, action: Callable[[], object], calls: Iterable[tuple[Any, str]]) -> float:
        """Do something, and return the processor time of this thread outside C++ and OpenCL, s.

        Args:
            action: makes steps.
            calls: functions that call C++, each as an object and the name of its attribute.
        """
        self.finish()
        within: list[float] = []
        with ExitStack() as stack:
            for owner, name in calls:
                stack.enter_context(self._timed(owner, name, within))
            start, opencl = time.thread_time(), self._library.seconds_in_opencl()
            action()
            opencl = self._library.seconds_in_opencl() - opencl
            total = time.thread_time() - start
        return total - opencl - sum(within)

    def host_time(self, action: Callable[[], object]) -> float:
        """Do something, and return the time of steps within it outside of OpenMM's forces and of OpenCL, s."""
        start = self._library.seconds_in_steps()
        action()
        return float(self._library.seconds_in_steps() - start)

    def drop_commands(self) -> None:
        """Forget all commands from now on, after at least one. The Context is of no use then."""
        self.finish()
        self._library.drop_commands()

    @contextmanager
    def _timed(self, owner: Any, name: str, within: list[float]) -> Iterator[None]:
        """Record the processor time of each call of a function, without its part in OpenCL, s.

        The program waits for the device after each call, so that the next one does not.
        """
        original, seconds = getattr(owner, name), self._library.seconds_in_opencl

        def timed(*arguments: Any, **options: Any) -> Any:
            start, opencl = time.thread_time(), seconds()
            try:
                return original(*arguments, **options)
            finally:
                opencl = seconds() - opencl
                self.finish()
                within.append(time.thread_time() - start - opencl)

        setattr(owner, name, timed)
        try:
            yield
        finally:
            setattr(owner, name, original)
