"""Restarts continue only files that their checkpoint belongs to, and nothing is changed where one does not."""

import hashlib
import os
import shutil
from pathlib import Path

import pytest

from openmm_sier.cli.files.outputs import Outputs
from tests.support.commands import SMALL, complaint, contents, rewrite_notes, run, write_lattice

FILES = ["--pressure-tensor", "p.csv", "--pressure-tensor-every", "0.04"]
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


@pytest.mark.parametrize("name", ["box.chk", "box.dcd", "box.csv", "p.csv"])
def test_file_of_another_run_is_refused(one, two_runs, capsys, name):
    """The lengths are those of this run, except that of the log."""
    shutil.copyfile(two_runs / "two" / name, name)
    before = contents(Path())
    message = complaint(capsys, *AGAIN, "--steps", "20")
    wrong = "box.dcd" if name == "box.chk" else name
    assert f"{wrong} was edited or replaced" in message or f"{wrong} has " in message
    assert contents(Path()) == before


@pytest.mark.parametrize(("old", "new"), [(b"\n", b"\r\n"), (b"\n10,", b"\n11,")], ids=["line ends", "row"])
def test_edited_log_is_refused(one, capsys, old, new):
    Path("box.csv").write_bytes(Path("box.csv").read_bytes().replace(old, new))
    before = contents(Path())
    assert "box.csv was edited or replaced" in complaint(capsys, *AGAIN, "--steps", "20")
    assert contents(Path()) == before


@pytest.mark.parametrize(("name", "victim"), [("trajectory", "box.dcd"), ("log", "box.csv"), ("tensors", "p.csv")])
def test_a_noted_size_beyond_the_file_is_refused(one, capsys, name, victim):
    """The fingerprint of nothing fits any file there, and writing would fill the gap with zeros."""
    noted = {"size": 2**40, "count": 0, "fingerprint": hashlib.blake2b(b"", digest_size=16).hexdigest()}
    rewrite_notes("box.chk", lambda notes: notes.update({name: noted}))
    before = contents(Path())
    assert f"{victim} was edited or replaced" in complaint(capsys, *AGAIN, "--steps", "20", "--overwrite")
    assert contents(Path()) == before


#: What other programs do to a file that a run writes.
CHANGES = {
    "replaced": lambda path: (Path("other").write_bytes(path.read_bytes()), os.replace("other", path)),
    "emptied": lambda path: path.write_bytes(b""),
    "removed": lambda path: path.unlink(),
    "appended to": lambda path: path.write_bytes(path.read_bytes() + b"mine"),
}


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("name", ["box.dcd", "box.csv"])
def test_a_file_that_another_program_changes_is_not_certified(one, capsys, monkeypatch, name, change):
    """The run ends at the next record or checkpoint, and the checkpoint stays that of the unchanged files."""
    write, checkpoint = Outputs.write, Path("box.chk").read_bytes()

    def disturbed(self, due, context, values):
        if context.getStepCount() == 15:
            CHANGES[change](Path(name))
        write(self, due, context, values)

    monkeypatch.setattr(Outputs, "write", disturbed)
    message = complaint(capsys, *AGAIN, "--steps", "60")
    said = "No such file" if change == "removed" else "another program has "
    assert f"{name}: {said}" in message
    assert "The last checkpoint is box.chk, of step 10" in message
    assert Path("box.chk").read_bytes() == checkpoint
