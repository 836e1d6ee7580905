"""Properties against the step: what belongs together, what is left out, and the plan that is shipped."""

from pathlib import Path

import pytest

from openmm_sier.cli.plan import Options, new_plan
from openmm_sier.cli.properties import ROWS, Run, estimated
from studies import step_study
from studies.step_study import StepSettings
from tests.support.commands import log, run, write_lattice
from tests.support.reports import Told

SHORT = ["--platform", "Reference", "--equilibrate", "0.01", "--every", "0.012", "--report-every", "0.012"]
SHORT += ["--dt", "6", "--time", "0.06"]


@pytest.fixture
def box(tmp_path, monkeypatch):
    """A box, and a directory for runs of it."""
    monkeypatch.chdir(tmp_path)
    return write_lattice(tmp_path / "box.pdb")


def test_momenta_that_are_drawn_anew_tell_no_diffusion():
    plan = new_plan(Options(Path("box.pdb"), ensemble="hmc"))
    (diffusion,) = [row for row in ROWS if row.key == "diffusion"]
    assert estimated(diffusion, [Run(plan, {}, None, 512, None)]) == {plan.out: None}


@pytest.mark.slow
def test_members_become_a_table_and_a_figure(box, tmp_path):
    """Two seeds of one method, another method, and a run that is not at its end."""
    pytest.importorskip("pymbar")
    for name, scheme, seed in (("a1", "sier2", "1"), ("a2", "sier2", "2"), ("b", "langevinmiddle", "1")):
        Path(name).mkdir()
        chosen = ["--scheme", scheme, "--ensemble", "npt", "--seed", seed, "--checkpoint-every", "1"]
        run("run", box, *SHORT, "--report-every", "0.006", "--time", "0.12", *chosen, "--out", f"{name}/run.dcd")
    Path("none").mkdir()
    told = Told()
    members = tuple(map(Path, ("a1", "a2", "b", "none")))
    rows = step_study.study(StepSettings(out=tmp_path, runs=members), told).tables["rows"]
    assert "left out: none has no checkpoint yet" in told.notes
    assert list(rows["method"]) == ["SIER2", "OpenMM LangevinMiddle"]
    assert list(rows["runs"]) == [2, 1]
    # 20 steps of 6 fs; no part of it is long enough for diffusion.
    assert list(rows["time"]) == pytest.approx([0.24, 0.12])
    assert rows["diffusion"].isna().all()
    means = {name: values.mean() for name, values in log("b/run.csv").items()}
    assert rows["rotation"][1] == pytest.approx(means["Rotational Temperature (K)"])
    assert rows["density"][1] == pytest.approx(means["Density (g/mL)"])
    assert {path.name for path in tmp_path.iterdir()} >= {"step-study.json", "step-study.png"}
