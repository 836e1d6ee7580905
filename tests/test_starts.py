"""The starts of test systems, and the option that displaces them."""

import numpy as np
import pytest

from tests.support import starts
from tests.support.waters import cluster_system


def test_a_displacement_moves_molecules_as_wholes(monkeypatch):
    monkeypatch.setattr(starts.Options, "seed", None)
    _, positions, system = cluster_system(4, "tip4pew")
    system.setParticleMass(0, 0)
    ends = []
    for seed in (1, 1, 2):
        monkeypatch.setattr(starts.Options, "seed", seed)
        ends.append(starts.displaced(positions, system) - positions)
    assert np.array_equal(ends[0], ends[1])
    assert not np.array_equal(ends[0], ends[2])
    molecules = ends[0].reshape(4, 4, 3)
    # The rounding of coordinates of a nanometer.
    assert np.abs(molecules - molecules[:, :1]).max() < 1e-15
    assert np.linalg.norm(molecules[1:, 0], axis=1) == pytest.approx(starts.DISTANCE, rel=1e-5)
    # The first has a frozen atom.
    assert not molecules[0].any()


def test_a_start_that_is_missing_names_the_way_to_make_it(tmp_path, monkeypatch):
    monkeypatch.setattr(starts, "DIRECTORY", tmp_path / "starts")
    monkeypatch.setattr(starts.Options, "makes", False)
    with pytest.raises(FileNotFoundError, match=r"cluster\.npz .*--make-starts"):
        starts.stored("cluster", dict)
    monkeypatch.setattr(starts.Options, "makes", True)
    result = starts.stored("cluster", lambda: {"positions": np.eye(3)})
    monkeypatch.setattr(starts.Options, "makes", False)
    # It is not made another time.
    again = starts.stored("cluster", dict)
    assert np.array_equal(result["positions"], again["positions"])
