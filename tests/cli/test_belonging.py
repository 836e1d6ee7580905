"""Restarts continue only files that their checkpoint belongs to, and nothing is changed where one does not."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from openmm_sier.cli import main
from tests.support.commands import SMALL, complaint, contents, datasets, run, write_lattice

h5py = pytest.importorskip("h5py")

FILES = ["--bodies", "states.h5", "--pressure-tensor", "p.csv", "--pressure-tensor-every", "0.04"]
AGAIN = ["run", "box.pdb", "--platform", "Reference", "--restart", "box.chk"]


@pytest.fixture(scope="module")
def two_runs(tmp_path_factory):
    """A directory with two runs, `one` and `two`, that differ in their seeds alone."""
    place = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        for seed, name in enumerate(("one", "two"), 1):
            (place / name).mkdir()
            patch.chdir(place / name)
            write_lattice(Path("box.pdb"), 8)
            run("run", "box.pdb", *SMALL, *FILES, "--steps", "10", "--seed", seed)
    return place


@pytest.fixture
def one(two_runs, monkeypatch):
    """The files of the first run, in the current directory."""
    shutil.copytree(two_runs / "one", "here")
    monkeypatch.chdir("here")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["box.chk", "box.dcd", "box.csv", "states.h5", "p.csv"])
def test_file_of_another_run_is_refused(one, two_runs, capsys, name):
    """The lengths are those of this run, except that of the log."""
    shutil.copyfile(two_runs / "two" / name, name)
    before = contents(Path())
    message = complaint(capsys, *AGAIN, "--steps", "20")
    wrong = "box.dcd" if name == "box.chk" else name
    assert f"{wrong} is not the file that the checkpoint belongs to" in message or f"{wrong} has " in message
    assert contents(Path()) == before


@pytest.mark.slow
def test_finished_hdf5_file_of_an_earlier_end_is_refused(box, capsys):
    """Of the same run, whose checkpoint is further."""
    command = ["run", box, *SMALL, "--bodies", "made.h5", "--overwrite"]
    run(*command, "--steps", "10")
    shutil.copyfile("made.h5", "short.h5")
    run(*command, "--steps", "20")
    shutil.copyfile("short.h5", "made.h5")
    capsys.readouterr()
    again = ["--restart", "box.chk", "--platform", "Reference", "--steps", "40"]
    assert "made.h5 is not the file that the checkpoint belongs to" in complaint(capsys, "run", box, *again)


@pytest.mark.parametrize(("old", "new"), [(b"\n", b"\r\n"), (b"\n10,", b"\n11,")], ids=["line ends", "row"])
def test_edited_log_is_refused(one, capsys, old, new):
    Path("box.csv").write_bytes(Path("box.csv").read_bytes().replace(old, new))
    before = contents(Path())
    assert "box.csv is not the file that the checkpoint belongs to, or was edited" in complaint(
        capsys, *AGAIN, "--steps", "20"
    )
    assert contents(Path()) == before


# --- what HDF5 files are made of ---


@pytest.mark.slow
@pytest.mark.parametrize("option", ["--out", "--bodies"])
def test_kill_before_the_removal_of_the_growing_part(box, monkeypatch, option):
    """It is removed by the next restart, which finds everything else complete."""
    name = "made.h5.dcd" if option == "--out" else "made.h5.frames"
    unlink = Path.unlink
    command = ["run", box, *SMALL, option, "made.h5"]
    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", lambda path, **more: None if path.name == name else unlink(path, **more))
        run(*command, "--steps", "20")
    whole = datasets("made.h5")
    assert Path(name).exists()
    checkpoint = "made.chk" if option == "--out" else "box.chk"
    again = ["run", box, "--platform", "Reference", "--restart", checkpoint]
    run(*again)
    np.testing.assert_equal(datasets("made.h5"), whole)
    assert not Path(name).exists()
    assert main.main([str(argument) for argument in again]) == 4
