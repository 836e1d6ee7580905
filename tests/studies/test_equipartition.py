"""The comparison of temperatures in miniature, and what is pooled."""

from __future__ import annotations

import dataclasses
import math

import pandas as pd
import pytest

from studies import equipartition, records
from studies.equipartition import MEASURED, EquipartitionSettings
from tests.support.commands import write_lattice
from tests.support.reports import Told


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """Of one method at one step."""
    place = tmp_path_factory.mktemp("box")
    return EquipartitionSettings(
        out=place,
        box=write_lattice(place / "box.pdb"),
        dt=(2.0,),
        methods=("sier2",),
        time=0.1,
        equilibrate=0.02,
        platform="Reference",
    )


@pytest.fixture(autouse=True)
def hardly_settling(monkeypatch):
    monkeypatch.setattr(equipartition, "SETTLING", 0.02)


@pytest.mark.slow
def test_equipartition_in_miniature(short, tmp_path):
    told = Told()
    settings = dataclasses.replace(short, out=tmp_path, dt=(1.0, 2.0), methods=("verlet", "sier2", "sier4"))
    rows = equipartition.study(settings, told).tables["rows"]
    assert list(zip(rows["method"], rows["step"], strict=True)) == [
        ("OpenMM Verlet", 1.0),
        ("OpenMM Verlet", 2.0),
        ("SIER2", 1.0),
        ("SIER2", 2.0),
        ("SIER4", 4.0),
        ("SIER4", 8.0),
    ]
    # The box has not been equilibrated: it is hot, but no simulation of it breaks down.
    assert rows["rotation"].between(100, 2000).all()
    assert not rows["broken"].any()
    assert rows["density"][0] == pytest.approx(0.997, abs=1e-3)
    # Known for SIER2 alone, where it is that of h^2.
    predicted = rows["predicted"]
    assert predicted[2] < 0
    assert predicted[3] == pytest.approx(4 * predicted[2])
    assert predicted[[0, 1, 4, 5]].isna().all()
    assert (tmp_path / "equipartition.png").read_bytes().startswith(b"\x89PNG")
    assert told.tables[0].title.startswith("Equipartition, NVE")


def row(mean, error, time, predicted=math.nan, broken=""):
    measured = dict.fromkeys(MEASURED, mean) | {f"{name}_error": error for name in MEASURED}
    place = {"method": "SIER4", "step": 4.0, "fs_per_force": 1.0, "time": time}
    return place | measured | {"drift": mean, "predicted": predicted, "broken": broken}


def pooled(*rows):
    (found,) = equipartition.pooled(pd.DataFrame(rows)).to_dict("records")
    return found


def test_replicas_are_pooled_by_their_lengths():
    """Three times the length weighs as much, and has a standard error less by the square root of it."""
    found = pooled(row(1.0, 0.3, 30.0), row(2.0, 0.3 * 3**0.5, 10.0))
    assert found["time"] == 40.0
    # The best estimate of all, whose error is that of one run of 40 ps.
    assert (found["difference"], found["difference_error"]) == pytest.approx((1.25, 0.3 * (3 / 4) ** 0.5))
    assert found["drift"] == pytest.approx(1.25)
    assert math.isnan(found["predicted"])
    assert pooled(row(1.0, 0.3, 30.0, -2.0), row(1.0, 0.3, 10.0, -1.0), row(1.0, 0.3, 10.0))["predicted"] == -1.5
    broken = row(0.0, 1.0, 10.0, broken="too hot")
    assert pooled(row(1.0, 0.3, 30.0), broken)["broken"] == "too hot"


@pytest.mark.slow
def test_directories_are_pooled(short, tmp_path):
    def made(name, **changes):
        (tmp_path / name).mkdir()
        return equipartition.study(dataclasses.replace(short, out=tmp_path / name, **changes))

    together = made("both", replicas=2)
    for seed in (1, 2):
        made(str(seed), seed=seed)
    found = made("pooled", pool=(tmp_path / "1", tmp_path / "2"))
    pd.testing.assert_frame_equal(found.tables["rows"], together.tables["rows"])
    assert found.tables["rows"]["time"][0] == pytest.approx(0.2)
    # What was pooled can be pooled on.
    assert records.read(tmp_path / "pooled" / equipartition.FILE).notes["pooled"][1]["seed"] == 2
    made("hot", temperature=350.0)
    with pytest.raises(ValueError, match=r"cannot be pooled: their settings of temperature are 350.0 and 297.0"):
        equipartition.pool((tmp_path / "1", tmp_path / "hot"))
    with pytest.raises(ValueError, match="cannot be pooled: both have SIER2 at 2 fs with seed 2"):
        equipartition.pool((tmp_path / "both", tmp_path / "2"))
