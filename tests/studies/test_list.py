"""The list of studies, and the figures of the documentation."""

from importlib import import_module
from pathlib import Path

import pytest

from studies import figures
from studies.__main__ import main, modules, summary

ROOT = Path(__file__).parents[2]


def test_every_study_has_a_summary_and_a_command(capsys):
    for name in modules():
        assert summary(name).endswith((".", "...")), name
        module = f"{name}.__main__" if (ROOT / name.replace(".", "/")).is_dir() else name
        assert import_module(module).main(["--help"]) == 0
        assert "--out" in capsys.readouterr().out, name


def test_the_list_has_studies_and_what_their_records_took(capsys):
    assert {"studies.paper", "studies.hmc.trials", "studies.whole_run"} <= set(modules())
    main()
    assert "9 min of an H200" in " ".join(capsys.readouterr().out.split())


@pytest.mark.thorough
@pytest.mark.parametrize("name", figures.FIGURES)
def test_figures_of_the_documentation_are_drawn_from_the_repository(name, tmp_path):
    figures.study(figures.FigureSettings(names=(name,), out=tmp_path))
    assert (tmp_path / f"{name}.png").stat().st_size > 20_000


def test_figures_that_are_kept_are_there():
    assert {path.stem for path in (ROOT / "docs").glob("*.png")} == set(figures.KEPT)
