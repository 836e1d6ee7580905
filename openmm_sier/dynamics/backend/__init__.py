"""Execution of the costly formulas on all bodies: by NumPy on arrays, or in loops that Numba compiles.

`active()` is the `Backend` in use, chosen at its first call: Numba where it is installed (`openmm-sier[fast]`) and
the environment variable OPENMM_SIER_NUMBA is not 0, otherwise NumPy.

>>> with using(NUMPY):
...     active().name
'NumPy'
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import util

from openmm_sier.dynamics.backend.numba_backend import NumbaBackend
from openmm_sier.dynamics.backend.numpy_backend import Kinds, NumpyBackend, Pair

__all__ = ["NUMPY", "Backend", "Kinds", "Pair", "active", "using"]

Backend = NumpyBackend

NUMPY = NumpyBackend()

_active: Backend | None = None


def active() -> Backend:
    """Return the backend in use."""
    global _active
    if _active is None:
        wanted = os.environ.get("OPENMM_SIER_NUMBA", "1") != "0" and util.find_spec("numba") is not None
        _active = NumbaBackend() if wanted else NUMPY
    return _active


@contextmanager
def using(backend: Backend) -> Iterator[None]:
    """Use a given backend within this context."""
    global _active
    before, _active = active(), backend
    try:
        yield
    finally:
        _active = before
