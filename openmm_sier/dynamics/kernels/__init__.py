"""Kernels: functions of one body, or of one constraint, and the loops over them, which Numba compiles.

A kernel is compiled when it is first called and kept on disk (`compilation`). With NUMBA_DISABLE_JIT=1 in the
environment Python executes all of this itself, some hundred times slower, and a debugger can step through it.

The modules of this package are imported when they are first needed, as `kernels.bodies.drift(...)`: Numba takes a
second to import, and most commands move no body.
"""

from importlib import import_module
from types import ModuleType


def __getattr__(name: str) -> ModuleType:
    """Import a module of this package."""
    if name in ("atoms", "bodies", "constraints"):
        return import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
