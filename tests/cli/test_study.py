"""`openmm-sier study` on short runs: what belongs together, what is left out, and the plan that is shipped."""

from __future__ import annotations

from pathlib import Path

import pytest

from openmm_sier.cli.ensembles import read_plan
from openmm_sier.cli.plan import Options, new_plan
from openmm_sier.cli.properties import ROWS, Run, estimated
from tests.support.commands import SYSTEMS, complaint, log, run

SHORT = ["--platform", "Reference", "--equilibrate", "0.01", "--every", "0.012", "--report-every", "0.006"]
SHORT += ["--dt", "6", "--time", "0.12"]


def test_the_shipped_plan_has_equal_steps_per_force():
    members = read_plan(SYSTEMS / "step-study.toml")
    assert len(members) == 66
    assert len({member.name for member in members}) == 66
    steps = {}
    for member in members:
        given = dict(zip(member.arguments[2::2], member.arguments[3::2], strict=True))
        forces = 3 if given["--scheme"] == "sier4g" else 1
        steps.setdefault((given["--scheme"], given["--ensemble"]), set()).add(float(given["--dt"]) / forces)
    assert steps.pop(("sier4g", "hmc")) == {2, 3}
    assert set(map(tuple, map(sorted, steps.values()))) == {(0.5, 1, 2, 3, 4)}


def test_momenta_that_are_drawn_anew_tell_no_diffusion():
    plan = new_plan(Options(Path("box.pdb"), ensemble="hmc"))
    (diffusion,) = [row for row in ROWS if row.key == "diffusion"]
    assert estimated(diffusion, [Run(plan, {}, None, 512, None)]) == {plan.out: None}


@pytest.mark.slow
def test_members_become_a_table_and_a_figure(box, capsys):
    """Two seeds of one method, another method, and a run that is not at its end."""
    for name, scheme, seed in (("a1", "sier2", "1"), ("a2", "sier2", "2"), ("b", "langevinmiddle", "1")):
        Path(name).mkdir()
        chosen = ["--scheme", scheme, "--ensemble", "npt", "--seed", seed, "--checkpoint-every", "1"]
        run("run", box, *SHORT, *chosen, "--out", f"{name}/run.dcd")
    Path("none").mkdir()
    capsys.readouterr()
    run("study", "a1", "a2", "b", "none", "--out", "found")
    said = " ".join(capsys.readouterr().out.split())
    assert "left out: none has no checkpoint yet" in said
    lines = Path("found/step-study.md").read_text().splitlines()
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines[2:]]
    # 20 steps of 6 fs from 0 to 0.12 ps; no part of it is long enough for diffusion.
    assert [line[1:6] for line in cells] == [
        ["SIER2", "6", "6", "2", "0.24"],
        ["OpenMM LangevinMiddle", "6", "6", "1", "0.12"],
    ]
    assert [line[-1] for line in cells] == ["-", "-"]
    # Means are rounded to the digits of their errors, which few samples tell.
    assert "≥" in cells[1][7]
    means = {name: values.mean() for name, values in log("b/run.csv").items()}
    assert float(cells[1][7].split()[0]) == pytest.approx(means["Rotational Temperature (K)"], abs=1)
    assert float(cells[1][8].split()[0]) == pytest.approx(means["Density (g/mL)"], abs=1e-3)
    assert Path("found/step-study.png").exists()


def test_runs_of_two_states_are_no_study(box, capsys):
    """A tiny run each: the check comes before trajectories are read."""
    for name, temperature in (("cold", "290"), ("hot", "310")):
        Path(name).mkdir()
        chosen = ["--scheme", "sier2", "--ensemble", "nvt", "--temperature", temperature, "--steps", "1"]
        run("run", box, *SHORT[:-2], *chosen, "--out", f"{name}/run.dcd")
    capsys.readouterr()
    said = complaint(capsys, "study", "cold", "hot")
    assert "has temperature 310" in said
    assert "a study is of one state of the liquid" in said
