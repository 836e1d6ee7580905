"""Pages in HTML: all that is known of a run or of several, in one file."""

import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

from openmm_sier.inputs import equilibration
from openmm_sier.version import __version__
from tests.support.commands import SMALL, run
from tests.support.logs import write_log

pytest.importorskip("matplotlib")

#: Elements that have no end.
VOID = {"meta"}


class Reader(HTMLParser):
    """Reads a page: its text by element, what it loads, and whether all elements end."""

    def __init__(self, page):
        super().__init__()
        self.texts, self.loaded, self.open = {}, [], []
        self.feed(page)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self.open.append(tag)
        self.loaded += [value for name, value in attrs if name.split(":")[-1] in ("src", "href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_startendtag(self, tag, attrs):
        self.loaded += [value for name, value in attrs if name.split(":")[-1] in ("src", "href")]

    def handle_data(self, data):
        if self.open and data.strip():
            self.texts.setdefault(self.open[-1], []).append(data.strip())


def read(path):
    page = Path(path).read_text()
    reader = Reader(page)
    # Nothing is loaded from elsewhere: SVG refers to its own parts.
    assert all(place.startswith("#") for place in reader.loaded)
    return reader.texts


def test_a_page_has_settings_means_warnings_and_versions(box, monkeypatch):
    monkeypatch.setattr(equilibration, "_are_within_bounds", lambda *_: False)
    run("run", box, *SMALL, "--time", "0.2", "--seed", "7", "--plot", "a.html")
    texts = read("a.html")
    headings = ["Means", "Course", "Settings", "Versions, where this page was made"]
    assert texts["h2"] == headings
    cells = texts["td"]
    assert cells[cells.index("seed") + 1] == "7"
    assert cells[cells.index("dt") + 1] == "4.0"
    assert cells[cells.index("openmm_sier") + 1] == __version__
    assert any(text.startswith("drift of the conserved energy") for text in cells)
    assert any(re.match(r"warning: box.csv: not equilibrated, after 0.1", text) for text in texts["p"])
    # The same log gives the same page.
    before = Path("a.html").read_bytes()
    run("plot", "box.csv", "--out", "a.html")
    assert Path("a.html").read_bytes() == before


def test_a_page_of_several_runs_of_which_nothing_else_is_known():
    names = [f"a<b>&{seed}.csv" for seed in range(1, 6)]
    for seed, name in enumerate(names, 1):
        write_log(name, "npt", seed=seed)
    run("summary", *names, "--plot", "a.html")
    texts = read("a.html")
    assert texts["h2"] == ["Means", "Course", "Versions, where this page was made"]
    assert texts["h1"] == ["5 runs, 20 ps"]
    assert texts["p"] == ["20 ps without a trend of energy, temperatures or density"]
    assert texts["td"][: len(names) + 1] == ["mean over runs", *(Path(name).stem for name in names)]
