"""Properties against the step: runs, their grouping, and missing properties."""

import subprocess
from types import SimpleNamespace

import mdtraj
import numpy as np
import pytest

from openmm_sier.cli import main
from studies import command_runs, records, step_study
from studies.command_runs import RunFailed
from studies.step_study import StepSettings
from tests.support.commands import log, write_lattice
from tests.support.reports import RecordingReport
from tests.support.studies import make_here

SHORT = {"platform": "Reference", "equilibrate": 0.01, "every": 0.012, "report_every": 0.006, "checkpoint_every": 1.0}


@pytest.fixture
def box(tmp_path, monkeypatch):
    """The name of a box whose runs are short, and end at once."""
    monkeypatch.setattr(step_study, "SYSTEMS", tmp_path)
    monkeypatch.setattr(step_study, "OPTIONS", step_study.OPTIONS | SHORT)
    monkeypatch.setattr(step_study, "EVERY", SHORT["every"])
    monkeypatch.setattr(records, "make_missing", make_here)
    write_lattice(tmp_path / "lattice.pdb")
    return "lattice"


@pytest.fixture
def in_this_process(monkeypatch):
    """Commands of `command_runs` run without processes of their own."""

    def execute(line, cwd, **options):
        with monkeypatch.context() as there:
            there.chdir(cwd)
            return subprocess.CompletedProcess(line, main.main(line[3:]), stderr="")

    monkeypatch.setattr(command_runs, "subprocess", SimpleNamespace(run=execute))


def settings(box, tmp_path, *methods, **more):
    points = {"per_force": (6.0,), "times": (0.12,), "skip": 0.0} | more
    return StepSettings(out=tmp_path, boxes=(box,), methods=methods, **points)


@pytest.mark.thorough
@pytest.mark.usefixtures("in_this_process")
def test_runs_become_a_table_and_a_figure(box, tmp_path):
    """Two seeds of one method, then another method, which is added to the table; nothing is made twice."""
    step_study.study(settings(box, tmp_path, "sier2", starts=2))
    report = RecordingReport()
    rows = step_study.study(settings(box, tmp_path, "sier2", "langevinmiddle"), report).tables["rows"]
    assert len(report.notes) == 1
    assert list(rows["method"]) == ["OpenMM LangevinMiddle", "SIER2"]
    assert list(rows["runs"]) == [1, 2]
    # 20 steps of 6 fs; too short for diffusion.
    assert list(rows["time"]) == pytest.approx([0.12, 0.24])
    assert rows["diffusion"].isna().all()
    means = {name: values.mean() for name, values in log(tmp_path / "lattice-langevinmiddle-6fs-seed1/run.csv").items()}
    assert rows["rotation"][0] == pytest.approx(means["Rotational Temperature (K)"])
    assert rows["density"][0] == pytest.approx(means["Density (g/mL)"])
    assert rows["energy"][0] == pytest.approx(means["Potential Energy (kJ/mole)"] / 27)
    assert {path.name for path in tmp_path.iterdir()} >= {"step-study.json", "step-study.png"}


@pytest.mark.thorough
def test_a_longer_run_continues_and_replaces_the_shorter(box, tmp_path):
    first, second = (settings(box, tmp_path, "sier2", times=(time,)) for time in (0.12, 0.24))
    rows = [step_study.study(each).tables["rows"].iloc[0] for each in (first, second)]
    assert [row["time"] for row in rows] == pytest.approx([0.12, 0.24])
    assert [row["runs"] for row in rows] == [1, 1]


@pytest.mark.thorough
@pytest.mark.usefixtures("in_this_process")
def test_independent_momenta_have_no_diffusion(box, tmp_path):
    wanted = settings(box, tmp_path, "hmc", per_force=(2.0,), times=(0.24,))
    result = step_study.run(next(step_study.tasks(wanted)))
    assert result["method"] == "SIER4G HMC"
    # Trials of ten steps of 6 fs.
    assert result["time"] == pytest.approx(0.24)
    assert "diffusion" not in result


@pytest.mark.thorough
def test_a_run_that_fails_is_reported(box, tmp_path):
    with pytest.raises(RunFailed, match=r"verlet-0.01fs-seed1 failed: .*expected a number from 0.05 to 1000 fs"):
        step_study.study(settings(box, tmp_path, "verlet", per_force=(0.01,)))


def test_a_method_has_its_step():
    methods = {"methods": ("verlet", "sier4g", "hmc"), "boxes": ("spce-512",)}
    of = list(step_study.tasks(StepSettings(**methods, per_force=(2.0,), times=(30.0,))))
    assert [task.point["step"] for task in of] == [2.0, 6.0, 6.0]
    assert [task.point["method"] for task in of] == ["OpenMM Verlet", "SIER4G", "SIER4G HMC"]
    with pytest.raises(ValueError, match="unknown method 'leapfrog'"):
        next(step_study.tasks(StepSettings(methods=("leapfrog",))))


def test_diffusion_of_molecules_that_walk(tmp_path):
    """Steps of 0.01 nm in each direction every 0.504 ps, through the faces of the box."""
    topology = mdtraj.load(str(write_lattice(tmp_path / "box.pdb"))).topology
    rng, interval = np.random.default_rng(1), 42 * 0.012
    walk = rng.normal(scale=0.01, size=(400, topology.n_residues, 3)).cumsum(axis=0)
    frames = mdtraj.Trajectory(np.mod(np.repeat(walk, 3, axis=1), 1.0), topology)
    frames.unitcell_lengths, frames.unitcell_angles = np.ones((400, 3)), np.full((400, 3), 90.0)
    value = step_study.diffusion(frames, 0.012, 5.0)
    # In 10⁻⁹ m²/s; the mean motion of 27 molecules, which is left out, has a part of 1/27.
    assert value.value == pytest.approx(1e3 * 0.01**2 / (2 * interval) * 26 / 27, abs=4 * value.error)
