import os
import signal
from importlib import util

import numpy as np
import pytest

# OpenMM reads it when it is imported. The systems are too small for threads, and tests run side by side.
os.environ.setdefault("OPENMM_CPU_THREADS", "1")

from openmm_sier.dynamics import backend
from tests.support.waters import cluster_system, periodic_system, settled


@pytest.fixture(scope="session", autouse=True)
def signals_reach_children():
    """Commands that tests start obey signals, also where the suite itself was started with them ignored.

    Scripts start background jobs with SIGINT ignored, `nohup` ignores SIGHUP, and children inherit that. They do not
    inherit handlers: a signal that is handled here has its default effect there.
    """
    ignored = [s for s in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM) if signal.getsignal(s) is signal.SIG_IGN]
    for number in ignored:
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else lambda *_: None)
    yield
    for number in ignored:
        signal.signal(number, signal.SIG_IGN)


@pytest.fixture(autouse=True)
def seeded_libraries():
    """Libraries that draw from NumPy's global generator, such as openmmtools, do so alike in every run."""
    np.random.seed(20070518)  # noqa: NPY002


@pytest.fixture
def rng():
    """Random numbers that are the same in every run."""
    return np.random.default_rng(20070518)


@pytest.fixture(scope="session")
def cluster():
    """Eight molecules of water without a cut-off."""
    return settled(*cluster_system(8))


@pytest.fixture(scope="session")
def box():
    """59 molecules of water in a periodic box."""
    return settled(*periodic_system())


@pytest.fixture(params=["NumPy", "Numba"] if util.find_spec("numba") else ["NumPy"])
def executed_by(request):
    """Runs a test with NumPy and, where it is installed, with the code that Numba compiles."""
    with backend.using(backend.NUMPY if request.param == "NumPy" else NUMBA):
        yield request.param


NUMBA = backend.NumbaBackend()
