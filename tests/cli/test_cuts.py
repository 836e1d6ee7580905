"""A restart cuts off records of a killed run after its checkpoint, and refuses to cut a run that continued."""

import os
import shutil
from pathlib import Path

import numpy as np
import openmm
import pytest
from openmm import app, unit

from openmm_sier.cli.files.checkpoints import read_notes
from openmm_sier.cli.files.records import Log
from openmm_sier.cli.files.trajectories import DCDTrajectory, XTCTrajectory
from tests.support.commands import SMALL, complaint, contents, frames, run, write_lattice

TENSORS = ["--pressure-tensor", "p.csv", "--pressure-tensor-every", "0.04"]
AGAIN = ["run", "../box.pdb", "--platform", "Reference"]

#: Checkpoints of `SMALL` are 25 steps apart, frames 5, rows of the log and of tensors 10.
FIRST, WITHIN, BEYOND = 25, 45, 60


@pytest.fixture(scope="module")
def longer(tmp_path_factory):
    """A directory with a run and copies of its checkpoint at `FIRST` and at `WITHIN`, for two kinds of trajectory."""
    place = tmp_path_factory.mktemp("longer")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        write_lattice(Path("box.pdb"), 8)
        for kind in ("dcd", "xtc"):
            Path(kind).mkdir()
            patch.chdir(place / kind)
            run("run", "../box.pdb", *SMALL, *TENSORS, "--out", f"box.{kind}", "--steps", FIRST)
            shutil.copyfile("box.chk", "old.chk")
            for steps in (WITHIN, BEYOND):
                shutil.copytree(".", place / f"{kind}-{steps}")
                patch.chdir(place / f"{kind}-{steps}")
                run(*AGAIN, "--restart", "box.chk", "--steps", steps)
            patch.chdir(place)
    return place


@pytest.fixture
def there(longer, tmp_path, monkeypatch):
    """A function that goes to a copy of one of the runs."""
    shutil.copyfile(longer / "box.pdb", tmp_path / "box.pdb")

    def go(kind, steps):
        shutil.copytree(longer / f"{kind}-{steps}", tmp_path / "here")
        monkeypatch.chdir(tmp_path / "here")

    return go


@pytest.mark.parametrize("kind", ["dcd", "xtc"])
@pytest.mark.parametrize("steps", [WITHIN, BEYOND])
def test_a_copy_of_a_checkpoint_does_not_cut_the_run_that_went_on(there, capsys, kind, steps):
    there(kind, steps)
    before = contents(Path())
    message = complaint(capsys, *AGAIN, "--restart", "old.chk", "--steps", FIRST + 5)
    files = f"box.{kind}, box.csv, p.csv go on to {steps * 0.004:g} ps"
    assert f"old.chk is at 0.1 ps, but {files}; box.chk is a later checkpoint" in message
    assert "Give box.chk to --restart" in message
    assert contents(Path()) == before
    run(*AGAIN, "--restart", "box.chk", "--steps", steps + 5)
    assert "cuts back" not in capsys.readouterr().out


def test_without_a_later_checkpoint_what_no_killed_run_leaves_is_kept(there, capsys):
    there("dcd", BEYOND)
    Path("box.chk").unlink()
    # These are no checkpoints of this run: nothing is said of them.
    Path("no.chk").write_text("something else")
    before = contents(Path())
    message = complaint(capsys, *AGAIN, "--restart", "old.chk", "--steps", FIRST + 5)
    assert "a killed run writes less after its last checkpoint" in message
    assert "Give the last checkpoint of the run to --restart" in message
    assert contents(Path()) == before
    notes = read_notes(Path("old.chk"))
    for path, noted in (("box.dcd", notes.trajectory), ("p.csv", notes.tensors)):
        os.truncate(path, noted.size)
    message = complaint(capsys, *AGAIN, "--restart", "old.chk", "--steps", FIRST + 5)
    assert f"box.csv goes on to {BEYOND * 0.004:g} ps" in message
    assert "would cut this file" in message


@pytest.mark.parametrize("kind", ["dcd", "xtc"])
def test_records_of_a_killed_run_are_cut_off_and_reported(there, capsys, kind):
    """As after SIGKILL: the checkpoint is that of `FIRST`, and the last frame is incomplete."""
    there(kind, WITHIN)
    shutil.move("old.chk", "box.chk")
    with open(f"box.{kind}", "r+b") as file:
        file.truncate(file.seek(0, 2) - 10)
    run(*AGAIN, "--restart", "box.chk", "--steps", FIRST + 5)
    # Rows are written every 10 steps, of which 40 is the last.
    message = (
        f"cuts back to 0.1 ps, where box.chk is: box.{kind} from 0.18 ps, box.csv from 0.16 ps, p.csv from 0.16 ps"
    )
    assert message in capsys.readouterr().out
    assert frames(Path(f"box.{kind}"), Path("../box.pdb")).n_frames == (FIRST + 5) // 5


def test_overwrite_allows_the_cut_and_the_cut_is_reported(there, capsys):
    there("dcd", BEYOND)
    run(*AGAIN, "--restart", "old.chk", "--steps", FIRST + 5, "--overwrite")
    assert "cuts back to 0.1 ps, where old.chk is: box.dcd from 0.24 ps" in capsys.readouterr().out
    assert frames(Path("box.dcd"), Path("../box.pdb")).n_frames == (FIRST + 5) // 5


# --- records ---


@pytest.mark.parametrize("kind", [DCDTrajectory, XTCTrajectory])
@pytest.mark.parametrize("has_box", [True, False])
@pytest.mark.parametrize("atoms", [3, 9, 10, 40])
def test_frames_after_a_length_are_counted(kind, has_box, atoms):
    """XTC has another layout for up to nine atoms."""
    topology = app.Topology()
    box = [openmm.Vec3(*row) for row in 2 * np.eye(3)] * unit.nanometer if has_box else None
    residue = topology.addResidue("M", topology.addChain())
    for _ in range(atoms):
        topology.addAtom("X", None, residue)
    topology.setPeriodicBoxVectors(box)
    file = kind(Path("frames"), topology, 0.004, 5, None)
    lengths, places = [file.size], np.random.default_rng(1).normal(size=(4, atoms, 3))
    for positions in places:
        file.write(positions * unit.nanometer, box)
        lengths.append(file.size)
    assert [kind.records_after(file.path, length) for length in lengths] == [4, 3, 2, 1, 0]
    assert all(kind.are_records(file.path, length) for length in lengths)
    assert not any(kind.are_records(file.path, length) for length in (1, lengths[-1] + 1))
    for lost in (1, 4, 50):
        with open("frames", "r+b") as cut:
            cut.truncate(lengths[-1] - lost)
        assert [kind.records_after(file.path, length) for length in lengths[:-1]] == [4, 3, 2, 1]
    file.close()


def test_rows_after_a_length_are_counted():
    file = Log(Path("log.csv"), ["Step", "Time (ps)", "b"], None)
    file.write([1, 2, 3])
    length = file.size
    assert Log.records_after(file.path, length) == 0
    assert Log.are_records(file.path, length)
    assert not Log.are_records(file.path, length - 1)
    file.write([3, 4, 5])
    file.append(b"5,", counts=False)
    assert Log.records_after(file.path, length) == 2
    file.close()
