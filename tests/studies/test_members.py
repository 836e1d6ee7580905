"""Studies that read the members of ensembles, and the plans that are shipped."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from openmm_sier.cli.ensembles import read_plan
from openmm_sier.cli.files.checkpoints import read_checkpoint
from openmm_sier.cli.finished_runs import open_runs
from studies import liquid_figure
from studies.hmc import members
from studies.records import Record
from tests.support.commands import SYSTEMS, run
from tests.support.finished_runs import write_run

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROWS = 400

PLANS = sorted(path.name for path in SYSTEMS.glob("*.toml"))


def columns(seed, energy):
    """A log whose values are independent, so that each of them is a sample."""
    rng = np.random.default_rng(seed)
    found = {"Time (ps)": 0.12 * np.arange(ROWS), "Potential Energy (kJ/mole)": energy + rng.normal(size=ROWS)}
    return found | {"Box Volume (nm^3)": 7 + 0.1 * rng.normal(size=ROWS)}


def trials(seed, energy):
    errors = np.random.default_rng(seed).normal(scale=0.1, size=ROWS)
    return columns(seed, energy) | {"Acceptance": np.full(ROWS, 0.9), "Energy Error (kT)": errors}


@pytest.fixture
def runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("box.pdb").touch()
    common = {"pressure": 1.0, "report_every": 0.12, "time": 0.12 * (ROWS - 1)}
    hmc = common | {"ensemble": "hmc", "dt": 6.0, "steps_per_trial": 5}
    langevin = common | {"ensemble": "npt", "scheme": "langevinmiddle", "dt": 4.0, "hydrogen_mass": 3.0}
    return [
        write_run("a", trials(1, -10.0), seed=1, **hmc),
        write_run("b", trials(2, -10.0), seed=2, **hmc),
        write_run("c", columns(3, -11.0), seed=1, **langevin),
    ]


def test_costs_of_members(runs, tmp_path):
    settings = members.MemberSettings(runs=tuple(map(Path, runs)), out=tmp_path)
    hmc, langevin = members.study(settings).tables["rows"].to_dict("records")
    assert hmc["label"] == "box: SIER4G, trials of 30 fs, steps of 6 fs"
    assert langevin["label"].endswith("steps of 4 fs, friction 1/ps, hydrogens of 3")
    (plan,) = (run.plan for run in open_runs([Path(runs[2])]))
    assert plan.title.endswith("1 bar, hydrogens of 3, 4 fs")
    assert (hmc["runs"], langevin["runs"]) == (2, 1)
    assert hmc["accepted"] == pytest.approx(0.9)
    # 400 numbers tell a standard deviation to 4 %, 800 to 2.5 %.
    assert hmc["spread"] == pytest.approx(0.1, rel=0.1)
    assert np.isnan(langevin["spread"])
    assert hmc["potential"] == pytest.approx(-10, abs=0.2)
    # Four trials of 15 forces, an energy for each and one for the move of the volume; 30 steps, and 30/25 moves. What
    # is independent has an inefficiency of 1, which is estimated from above.
    assert 68 <= hmc["potential_cost"] < 1.5 * 68
    assert 31.2 <= langevin["volume_cost"] < 1.5 * 31.2
    assert (tmp_path / "members.json").exists()


@pytest.mark.slow
def test_dipoles_and_dihedrals_are_those_of_the_frames(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = ["--ensemble", "hmc", "--dt", "4", "--steps-per-trial", "1", "--cutoff", "0.7", "--platform", "CPU"]
    options += [
        "--no-minimize",
        "--equilibrate",
        "0.004",
        "--time",
        "0.04",
        "--every",
        "0.004",
        "--report-every",
        "0.004",
    ]
    run("run", SYSTEMS / "dipeptide.pdb", *options, "--out", "a.dcd")
    (made,) = open_runs([Path("a.chk")])
    found = members.in_frames(made, 0.02)
    assert {name: each.shape for name, each in found.items()} == {"dipole": (5, 3), "psi": (5, 1)}
    _, notes = read_checkpoint(Path("a.chk"))
    assert notes["trajectory"]["count"] == 10
    # Beta, in which the file is, and molecules that are whole: no dipole of 236 of them is as long as the box.
    assert (found["psi"]["psi"] < 0).all()
    assert np.abs(found["dipole"].to_numpy()).max() < 5


def test_forces_of_a_step(runs):
    assert [members.forces_per_step(run) for run in open_runs([Path(runs[0]), Path(runs[2])])] == [17, 1 + 1 / 25]


def test_curves_of_a_record_are_drawn(tmp_path):
    curve = pd.DataFrame({"x": [0.0, 1.0], "y": [1.0, 2.0]})
    record = Record({}, {"pairs": curve, "viscosity": curve.assign(error=0.1)}, {"title": "Water"})
    liquid_figure.figure(record, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")


#: Boxes of plans that are too large to be shipped, and how the plan, the page of its study and the README of the boxes
#: say that they are made.
TO_BE_MADE = {
    "dhfr.pdb": "python -m studies.hmc.solvated dhfr --pdb systems/dhfr.pdb",
    "long.pdb": "python systems/peptide.py --long --time 1 --out systems/long.pdb",
}


def boxes_of(plan):
    """The boxes that a plan names, in its options and its members."""
    tables = tomllib.loads(plan.read_text())
    named = [table["box"] for table in (tables["options"], *tables["members"]) if "box" in table]
    return {box for names in named for box in ([names] if isinstance(names, str) else names)}


@pytest.mark.parametrize("plan", PLANS)
def test_shipped_plans_can_be_read(plan, tmp_path):
    """All of their options are checked as on the command line. Boxes are shipped, or stand-ins for those to be made."""
    copy = Path(shutil.copy(SYSTEMS / plan, tmp_path))
    for name in TO_BE_MADE:
        (tmp_path / name).touch()
    made = read_plan(copy)
    assert len({member.name for member in made}) == len(made) > 1


@pytest.mark.parametrize("plan", PLANS)
def test_boxes_of_plans_are_shipped_or_can_be_made(plan):
    tracked = {path.name for path in SYSTEMS.glob("*.pdb")} - set(TO_BE_MADE)
    boxes = boxes_of(SYSTEMS / plan)
    assert boxes
    for box in boxes - tracked:
        pages = (SYSTEMS / plan, SYSTEMS / "README.md", SYSTEMS.parent / "docs" / "measurements" / "studies.md")
        for page in pages:
            assert TO_BE_MADE[box] in page.read_text(), page


def test_plans_are_listed():
    """In the README of the boxes, with what they are for, and in the list of studies or a page that it leads to."""
    readme = (SYSTEMS / "README.md").read_text()
    listed = (SYSTEMS.parent / "docs" / "measurements" / "studies.md").read_text()
    for plan in PLANS:
        assert f"| `{plan}` |" in readme
        assert f"systems/{plan}" in listed
