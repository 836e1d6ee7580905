"""Properties against the step: what belongs together, what is left out, and the plan that is shipped."""

from __future__ import annotations

import math
from pathlib import Path

import pandas as pd
import pytest

from openmm_sier.cli.plan import Options, new_plan
from openmm_sier.cli.properties import ROWS, Run, estimated
from studies import records, step_study
from studies.records import Record
from studies.step_study import MEASURED, StepSettings
from tests.support.commands import log, run, write_lattice
from tests.support.reports import Told

SHORT = ["--platform", "Reference", "--equilibrate", "0.01", "--every", "0.012", "--report-every", "0.012"]
SHORT += ["--dt", "6", "--time", "0.06"]


@pytest.fixture
def box(tmp_path, monkeypatch):
    """A box, and a directory for runs of it."""
    monkeypatch.chdir(tmp_path)
    return write_lattice(tmp_path / "box.pdb")


def row(method, h, forces=1, box="spce-512", time=180.0, **found):
    place = {"box": box, "method": method, "step": forces * h, "fs_per_force": h, "runs": 2, "time": time}
    unknown = dict.fromkeys((name for key in MEASURED for name in (key, f"{key}_error")), math.nan)
    given = {name: x for key, pair in found.items() for name, x in zip((key, f"{key}_error"), pair, strict=True)}
    return place | unknown | given


READ = pd.DataFrame(
    [
        row("SIER4G", 2.0, 3, rotation=(296.8, 0.4), density=(0.998, 0.002), diffusion=(2.5, 0.1)),
        row("OpenMM Verlet", 4.0, density=(0.98, 0.001), energy=(-46.0, math.nan)),
        row("OpenMM Verlet", 1.0, density=(0.99, 0.001)),
        row("SIER4G HMC", 2.0, 3, density=(1.0, 0.003)),
        row("SIER4G", 2.0, 3, box="tip3p-512", density=(0.985, 0.002)),
    ]
)


@pytest.mark.slow
def test_the_table_is_by_box_method_and_step(tmp_path):
    record = Record({}, {"rows": step_study.in_order(READ)}, {"title": "Water"})
    lines = records.markdown(step_study.table(record)).splitlines()
    assert len(lines) == 2 + len(READ)
    assert lines[0].count("|") == lines[1].count("|") == lines[2].count("|")
    found = "- | 296.80 ± 0.40 | 0.9980 ± 0.0020 | - | 2.50 ± 0.10"
    assert lines[2] == f"| spce-512 | SIER4G | 6 | 2 | 2 | 180 | {found} |"
    assert [line.split(" | ")[1:4] for line in lines[3:5]] == [["OpenMM Verlet", str(h), str(h)] for h in (1, 4)]
    assert lines[-1].startswith("| tip3p-512")
    step_study.figure(record, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")


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
    assert {path.name for path in tmp_path.iterdir()} >= {"step-study.json", "step-study.md", "step-study.png"}
