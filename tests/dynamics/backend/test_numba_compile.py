"""Compilation of functions with all that they call, and the code that is kept on disk."""

import os
import sys
from pathlib import Path

import pytest

from tests.support.subprocesses import run_python

numba = pytest.importorskip("numba")
numba_cache = pytest.importorskip("openmm_sier.dynamics.backend.numba_cache")

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


def adding(value):
    """A compiled function, with code from the disk where there is some, under a name that does not say what it adds."""

    def add(x):
        return x + value

    function = numba.njit(add)
    function._cache = numba_cache.UserCache("add")
    return function


def test_each_signature_has_a_file_and_is_found_again(folder):
    """So two processes that compile at the same time cannot take the code of each other for their own."""
    first, second = adding(1), adding(1)
    assert (first(2), second(2.5)) == (3, 3.5)
    assert len(list(folder.rglob("*.nbc"))) == 2
    # It is the code on the disk that is executed.
    again = adding(5)
    assert (again(2.5), again(2)) == (3.5, 3)


@pytest.mark.parametrize("rest", [0, 100], ids=["empty", "cut"])
def test_a_broken_file_is_replaced(folder, rest):
    adding(1)(2)
    (path,) = folder.rglob("*.nbc")
    whole = path.read_bytes()
    path.write_bytes(whole[:rest])
    assert adding(1)(2) == 3
    assert len(path.read_bytes()) == len(whole)
    assert list(path.parent.iterdir()) == [path]


def test_where_nothing_can_be_written_every_process_compiles(folder, monkeypatch):
    (folder / "file").touch()
    monkeypatch.setattr(numba.core.config, "CACHE_DIR", str(folder / "file"))
    with pytest.warns(UserWarning, match=r"cannot be kept in .*file.*Not a directory.*NUMBA_CACHE_DIR"):
        assert adding(1)(2) == 3


@pytest.mark.skipif(sys.platform != "linux", reason="other platforms keep caches elsewhere")
def test_the_place_is_the_users_cache_unless_numba_is_told_another(folder, monkeypatch):
    assert Path(numba_cache.UserCache("add").cache_path).parent == folder
    monkeypatch.setattr(numba.core.config, "CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder / "caches"))
    assert Path(numba_cache.UserCache("add").cache_path).is_relative_to(folder / "caches")


@pytest.mark.slow
def test_another_process_finds_the_code_on_disk(tmp_path):
    """Names on disk tell of the code alone, not of the process or its hashes; and it does what it did."""
    found = []
    for seed in ("1", "2"):
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONHASHSEED": seed, "OPENMM_SIER_NUMBA": "1"}
        printed = run_python(MOVED, environment=environment)
        found.append((printed, {(path.name, path.stat().st_mtime_ns) for path in tmp_path.rglob("*.nb*")}))
    # The rotation, the projection and the drift.
    assert len(found[0][1]) == 3
    assert found[1] == found[0]
