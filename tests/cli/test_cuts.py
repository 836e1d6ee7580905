"""A restart cuts off records of a killed run after its checkpoint, and refuses to cut a run that continued."""

import shutil
from pathlib import Path

import pytest

from openmm_sier.cli.files.records import Log, last_step
from tests.support.commands import SMALL, complaint, contents, frames, run, write_lattice

TENSORS = ["--pressure-tensor", "p.csv", "--pressure-tensor-every", "0.04"]
AGAIN = ["run", "../box.pdb", "--platform", "Reference"]

#: Checkpoints of `SMALL` are 25 steps apart, frames 5, rows of the log and of tensors 10.
FIRST, WITHIN, BEYOND = 25, 45, 60


@pytest.fixture(scope="module")
def longer(tmp_path_factory):
    """A directory with two runs, each with a copy of its checkpoint at `FIRST`."""
    place = tmp_path_factory.mktemp("longer")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        write_lattice(Path("box.pdb"), 8)
        Path("first").mkdir()
        patch.chdir(place / "first")
        run("run", "../box.pdb", *SMALL, *TENSORS, "--out", "box.dcd", "--steps", FIRST)
        shutil.copyfile("box.chk", "old.chk")
        for steps in (WITHIN, BEYOND):
            shutil.copytree(place / "first", place / str(steps))
            patch.chdir(place / str(steps))
            run(*AGAIN, "--restart", "box.chk", "--steps", steps)
    return place


@pytest.fixture
def there(longer, tmp_path, monkeypatch):
    """A function that goes to a copy of one of the runs."""
    shutil.copyfile(longer / "box.pdb", tmp_path / "box.pdb")

    def go(steps):
        shutil.copytree(longer / str(steps), tmp_path / "here")
        monkeypatch.chdir(tmp_path / "here")

    return go


def test_a_copy_of_a_checkpoint_does_not_cut_the_run_that_went_on(there, capsys):
    there(BEYOND)
    before = contents(Path())
    message = complaint(capsys, *AGAIN, "--restart", "old.chk", "--steps", FIRST + 5)
    assert "old.chk is at step 25 (0.1 ps), but box.csv goes on to step 60 (0.24 ps)" in message
    assert "Give the last checkpoint to --restart" in message
    assert contents(Path()) == before
    run(*AGAIN, "--restart", "box.chk", "--steps", BEYOND + 5)
    assert "cuts" not in capsys.readouterr().out


def test_records_of_a_killed_run_are_cut_off_and_reported(there, capsys):
    """As after SIGKILL: the checkpoint is that of `FIRST`, and the last frame and row are incomplete."""
    there(WITHIN)
    shutil.move("old.chk", "box.chk")
    for name in ("box.dcd", "box.csv"):
        with open(name, "r+b") as file:
            file.truncate(file.seek(0, 2) - 10)
    run(*AGAIN, "--restart", "box.chk", "--steps", FIRST + 5)
    message = "cuts box.dcd, box.csv, p.csv back to step 25 (0.1 ps), where box.chk is"
    assert message in " ".join(capsys.readouterr().out.split())
    assert frames(Path("box.dcd"), Path("../box.pdb")).n_frames == (FIRST + 5) // 5


def test_overwrite_allows_the_cut_and_the_cut_is_reported(there, capsys):
    there(BEYOND)
    run(*AGAIN, "--restart", "old.chk", "--steps", FIRST + 5, "--overwrite")
    assert "cuts box.dcd, box.csv, p.csv back to step 25 (0.1 ps)" in capsys.readouterr().out
    assert frames(Path("box.dcd"), Path("../box.pdb")).n_frames == (FIRST + 5) // 5


def test_the_last_step_is_that_of_the_last_whole_row():
    file = Log(Path("log.csv"), ["Step", "Time (ps)", "b"], None)
    with pytest.raises(ValueError, match="Step"):
        last_step(file.path)
    file.write([1, 2, 3])
    file.write([3, 4, 5])
    file.append(b"5,", counts=False)
    assert last_step(file.path) == 3
    file.close()
