"""`python -m studies.defaults` in miniature."""

from __future__ import annotations

import dataclasses

import pytest

from studies import defaults
from studies.boxes import write_lattice
from studies.defaults import DefaultsSettings
from tests.support.reports import Told


@pytest.mark.slow
def test_runs_are_kept_and_the_table_has_means_and_ranges(tmp_path, monkeypatch):
    settings = DefaultsSettings(
        out=tmp_path,
        box=write_lattice(tmp_path / "box.pdb"),
        tolerance=(5e-4,),
        cutoff=(0.4,),
        switch=("yes",),
        starts=2,
        time=0.12,
        equilibrate=0.03,
        platform="Reference",
    )
    told = Told()
    rows = defaults.study(settings, told).tables["rows"]
    assert len(rows) == 8
    assert rows["percent"].between(1e-3, 50).all()
    (table,) = told.tables
    assert table.columns == ["ewaldErrorTolerance", "cut-off/nm", "switch", "balanced", "OpenMM Verlet", "SIER4G"]
    assert [row[:4] for row in table.rows] == [["0.0005", "0.4", "yes", "no"], ["0.0005", "0.4", "yes", "yes"]]
    mine = rows[(rows["method"] == "SIER4G") & (rows["balanced"] == "yes")]["percent"]
    assert table.rows[1][5] == f"{mine.mean():.3g} ({mine.min():.2g} to {mine.max():.2g})"
    # Nothing is run again, and a third start is added.
    runs = []
    monkeypatch.setattr(defaults, "percent", lambda liquid, method, *_: runs.append(method.name) or 1.0)
    monkeypatch.setattr(defaults, "equilibrated_liquid", lambda settings, *_: defaults.Liquid(None, None, None))
    assert len(defaults.study(dataclasses.replace(settings, starts=3)).tables["rows"]) == 12
    assert runs == ["OpenMM Verlet", "SIER4G"] * 2
    with pytest.raises(ValueError, match=r"has results with time 0.12, got 0.24"):
        defaults.study(dataclasses.replace(settings, time=0.24))
