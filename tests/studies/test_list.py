"""The list of studies, the page that describes them, and the figures of the documentation."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import pytest

from studies import STUDIES, figures
from studies.__main__ import summary

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "measurements" / "studies.md").read_text()


@pytest.mark.parametrize("name", STUDIES)
def test_every_study_has_a_summary_and_is_on_the_page(name):
    assert summary(name).endswith((".", "..."))
    assert name in PAGE or name.rpartition(".")[2] in PAGE
    module = f"{name}.__main__" if (ROOT / name.replace(".", "/")).is_dir() else name
    assert callable(import_module(module).main)


def test_modules_that_are_commands_are_listed():
    commands = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__main__")
        for path in (ROOT / "studies").rglob("*.py")
        if '__name__ == "__main__"' in (text := path.read_text()) or ", __name__)" in text
    }
    assert commands - {"studies", "studies.paper.member"} == set(STUDIES)


@pytest.mark.slow
def test_figures_of_the_documentation_are_drawn_from_the_repository(tmp_path):
    figures.study(figures.FigureSettings(out=tmp_path))
    drawn = {path.name for path in tmp_path.iterdir()}
    there = {path.name for path in (ROOT / "docs").glob("*.png")}
    assert drawn == there
    assert all(name in PAGE for name in there)
