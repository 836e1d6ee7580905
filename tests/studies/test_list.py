"""The list of studies, and the figures of the documentation."""

from importlib import import_module
from pathlib import Path

import pytest

from studies import STUDIES, figures
from studies.__main__ import summary

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("name", STUDIES)
def test_every_study_has_a_summary_and_a_command(name):
    assert summary(name).endswith((".", "..."))
    module = f"{name}.__main__" if (ROOT / name.replace(".", "/")).is_dir() else name
    assert callable(import_module(module).main)


def test_modules_that_are_commands_are_listed():
    commands = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__main__")
        for path in (ROOT / "studies").rglob("*.py")
        if '__name__ == "__main__"' in (text := path.read_text()) or ", __name__)" in text
    }
    assert commands - {"studies"} == set(STUDIES)


@pytest.mark.slow
@pytest.mark.parametrize("name", figures.FIGURES)
def test_figures_of_the_documentation_are_drawn_from_the_repository(name, tmp_path):
    figures.study(figures.FigureSettings(names=(name,), out=tmp_path))
    assert (tmp_path / f"{name}.png").stat().st_size > 20_000


def test_figures_that_are_kept_are_there():
    assert {path.stem for path in (ROOT / "docs").glob("*.png")} == set(figures.KEPT)
