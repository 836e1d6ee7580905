"""The comparison of schemes: published candidates, what it reports, and its files."""

from __future__ import annotations

import dataclasses
import math

import pandas as pd
import pytest
from openmm import app, unit

from openmm_sier.dynamics.schemes import SIER2V2, SIER4P, SIER4V
from studies import schemes
from studies.methods import OTHERS
from studies.schemes import SchemesSettings
from tests.support.reports import Told
from tests.support.waters import water_box

CANDIDATES = {**OTHERS, "sier4v": SIER4V, "sier4p": SIER4P}
FORCES = {"s6": 6, "srkn6b": 6, "pefrl": 4, "sier4v": 5, "sier4p": 4, "omf3gg": 5}


@pytest.mark.parametrize("name", CANDIDATES)
def test_candidates_are_symmetric_and_of_fourth_order(name):
    scheme = CANDIDATES[name]
    assert scheme.order == 4
    assert scheme.is_palindrome
    assert scheme.force_evaluations == FORCES[name]


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    topology, positions, _ = water_box("tip3p", 64)
    path = tmp_path_factory.mktemp("survey") / "box.pdb"
    app.PDBFile.writeFile(topology, positions * unit.nanometer, str(path))
    return SchemesSettings(
        out=path.parent,
        box=path,
        forcefield=("tip3p.xml",),
        dt=(2.0, 12.0),
        schemes=("verlet", "sier2", "sier4g"),
        starts=1,
        time=0.3,
        equilibrate=0.2,
        platform="CPU",
    )


@pytest.fixture(scope="module")
def finished(settings):
    told = Told()
    return schemes.study(settings, told).tables["rows"], told


@pytest.mark.slow
def test_rows(finished):
    rows, _ = finished
    assert list(zip(rows["method"], rows["fs_per_force"], rows["forces"], strict=True)) == [
        (name, dt, forces) for dt in (2.0, 12.0) for name, forces in (("OpenMM Verlet", 1), ("SIER2", 1), ("SIER4G", 3))
    ]
    assert list(rows["step"]) == [2.0, 2.0, 6.0, 12.0, 12.0, 36.0]
    verlet, sier2, sier4g = rows["percent"][:3]
    # Second order is second order, and the fourth is several times better, cut-off and all.
    assert 0.3 < sier2 / verlet < 3
    assert sier4g < 0.5 * sier2
    # A step of a whole period of libration breaks the run, and says so.
    assert rows["broken"].iloc[-1]
    assert math.isnan(rows["percent"].iloc[-1])


def test_what_is_reported(finished):
    rows, told = finished
    (table,) = told.tables
    assert len(table.rows) == len(rows)
    assert table.rows[-1][-4:] == ["-", "-", "-", "-"]
    assert any("broke down" in note for note in told.notes)
    liquid = "box, tip3p"
    assert any(note.startswith(f"least energy error of {liquid} at 2 fs per force: SIER4G") for note in told.notes)


def test_runs_are_kept_and_others_are_added(finished, settings, tmp_path, monkeypatch):
    """What is done is not done again, and a run of another start goes into the same table."""
    rows, _ = finished
    for file in settings.out.glob("*.json*"):
        (tmp_path / file.name).write_text(file.read_text())
    runs = []
    monkeypatch.setattr(schemes, "equilibrated_liquid", lambda settings, *_: settings.seed)
    made = {"order": 2, "forces": 1, "step": 2.0, "percent": 5.0, "drift": 0.0, "broken": ""}
    monkeypatch.setattr(
        schemes,
        "_run",
        lambda start, method, dt, *_: (
            runs.append((start, method.name)) or {**made, "method": method.name, "fs_per_force": dt}
        ),
    )
    again = dataclasses.replace(settings, out=tmp_path, starts=2, dt=(2.0,), schemes=("verlet", "sier2"))
    added = schemes.study(again).tables["rows"]
    assert runs == [(2, "OpenMM Verlet"), (2, "SIER2")]
    assert len(added) == len(rows)
    mean = added[added["fs_per_force"] == 2].set_index("method")["percent"]
    assert mean["SIER2"] == pytest.approx((rows["percent"][1] + 5) / 2, rel=1e-12)
    with pytest.raises(ValueError, match=r"has results with time 0.3, got 0.6"):
        schemes.study(dataclasses.replace(again, time=0.6))


def test_points_are_means_over_starts_with_their_errors():
    names = ["liquid", "method", "fs_per_force", "percent", "broken"]
    runs = [("A", "OpenMM Verlet", 2.0, 0.9, ""), ("A", "OpenMM Verlet", 2.0, 1.1, "")]
    runs += [("A", "X", 4.0, 1.0, ""), ("A", "X", 4.0, 2.0, ""), ("B", "X", 4.0, 3.0, "")]
    runs += [("A", "Y", 4.0, 1.0, ""), ("A", "Y", 4.0, math.nan, "too long")]
    same = {"order": 2, "forces": 1, "step": 4.0, "drift": 0.0}
    rows = schemes.points(pd.DataFrame(runs, columns=names).assign(**same)).set_index(["liquid", "method"])
    verlet, x, y = (rows.loc["A", name] for name in ("OpenMM Verlet", "X", "Y"))
    # The standard error of two values is half their difference.
    assert (verlet["percent"], verlet["percent_error"]) == pytest.approx((1.0, 0.1))
    assert (verlet["relative"], verlet["relative_error"]) == (1.0, 0.0)
    assert (x["relative"], x["relative_error"]) == pytest.approx((1.5, 1.5 * math.hypot(0.5 / 1.5, 0.1)))
    assert (x["least"], x["most"], x["starts"]) == (1.0, 2.0, 2)
    assert math.isnan(y["percent"])
    assert y["broken"] == "too long"
    # One start has no error, and a liquid without Verlet nothing to be divided by.
    assert math.isnan(rows.loc[("B", "X"), "percent_error"])
    assert math.isnan(rows.loc[("B", "X"), "relative"])


def test_means_over_liquids_need_all_of_them():
    names = ["liquid", "method", "fs_per_force", "relative", "relative_error"]
    rows = [
        ("A", "X", 4.0, 1.0, 0.3),
        ("B", "X", 4.0, 2.0, 0.4),
        ("A", "Y", 4.0, 1.0, 0.1),
        ("C", "X", 4.0, math.nan, 1),
    ]
    (mean,) = schemes.over_liquids(pd.DataFrame(rows, columns=names)).to_dict("records")
    assert mean == pytest.approx({"method": "X", "fs_per_force": 4.0, "relative": 1.5, "relative_error": 0.25})


def test_palindromes_by_their_fractions():
    first, verlet, second = schemes.methods_of(["kick:0.1931833275037836,0.5", "verlet", "drift:0.5"])
    assert first.scheme.stages == SIER2V2.stages
    assert verlet is schemes.KNOWN["verlet"]
    assert [stage.fraction for stage in second.scheme.stages] == [0.5, 1.0, 0.5]
    with pytest.raises(ValueError, match="'drift' must sum to 1"):
        schemes.methods_of(["kick:0.2,0.6"])
