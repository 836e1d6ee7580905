"""The comparison of speeds: who takes part, what is counted, and its files; how fast anything is, no test says."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest

from openmm_sier.measure.forcefields import Interactions
from studies import records, speed, speed_boxes
from studies.bench import usual_inputs
from studies.speed import SpeedSettings, Turn
from tests.support.commands import write_lattice
from tests.support.reports import Told


@pytest.mark.slow
def test_speed_in_miniature(tmp_path, monkeypatch):
    box = write_lattice(tmp_path / "box.pdb")
    monkeypatch.setattr(speed, "STEPS", {"verlet": (0.5, 2.0), "sier2": (0.5,), "sier2p3": (1.0,), "sier4g": (1.0,)})
    monkeypatch.setattr(usual_inputs, "installed", list)
    # The cut-off that fits the box.
    monkeypatch.setattr(speed_boxes, "INTERACTIONS", Interactions())
    settings = SpeedSettings(
        out=tmp_path,
        box=box,
        boxes=("water-27", "water-216", "peptide"),
        rounds=1,
        turn=1e-6,
        time=0.02,
        equilibrate=0.01,
        starts=1,
        platform="CPU",
    )
    told = Told()
    speed.study(settings, told)
    found = records.read(tmp_path / "speed.json").tables
    rows = found["speeds"]
    assert list(rows["box"].unique()) == ["water-27", "water-216", "peptide"]
    assert list(rows["atoms"].unique()) == [81, 648, 2538]
    steps = [1, 2, 2, 4, 2, 4, 2]
    assert list(rows["fs_per_force"]) == [*steps, *steps, *steps[:-2], 3, 2]
    assert set(rows["platform"]) == {"CPU"}
    assert list(rows["engine"][:7]) == ["", "", "", "", "exact", "exact", "exact"]
    assert (rows["ns_per_day"] > 0).all()
    assert (rows.loc[rows["name"] == speed.REFERENCE, "over"] == 1).all()
    # Speed at equal energy error is for water alone.
    assert set(found["equal"]["box"]) == {"water-27", "water-216"}
    assert set(found["points"]["method"]) == {"OpenMM Verlet", "SIER2", "SIER2P3", "SIER4G"}
    assert len(told.tables) == 2
    written = (tmp_path / "speed.md").read_text()
    assert "| OpenMM Verlet, 1 fs |" in written
    again = Told()
    speed.study(SpeedSettings(out=tmp_path, table=tmp_path / "speed.json"), again)
    assert [table.rows for table in again.tables] == [table.rows for table in told.tables]


def test_a_speed_is_simulated_time_over_what_it_took():
    """2 fs in 1 ms of processor time and 2 ms of wall time."""
    verlet = np.array(3 * [Turn(2.0, 0.002, 0.001)])
    other = np.array(3 * [Turn(12.0, 0.004, 0.003)])
    reference, own = speed.rows_of({speed.REFERENCE: verlet, "other": other}, "CPU")
    # 1 fs/ms is 86.4 ns/day.
    assert reference["ns_per_day"] == pytest.approx(86.4)
    assert reference["ns_per_day_processor"] == pytest.approx(172.8)
    assert own["over"] == pytest.approx(2.0)
    assert speed.rows_of({speed.REFERENCE: verlet, "other": other}, "CUDA")[1]["over"] == pytest.approx(3.0)


def test_speed_at_an_error_is_that_of_the_step_that_has_it(monkeypatch):
    """Second order, 0.04 % and 0.01 % at 1 fs: 0.1 % at 1.58 and 3.16 fs, the second at the same cost of a force."""
    monkeypatch.setattr(speed, "LEVELS", (0.1,))
    points = pd.DataFrame(
        [
            {"method": method, "seed": seed, "fs_per_force": dt, "percent": factor * dt**2}
            for method, factor in (("OpenMM Verlet", 0.04), ("SIER2", 0.01))
            for seed in (1, 2)
            for dt in (1.0, 4.0)
        ]
    )
    rows = pd.DataFrame(
        [
            {"box": "water-512", "method": method, "fs_per_force": 2.0, "over": 1.0, "over_error": 0.0}
            for method in ("OpenMM Verlet", "SIER2")
        ]
    )
    verlet, own = speed.at_equal_error(rows, points).to_dict("records")
    assert verlet["fs_per_force"] == pytest.approx(math.sqrt(2.5))
    assert own["fs_per_force"] == pytest.approx(math.sqrt(10))
    assert (own["over"], own["over_error"]) == pytest.approx((2.0, 0.0))


def test_steps_of_a_solute_are_those_that_its_bonds_allow():
    steps = [{each.method: each.step for each in speed.contestants(solute)} for solute in (False, True)]
    assert [each["SIER2P3"] for each in steps] == [12, 9]
    assert [each["SIER4G"] for each in steps] == [6, 6]


def test_systems_are_as_openmm_makes_them():
    """The Ewald parameter and mesh are OpenMM's own choice, whatever the box was read with."""
    start = speed_boxes.start("water-512", SpeedSettings(platform="Reference"), Told())
    (force,) = speed_boxes.meshed_forces(start.system)
    assert force.getPMEParameters()[1:] == [0, 0, 0]
    assert force.getEwaldErrorTolerance() == speed_boxes.TOLERANCE
    assert start.molecules == 512
