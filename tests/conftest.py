from importlib import util

import numpy as np
import pytest

from openmm_sier.dynamics import backend


@pytest.fixture
def rng():
    """Random numbers that are the same in every run."""
    return np.random.default_rng(20070518)


@pytest.fixture(params=["NumPy", "Numba"] if util.find_spec("numba") else ["NumPy"])
def executed_by(request):
    """Runs a test with NumPy and, where it is installed, with the code that Numba compiles."""
    with backend.using(backend.NUMPY if request.param == "NumPy" else NUMBA):
        yield request.param


NUMBA = backend.NumbaBackend()
