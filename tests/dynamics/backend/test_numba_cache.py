"""Compiled code on disk."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from tests.support.subprocesses import run_python

numba = pytest.importorskip("numba")
numba_cache = pytest.importorskip("openmm_sier.dynamics.backend.numba_cache")

#: Stars with these numbers of leaves, moved by Numba. Prints their positions and momenta.
MOVED_STARS = """
import sys
import numpy as np
from openmm_sier.dynamics.constraints import Constraints
for leaves in map(int, sys.argv[1:]):
    q, p = np.random.default_rng(leaves).normal(size=(2, 3, leaves + 1))
    pairs = [(0, leaf) for leaf in range(1, leaves + 1)]
    lengths = [np.linalg.norm(q[:, 0] - q[:, leaf]) for _, leaf in pairs]
    constraints = Constraints(pairs, lengths, [12.0, *[1.0] * leaves])
    moved = constraints.drift(q, constraints.project(q, p), 0.01, (1.0,))
    print(*(array.tolist() for array in moved))
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


def kept(folder):
    return sorted(folder.rglob("*.nbc"))


def test_code_is_found_again(folder):
    assert adding(1)(2) == 3
    assert len(kept(folder)) == 1
    # It is the code on the disk that is executed.
    assert adding(5)(2) == 3


def test_each_signature_has_a_file(folder):
    """So two processes that compile at the same time cannot take the code of each other for their own."""
    first, second = adding(1), adding(1)
    assert (first(2), second(2.5)) == (3, 3.5)
    assert len(kept(folder)) == 2
    again = adding(5)
    assert (again(2.5), again(2)) == (3.5, 3)


@pytest.mark.parametrize("rest", [0, 100], ids=["empty", "cut"])
def test_a_broken_file_is_replaced(folder, rest):
    adding(1)(2)
    (path,) = kept(folder)
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
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(folder / "home"))
    assert Path(numba_cache.UserCache("add").cache_path).is_relative_to(folder / "home" / ".cache")


@pytest.mark.slow
def test_code_from_the_disk_keeps_its_own_helpers(tmp_path):
    """Stars of each size are compiled anew from functions of the same names."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    alone = [run_python(MOVED_STARS, leaves, environment=environment) for leaves in (3, 2)]
    assert run_python(MOVED_STARS, 3, 2, environment=environment) == "".join(alone)
