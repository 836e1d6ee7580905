"""What pages show of records: tables, single numbers, what is wrong with them, and that no table of a page is typed."""

import re
from io import StringIO
from pathlib import Path

import pandas as pd
import pytest

from studies import STUDIES, pages, sources
from studies.records import Record
from studies.report import Table

ROOT = Path(__file__).parents[2]
#: `studies.claims` makes the page of claims, and a test of its own holds it up to date.
PAGES = sorted(set((ROOT / "docs" / "measurements").glob("*.md")) - {ROOT / "docs" / "measurements" / "trust.md"})

ROWS = pd.DataFrame(
    [("SIER2", 2.0, 0.83, 0.02, None), ("SIER4G", 2.0, 0.08, None, None), ("SIER2", 1.0, 0.19, 0.01, None)],
    columns=["method", "h", "percent", "percent_error", "unknown"],
)


@pytest.fixture
def data(tmp_path, monkeypatch):
    """A folder with one record, in place of `studies/data`."""
    Record({}, {"rows": ROWS, "others": ROWS[:1]}, {}).write(tmp_path / "a.json")
    monkeypatch.setattr(pages, "DATA", tmp_path)
    return tmp_path


def test_rows_columns_and_errors(data):
    columns = {"scheme": "{method}", "fs": "{h:g}", "%": "{percent_text}", "what": "{unknown}", "none": "{missing:.2f}"}
    made = pages.table(pages.chosen("a.json", "h == 2"), columns)
    # Columns in which nothing is known are left out, those too that the record does not have.
    assert made.columns == ["scheme", "fs", "%"]
    assert made.rows == [["SIER2", "2", "0.830 ± 0.020"], ["SIER4G", "2", "0.08 ± ?"]]


def test_a_column_for_each_value_of_another(data):
    rows = pages.chosen("a.json", sort="h")
    made = pages.table(rows, {"fs": "{h:g}", "%": "{percent:.2f}"}, across="method")
    assert made.columns == ["fs", "SIER2, %", "SIER4G, %"]
    assert made.rows == [["1", "0.19", "-"], ["2", "0.83", "0.08"]]
    assert pages.table(rows, {"fs": "{h:g}", "-": "{percent:.2f}"}, across="method").columns[1:] == ["SIER2", "SIER4G"]


def test_numbers_in_sentences(data):
    assert pages.value("a.json others | method == 'SIER2' | {percent:.2f} ± {percent_error:.2f}") == "0.83 ± 0.02"
    assert pages.value("a.json | method == 'SIER2' | {percent:.1f} %") == "0.2 % to 0.8 %"
    assert pages.value("a.json | h == 2 and method == 'SIER4G' | {percent:.2f} ± {percent_error:.2f}") == "0.08"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a.json | {percent}", "expected FILE TABLE | WHERE | FORMAT, got"),
        ("a.json none | h == 2 | {percent}", "a.json has no table 'none'; it has rows, others"),
        ("a.json | h == 5 | {percent}", "a.json has no rows where h == 5"),
        ("a.json | h == 2 | {per_cent}", "a.json has no column 'per_cent'; it has method, h, percent"),
    ],
)
def test_what_a_record_does_not_have_is_told(data, text, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        pages.value(text)


def test_columns_and_tables_of_studies():
    assert "gain" in pages.columns_of("whole_run.GAINS", ["drift, Verlet/kJ/mol/ps"])
    assert "ps" not in pages.columns_of("whole_run.GAINS", ["ps"])
    assert isinstance(pages.made_by("defaults.tables 0", "defaults.json"), Table)
    assert any("studies.whole_run" in row[0] for row in pages.studies().rows)


def test_every_record_has_its_command():
    assert set(sources.COMMANDS) == {path.name for path in sources.DATA.iterdir()}
    named = {name for each in sources.COMMANDS.values() for name in re.findall(r"-m (studies[\w.]*)", " ".join(each))}
    assert named <= set(STUDIES)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_no_table_of_a_page_is_typed(page):
    """Tables of Markdown have a line of dashes between strokes."""
    assert not re.search(r"^\s*\|?\s*:?-{2,}:?\s*\|", page.read_text(), re.MULTILINE)


PAGE = """# Page

```{record} a.json
:where: h == 2
scheme: {method}
%: {percent:.2f}
```

It has {value}`a.json others | h == 2 | {percent:.2f}` %.

```{studies}
```
"""

WRONG = """
```{record} a.json none
scheme: {method}
```

{value}`a.json | h == 7 | {percent}`

```{drawn} none
A figure.
```
"""


@pytest.mark.slow
def test_a_page_is_made_from_records(data, tmp_path, monkeypatch):
    """A small site: what it shows, and that the place of each fault is told."""
    application = pytest.importorskip("sphinx.application", reason="install the extra docs")
    pytest.importorskip("myst_parser", reason="install the extra docs")
    monkeypatch.setitem(sources.COMMANDS, "a.json", ("python -m studies.a",))
    monkeypatch.syspath_prepend(ROOT / "docs" / "_extensions")
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "conf.py").write_text("extensions = ['myst_parser', 'records']\n")
    told = StringIO()
    for text in (PAGE, PAGE + WRONG):
        (tmp_path / "site" / "index.md").write_text(text)
        folders = [str(tmp_path / name) for name in ("site", "site", "out", "trees")]
        application.Sphinx(*folders, "html", status=None, warning=told, freshenv=True).build()
        made = (tmp_path / "out" / "index.html").read_text()
        assert "<td><p>SIER4G</p></td>\n<td><p>0.08</p></td>" in made
        made = re.sub("<[^>]+>", "", made)
        assert "It has 0.83 %." in made
        assert "python -m studies.a" in made
        assert "python -m studies.whole_run" in made
        assert bool(told.getvalue()) == (text != PAGE)
    first = len(PAGE.splitlines())
    for line, message in (
        (2, "a.json has no table 'none'"),
        (6, "a.json has no rows where h == 7"),
        (8, "unknown figure 'none'; known are acceptance"),
    ):
        assert re.search(rf"index.md:{first + line}: ERROR: .*{message}", told.getvalue())
