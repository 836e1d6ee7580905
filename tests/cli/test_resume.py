"""`run --resume`: one command line that begins, continues and completes a run, for arrays of jobs."""

import shutil
from pathlib import Path

import pytest

from openmm_sier.cli import main
from openmm_sier.cli.files import checkpoints
from openmm_sier.cli.files.locks import FileLocks
from tests.support.commands import SMALL, complaint, contents, frames, run
from tests.support.matrices import representatives

WHOLE, PART = ["--time", "0.2"], ["--time", "0.1"]


def resume(box, *options, out="a.dcd"):
    return ["run", box, *SMALL, "--out", out, *options, "--resume"]


@pytest.fixture(scope="module")
def whole_run(box, tmp_path_factory):
    """Directory of a run of 0.2 ps that began by --resume."""
    place = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        run(*resume(box, *WHOLE))
    return place


def files(place):
    return {name: (Path(place) / name).read_bytes() for name in ("a.dcd", "a.csv")}


def test_the_same_line_begins_continues_and_completes_a_run(box, whole_run, capsys):
    run(*resume(box, *PART))
    assert checkpoints.read_checkpoint(Path("a.chk"))[1].step == 25
    with open("a.csv", "a") as file:
        file.write("30,0.12,-1")
    run(*resume(box, *WHOLE))
    assert files(".") == files(whole_run)
    capsys.readouterr()
    before = contents(Path())
    run(*resume(box, *WHOLE))
    output = capsys.readouterr()
    assert "a.chk is at step 50 (0.2 ps): the run is complete" in output.out
    # The job that finds it complete tells what came out, too.
    assert "drift of the conserved energy" in output.out
    assert output.err == ""
    assert contents(Path()) == before


@pytest.mark.thorough
def test_a_complete_run_is_drawn(box, whole_run):
    pytest.importorskip("matplotlib")
    shutil.copytree(whole_run, ".", dirs_exist_ok=True)
    for _ in range(2):
        run(*resume(box, *WHOLE, "--plot", "a.png"))
        assert Path("a.png").read_bytes().startswith(b"\x89PNG")


def test_a_complete_run_of_which_a_file_is_missing_is_not_complete(box, whole_run, capsys):
    shutil.copytree(whole_run, ".", dirs_exist_ok=True)
    Path("a.dcd").unlink()
    assert "a.dcd, which the run of this checkpoint writes, is missing" in complaint(capsys, *resume(box, *WHOLE))


def test_a_complete_run_is_that_of_its_inputs(box, whole_run, capsys):
    shutil.copytree(whole_run, ".", dirs_exist_ok=True)
    Path("edited.pdb").write_text("REMARK mine\n" + Path(box).read_text())
    before = contents(Path())
    for command in (resume("edited.pdb", *WHOLE), ["run", "edited.pdb", "--restart", "a.chk"]):
        message = complaint(capsys, *command)
        assert "edited.pdb is not the file that the run of a.chk read" in message
    assert "none.pdb: No such file or directory" in complaint(capsys, *resume("none.pdb", *WHOLE))
    # The numbers are the same, wherever the file is.
    shutil.copyfile(box, "copy.pdb")
    run(*resume("copy.pdb", *WHOLE))
    Path("copy.pdb").unlink()
    assert contents(Path()) == before


@pytest.mark.parametrize(
    "kept",
    representatives([20, 0, 1, None], 20),
)
def test_what_a_run_left_before_its_first_checkpoint_is_replaced(box, capsys, kept):
    """Of a log the heading and one row, of a trajectory the header, of a tensor's table the heading; or less."""
    tensors = ["--pressure-tensor", "p.csv"]
    run(*resume(box, "--steps", "1", *tensors))
    Path("a.chk").unlink()
    for path in Path().iterdir():
        path.write_bytes(path.read_bytes()[:kept])
    # Step 1 is before the first frame, row and tensor.
    run(*resume(box, "--steps", "2", *tensors))
    assert checkpoints.read_checkpoint(Path("a.chk"))[1].step == 2


@pytest.mark.parametrize("victim", ["a.dcd", "a.csv"])
def test_files_without_their_checkpoint_are_refused(box, whole_run, capsys, victim):
    shutil.copy(whole_run / victim, ".")
    before = contents(Path())
    message = complaint(capsys, *resume(box, *WHOLE))
    assert f"{victim} exists, but its checkpoint a.chk does not: give another name, or replace the file with" in message
    assert contents(Path()) == before
    run(*resume(box, *WHOLE, "--overwrite"))
    assert files(".") == files(whole_run)


def test_a_table_of_the_user_is_refused(box, capsys):
    for text in ("", "Step,"):
        Path("a.csv").write_text(text)
        run(*resume(box, "--steps", "1"))
        Path("a.chk").unlink()
    for text in ("mine\n", "Step,Time (ps),\n" + 300 * "0,1\n", "Stop\n"):
        Path("a.csv").write_text(text)
        assert "a.csv exists, but its checkpoint" in complaint(capsys, *resume(box, "--steps", "1"))
        assert Path("a.csv").read_text() == text
    Path("a.csv").unlink()
    Path("a.dcd").write_text("mine\n")
    assert "a.dcd exists, but its checkpoint" in complaint(capsys, *resume(box, "--steps", "1"))
    assert Path("a.dcd").read_text() == "mine\n"


def test_options_must_be_those_of_the_run(box, whole_run, capsys):
    shutil.copytree(whole_run, ".", dirs_exist_ok=True)
    before = contents(Path())
    assert "--seed 2 differs from 1 in a.chk" in complaint(capsys, *resume(box, *WHOLE, "--seed", "2"))
    assert "is at step 50 (0.2 ps), and the run ends at step 25" in complaint(capsys, *resume(box, *PART))
    both = complaint(capsys, *resume(box, *WHOLE, "--restart", "a.chk"), code=2)
    assert "--resume finds the checkpoint beside --out: leave --restart out" in both
    assert contents(Path()) == before


def test_a_run_that_starts_from_another_continues_by_itself(box, whole_run):
    """The checkpoint of --start is needed for the beginning alone."""
    shutil.copy(whole_run / "a.chk", "first.chk")
    line = resume(box, "--start", "first.chk", "--ensemble", "nvt", out="b.dcd")
    place = line.index("--equilibrate")
    del line[place : place + 2]
    run(*line, *PART)
    Path("first.chk").unlink()
    run(*line, *WHOLE)
    assert frames(Path("b.dcd"), box).n_frames == 10


def test_two_commands_on_one_run(box, capsys, monkeypatch):
    """The second is refused before it looks for the checkpoint, which the first may be about to write."""
    with FileLocks() as locks:
        locks.hold([Path("a.chk")])
        before = contents(Path())
        assert "a.chk is being written by" in complaint(capsys, *resume(box, *WHOLE))
        assert contents(Path()) == before


def test_coordinates_are_needed(capsys):
    complaint(capsys, "run", "--resume", "--out", "a.dcd", code=main.MISUSED)
