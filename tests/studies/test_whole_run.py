"""The study of whole runs: its runs are kept, its law is found again, and pages say what its record says."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from studies import processed, records, whole_run

ROOT = Path(__file__).parents[2]
DATA = ROOT / "studies" / "data"


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
