"""The study of whole runs: its runs are kept, its law is found again, and pages say what its record says."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from studies import processed, records, whole_run
from studies.whole_run import WholeRunSettings
from tests.support.reports import Told

ROOT = Path(__file__).parents[2]
DATA = ROOT / "studies" / "data"


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    return WholeRunSettings(
        out=tmp_path_factory.mktemp("whole-run"),
        methods=("verlet", "sier4g"),
        per_force=(1.5, 20.0),
        starts=1,
        time=0.3,
        equilibrate=0.1,
    )


@pytest.fixture(scope="module")
def made(settings):
    return whole_run.study(settings)


@pytest.mark.slow
def test_runs_that_are_kept_are_not_repeated(settings, made):
    told = Told()
    again = whole_run.study(settings, told)
    pd.testing.assert_frame_equal(again.tables["runs"], made.tables["runs"])
    assert len(again.tables["runs"]) == 4
    assert not told.notes


@pytest.mark.slow
def test_fourth_order_is_better_and_steps_that_are_refused_are_told(made):
    rows = made.tables["rows"].set_index(["method", "step"])
    # Within 1 ps Verlet has some 0.5 % and SIER4G 0.03 % (64 molecules); a fifth is far from both scatters.
    assert rows.loc[("SIER4G", 4.5), "percent"] < rows.loc[("OpenMM Verlet", 1.5), "percent"] / 5
    assert "is refused" in rows.loc[("SIER4G", 60.0), "broken"]
    assert np.isnan(rows.loc[("SIER4G", 60.0), "percent"])
    assert made.tables["gains"]["gain"].dropna().iloc[0] > 5


def test_the_law_is_found_again():
    """Points that follow the law give back its constants; points below the floor and of second order do not count."""
    steps = np.array([4.5, 5.0, 6.0, 7.0])
    box = {"liquid": "x", "molecules": 1, "time": 1.0, "tolerance": 1e-4}
    rows = [
        box | {"method": name, "step": h, "walk": scale * np.exp(-2 * 31.54 / h)}
        for name, scale in (("SIER4G", 2e4), ("SIER4P", 3e3))
        for h in steps
    ]
    rows += [rows[0] | {"walk": 0.001, "step": 3.0}, rows[0] | {"method": "SIER2", "walk": 3.0}]
    found = whole_run.law(pd.DataFrame(rows))
    # Exact data: only the rounding of a least-squares solution is left.
    assert found["decay"] == pytest.approx(2, rel=1e-9)
    assert found["at_infinity"] == pytest.approx({"SIER4G": 2e4, "SIER4P": 3e3}, rel=1e-8)


@pytest.mark.slow
def test_the_processed_state_conserves_energy_better(settings, made):
    """Takahashi and Imada's step is of second order, and of fourth in the processed state (same starts)."""
    record = processed.study(processed.ProcessedSettings(out=settings.out, starts=1, steps=(2.0,), time=0.3))
    row = record.tables["rows"].iloc[0]
    # At 2 fs the error of second order is some 0.1 %, that of fourth order tenfold smaller.
    assert row["processed"] < row["percent"] / 2


# --- what pages say -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def record():
    return records.read(DATA / "whole-run.json")


def test_tables_of_the_documentation_are_those_of_the_record(record, tmp_path):
    whole_run.write_tables(record, tmp_path)
    for name in ("whole-run.md", "whole-run-gains.md"):
        assert (DATA / name).read_text() == (tmp_path / name).read_text()
    processed.write_table(records.read(DATA / "processed.json"), tmp_path)
    assert (DATA / "processed.md").read_text() == (tmp_path / "processed.md").read_text()


@pytest.mark.parametrize("page", ["README.md", "docs/index.md", "docs/trust.md", "paper/paper.md"])
def test_pages_claim_the_gains_of_the_record(record, page):
    """The gains that a page claims are the least and the largest of the large boxes, over 100 ps, rounded down."""
    gains = record.tables["gains"]
    large = gains[(gains["time"] == 100) & (gains["per_force"] == 1.5) & (gains["molecules"] != 64)]["gain"]
    claimed = re.findall(r"(\d+) to (\d+) times smaller", (ROOT / page).read_text())
    assert claimed
    for least, most in claimed:
        assert (int(least), int(most)) == (int(large.min()), int(large.max()))
