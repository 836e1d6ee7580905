"""Pages that show records, whose cells the site's build executes: no table of theirs is typed."""

import re
from pathlib import Path

import pandas as pd
import pytest

from studies import archive, pages, records
from studies.__main__ import modules

ROOT = Path(__file__).parents[2]
MEASUREMENTS = sorted((ROOT / "docs" / "measurements").glob("*.md"))
EXECUTED = [page for page in sorted(ROOT.glob("docs/**/*.md")) if "file_format: mystnb" in page.read_text()]


def test_no_table_of_a_page_is_typed():
    """Tables of Markdown have a line of dashes between strokes."""
    typed = re.compile(r"^\s*\|?\s*:?-{2,}:?\s*\|", re.MULTILINE)
    assert [page.name for page in MEASUREMENTS if typed.search(page.read_text())] == []


def test_every_record_has_its_command():
    for path in records.DATA.iterdir():
        commands = records.read(path).commands
        assert commands, path.name
        assert set(re.findall(r"-m (studies[\w.]*)", " ".join(commands))) <= {*modules(), *archive.ARCHIVED}


def test_every_record_is_shown_or_claimed():
    """By a page, a figure or a claim."""
    readers = *EXECUTED, ROOT / "studies" / "figures.py", ROOT / "studies" / "claims.py"
    read = "".join(path.read_text() for path in readers)
    assert [path.name for path in records.DATA.iterdir() if path.name not in read] == []


def test_a_table_has_the_command_under_it():
    shown = pages.show("exactness.json", pages.table(pages.read("exactness.json"), {"model": "{model}"}))
    assert "| model |\n| --- |\n" in shown
    command = "`studies/data/exactness.json`: `python -m studies.hmc.exactness`"
    assert shown.endswith(f"{command}, in commit {archive.COMMIT}\n")
    with pytest.raises(ValueError, match=r"exactness\.json"):
        pages.show("exactness.json", pd.DataFrame())


def test_numbers_in_sentences():
    rows = pd.DataFrame({"percent": [0.83, 0.19, 0.5], "percent_error": [0.02, None, 0.01]})
    assert pages.value(rows[:1], "{percent:.2f} ± {percent_error:.2f}") == "0.83 ± 0.02"
    assert pages.value(rows[1:2], "{percent:.2f} ± {percent_error:.2f}") == "0.19"
    assert pages.value(rows, "{percent:.1f} %") == "0.2 % to 0.8 %"
    with pytest.raises(ValueError, match="'per_cent'; there are percent, percent_error"):
        pages.value(rows, "{per_cent}")
    with pytest.raises(ValueError, match="percent"):
        pages.value(rows[:0], "{percent}")
