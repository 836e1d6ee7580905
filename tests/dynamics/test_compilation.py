"""Compilation of kernels, and the code that is kept on disk."""

import os
import sys

import numba
import pytest

from openmm_sier.dynamics.kernels import compilation
from tests.support.faults import lines_run
from tests.support.subprocesses import run_python

#: Rotates a body and moves constrained points by Numba, and prints their positions.
MOVED = """
import numpy as np
from openmm_sier.dynamics import rotation
from openmm_sier.dynamics.constraints import Constraints
print(rotation.exact(np.eye(3)[:, :, None], np.ones((3, 1)), (1, 2, 3), 0.001)[0].tolist())
q = np.random.default_rng(1).normal(size=(3, 3))
constraints = Constraints([(0, 1), (0, 2)], np.linalg.norm(q[:, :1] - q[:, 1:], axis=0), [12.0, 1.0, 1.0])
print(constraints.drift(q, constraints.project(q, q), 0.01)[0].tolist())
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(numba.core.config, "CACHE_DIR", str(tmp_path))
    return tmp_path


def doubled(x):
    return 2 * x


def doubling():
    return compilation.kernel(doubled)


def kept_in(folder):
    """When each file of compiled code was written."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*.nb*")}


def test_code_is_kept_on_disk(folder):
    assert doubling()(2) == 4
    kept = kept_in(folder)
    assert [path.suffix for path in sorted(kept)] == [".nbc", ".nbi"]
    assert doubling()(2) == 4
    assert kept_in(folder) == kept


def test_errors_throw_no_code_away(folder):
    """Neither wrong arguments of a kernel nor a fault at any line of a call."""
    function = doubling()
    assert function(2) == 4
    kept = kept_in(folder)
    with pytest.raises(numba.TypingError):
        function(None)
    for line in range(1, lines_run(lambda: function(2)) + 1):
        lines_run(lambda: function(2), line)
    assert function(2) == 4
    assert kept_in(folder) == kept


@pytest.mark.parametrize("rest", [0, 100], ids=["empty", "cut"])
@pytest.mark.parametrize("kind", ["nbi", "nbc"])
def test_a_broken_file_is_replaced(folder, kind, rest):
    """As a machine that stops leaves it."""
    doubling()(2)
    (path,) = folder.rglob(f"*.{kind}")
    whole = path.read_bytes()
    path.write_bytes(whole[:rest])
    assert doubling()(2) == 4
    replaced = path.read_bytes()
    assert len(replaced) > rest
    # The next process finds it whole.
    assert doubling()(2) == 4
    assert path.read_bytes() == replaced


def test_a_full_disk_stops_nothing(folder, monkeypatch):
    def full(*arguments):
        raise OSError(28, "No space left on device")

    function = doubling()
    monkeypatch.setattr(os, "replace", full)
    with pytest.warns(UserWarning, match="No space left.*NUMBA_CACHE_DIR"):
        assert function(2) == 4
    assert function(3) == 6


def test_where_numba_finds_no_place_every_process_compiles():
    """A function without a file of its own stands for a place where nothing can be written."""
    made = {}
    exec("def tripled(x):\n    return 3 * x", made)
    with pytest.warns(UserWarning, match="no locator available.*NUMBA_CACHE_DIR"):
        function = compilation.kernel(made["tripled"])
    assert function(2) == 6


@pytest.mark.skipif(sys.platform != "linux", reason="other platforms keep caches elsewhere")
def test_the_folder_is_the_users_cache_unless_numba_has_another(folder, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder / "caches"))
    doubling()(2)
    assert not (folder / "caches").exists()
    monkeypatch.setattr(numba.core.config, "CACHE_DIR", "")
    doubling()(2)
    assert list((folder / "caches" / "openmm_sier").rglob("*.nbc"))
    assert numba.core.config.CACHE_DIR == ""


@pytest.mark.skipif(sys.platform != "linux", reason="other platforms keep caches elsewhere")
def test_relative_folders_of_the_environment_are_ignored(folder, monkeypatch):
    """Whoever owns the current directory would choose the code."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr(numba.core.config, "CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", "caches")
    monkeypatch.setenv("HOME", str(folder / "home"))
    assert compilation._directory().is_relative_to(folder / "home" / ".cache" / "openmm_sier")
    for home in ("home", ""):
        monkeypatch.setenv("HOME", home)
        found = compilation._directory()
        assert found.is_absolute()
        assert not found.is_relative_to(folder)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has other rights")
def test_a_folder_that_others_can_write_is_not_used(folder, monkeypatch):
    assert doubling()(2) == 4
    kept = kept_in(folder)
    assert kept
    (place,) = folder.iterdir()
    assert place.stat().st_mode & 0o077 == 0
    place.chmod(0o777)
    with pytest.warns(UserWarning, match="NUMBA_CACHE_DIR"):
        function = doubling()
    assert function(2) == 4
    assert function._cache.__class__.__name__ == "NullCache"
    place.chmod(0o755)
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    with pytest.warns(UserWarning, match="NUMBA_CACHE_DIR"):
        doubling()
    assert kept_in(folder) == kept


@pytest.mark.thorough
def test_another_process_finds_the_code_on_disk(tmp_path):
    """Names on disk depend on the code only, not on the process or its hashes; results are the same."""
    results = []
    for seed in ("1", "2"):
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONHASHSEED": seed}
        printed = run_python(MOVED, environment=environment)
        results.append((printed, {(path.name, path.stat().st_mtime_ns) for path in tmp_path.rglob("*.nb*")}))
    # The rotation, the projection and the drift, with an index each.
    assert len(results[0][1]) == 6
    assert results[1] == results[0]


class ElapsedTimer:
    """A timer whose time is over at once."""

    def __init__(self, _, function):
        self.start = function
        self.cancel = lambda: None


def test_a_long_compilation_is_announced_once(folder, monkeypatch, caplog):
    monkeypatch.setattr(compilation, "Timer", ElapsedTimer)
    compilation._announce.cache_clear()
    for _ in range(2):
        function = doubling()
        assert function(2) == 4
        assert function(3) == 6
    (message,) = caplog.messages
    assert message.startswith("Compiling the motion of bodies for this processor")
    assert str(folder) in message


def test_without_compilation_a_kernel_is_the_function_itself(monkeypatch):
    monkeypatch.setattr(compilation.config, "DISABLE_JIT", 1)
    assert doubling() is doubled
