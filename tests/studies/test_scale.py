"""The study of large boxes: its tables, its figure, and what it measures."""

import numpy as np
import pandas as pd
import pytest

from studies import scale
from studies.records import Record


def run(atoms, method, turn, first):
    """A run whose first step takes some seconds, and everything else a tenth of one."""
    times = dict.fromkeys((*scale.WAITS, "step", "force", *scale.CALLS, "list"), 0.1) | {"loaded": 0.3}
    return {"atoms": atoms, "method": method, "round": turn, **times, "first": first, "memory": 100.0 + 50 * first}


@pytest.fixture
def runs():
    firsts = {scale.VERLET: (1.0, 1.2, 9.0), scale.OURS: (2.0, 2.2, 1.0)}
    return pd.DataFrame(
        [
            run(atoms, method, turn, atoms * first)
            for atoms in (10, 1)
            for method, each in firsts.items()
            for turn, first in enumerate(each)
        ]
    )


def test_medians_and_what_is_lost(runs):
    rows = scale.medians(runs)
    assert rows["atoms"].tolist() == [1, 1, 10, 10]
    assert rows["first"].tolist() == [1.2, 2.0, 12.0, 20.0]
    assert np.allclose(rows["loaded_more"], 2.0)
    assert np.allclose(rows["saved_more"], 0.0)
    assert np.allclose(rows["list_forces"], 1.0)
    lost = scale.losses(rows, 10.0)
    # The other waits are the same for both.
    assert np.allclose(lost["lost"], [0.8, 8.0])
    assert np.allclose(lost["forces"], [8.0, 80.0])
    assert np.allclose(lost["day_percent"] * scale.DAY, [80.0, 800.0])
    assert np.allclose(lost["memory_ratio"], [190 / 160, 1090 / 700])


def test_the_figure_is_drawn(runs, tmp_path):
    rows = scale.medians(runs)
    record = Record({}, {"rows": rows, "losses": scale.losses(rows, 10.0)}, {})
    scale.figure(record, tmp_path / "scale.png")
    assert (tmp_path / "scale.png").stat().st_size > 20_000


def test_runs_that_are_kept_are_not_made_again(tmp_path):
    settings = scale.ScaleSettings(molecules=(512,), rounds=2, out=tmp_path)
    points = [point for _, point in scale.missing(settings, [])]
    assert [(point["round"], point["method"]) for point in points] == [
        (turn, method) for turn in range(2) for method in (scale.VERLET, scale.OURS)
    ]
    assert [point for _, point in scale.missing(settings, points[:3])] == points[3:]


@pytest.mark.thorough
@pytest.mark.parametrize("method", [scale.VERLET, scale.OURS])
def test_what_is_measured_of_a_small_box(method, tmp_path):
    box = tmp_path / "box.xml"
    scale.make_box(box, 512)
    measured = scale.measure(box, method)
    assert measured["atoms"] == 1536
    assert (measured["prepare"] > 0) == (method == scale.OURS)
    assert {*scale.WAITS, *scale.CALLS, "list"} <= set(measured)
