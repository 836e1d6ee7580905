import gc
import os
import signal

import numpy as np
import pytest

# OpenMM reads it when it is imported. The systems are too small for threads, and tests run side by side.
os.environ.setdefault("OPENMM_CPU_THREADS", "1")

from openmm_sier.dynamics.barostat import MonteCarloVolumeMove
from openmm_sier.dynamics.noise import generator
from openmm_sier.ensembles import metropolis
from tests.support import starts
from tests.support.waters import cluster_system, periodic_system, settled


def pytest_addoption(parser):
    parser.addoption(
        "--displaced",
        type=int,
        metavar="SEED",
        help=f"displace the starts of test systems by {starts.DISTANCE:g} nm: no test may depend on where chaos leads",
    )
    parser.addoption("--make-starts", action="store_true", help=f"make the starts that {starts.DIRECTORY} lacks")


def pytest_configure(config):
    starts.Options.seed = config.getoption("displaced")
    starts.Options.makes = config.getoption("make_starts")
    if starts.Options.makes and starts.Options.seed is not None:
        raise pytest.UsageError("--make-starts stores starts that are not displaced; leave out --displaced")


def pytest_collection_finish():
    """Spare the garbage collector what was imported and collected, which lives to the end."""
    gc.freeze()


def pytest_terminal_summary(terminalreporter, config):
    terminalreporter.write_line(f"OpenMM's CPU platform had {os.environ['OPENMM_CPU_THREADS']} thread(s)")
    if (seed := config.getoption("displaced")) is not None:
        terminalreporter.write_line(f"starts were displaced by {starts.DISTANCE:g} nm, seed {seed}")


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


@pytest.fixture
def coin(monkeypatch):
    """Trials and volume moves are decided by a coin, so that both outcomes come.

    Their energies do not matter, which are others on each processor. Like the noise of the package, the coin is a
    function of seed and draw. Where no trajectory can be followed the trial is rejected all the same.
    """

    def largest_error(seed, draw):
        return 1e300 if generator(seed, draw, stream=2).random() < 0.5 else -1e300

    monkeypatch.setattr(metropolis, "largest_error", largest_error)
    monkeypatch.setattr(MonteCarloVolumeMove, "is_accepted", lambda move, probability: move.chance < 0.5)


@pytest.fixture(scope="session")
def cluster():
    """Eight molecules of water without a cut-off."""
    return settled("cluster-8", *cluster_system(8))


@pytest.fixture(scope="session")
def box():
    """59 molecules of water in a periodic box."""
    return settled("box-59", *periodic_system())
