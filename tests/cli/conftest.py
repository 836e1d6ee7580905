"""A small box of water, and a directory of its own for each test."""

import pytest

from tests.support.commands import write_lattice


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """Path of the PDB file of a box that has not been equilibrated."""
    return write_lattice(tmp_path_factory.mktemp("box") / "box.pdb")


@pytest.fixture(autouse=True)
def directory(tmp_path, monkeypatch):
    """Commands write to the current directory."""
    monkeypatch.chdir(tmp_path)
