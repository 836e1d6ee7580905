"""The command with molecules that are not rigid."""

import numpy as np
import pytest
from openmm import app, unit

from openmm_sier.cli import new_run
from openmm_sier.cli.main import main
from tests.support.commands import log
from tests.support.peptides import capped_alanine_box


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    path = tmp_path_factory.mktemp("peptide") / "alanine.pdb"
    topology, positions = capped_alanine_box(waters=20)
    with path.open("w") as file:
        app.PDBFile.writeFile(topology, positions * unit.nanometer, file)
    return path


FILES = ["--forcefield", "amber14-all.xml", "amber14/tip3p.xml"]


@pytest.mark.thorough
@pytest.mark.parametrize("constraints", ["hbonds", "none"])
def test_run_and_restart(box, tmp_path, monkeypatch, capsys, constraints):
    """From the start on: without constraints the equilibration's usual step of 6 fs would be refused."""
    monkeypatch.chdir(tmp_path)
    settings = ["--scheme", "sier4g", "--dt", "3", "--platform", "Reference", "--report-every", "0.003"]
    settings += ["--equilibrate", "0.006", "--minimize"]
    assert main(["run", str(box), *FILES, "--constraints", constraints, *settings, "--steps", "4"]) == 0
    assert main(["run", str(box), "--restart", "alanine.chk", "--steps", "8"]) == 0
    rows = log("alanine.csv")
    assert rows["Step"].tolist() == list(range(9))
    assert np.isfinite(rows["Flexible Temperature (K)"]).all()
    out = capsys.readouterr().out
    assert "T of flexible molecules" in out
    assert ("equilibrates in steps of" in out) == (constraints == "none")


@pytest.mark.thorough
def test_advice_names_options_of_the_command(box, tmp_path, monkeypatch, capsys):
    """Steps of 6 fs resonate with bonds to hydrogen, which only a user who asks for it has."""
    monkeypatch.chdir(tmp_path)
    short = ["--platform", "Reference", "--equilibrate", "0", "--no-minimize", "--steps", "1", "--overwrite"]
    assert main(["run", str(box), *FILES, *short]) == 0
    assert "warning" not in capsys.readouterr().out
    assert main(["run", str(box), *FILES, *short, "--constraints", "none", "--dt", "6"]) == 0
    out = capsys.readouterr().out
    assert "A step of 6 fs is long for the bond" in out
    for option in ("--dt", "--hydrogen-mass 4", "--constraints hbonds"):
        assert f"({option})" in out


def test_a_step_that_is_refused_is_refused_before_anything_is_simulated(box, tmp_path, monkeypatch, capsys):
    """Otherwise it would be reported at the first step, after minimization and equilibration."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(new_run, "prepare", lambda *_: pytest.fail("a start was made"))
    assert main(["run", str(box), *FILES, "--platform", "Reference", "--constraints", "none", "--dt", "12"]) == 1
    captured = capsys.readouterr()
    assert "A step of 12 fs is too long for the bond" in captured.out + captured.err
    assert not any(tmp_path.glob("*.dcd"))
