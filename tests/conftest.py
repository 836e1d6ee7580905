from importlib import util

import numpy as np
import pytest

from openmm_sier.dynamics import bodies
from openmm_sier.dynamics.rotation import rotor


@pytest.fixture
def rng():
    """Random numbers that are the same in every run."""
    return np.random.default_rng(20070518)


@pytest.fixture(params=["numpy", "numba"] if util.find_spec("numba") else ["numpy"])
def executed_by(request, monkeypatch):
    """Runs a test with NumPy and, where it is installed, with the code that Numba compiles."""
    if request.param == "numpy":
        for module in (rotor, bodies):
            monkeypatch.setattr(module, "executor", lambda: None)
    return request.param
