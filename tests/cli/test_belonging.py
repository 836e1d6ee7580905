"""Restarts continue only files that their checkpoint belongs to, and nothing is changed where one does not."""

import shutil
from pathlib import Path

import pytest

from openmm_sier.cli.files.records import _fingerprint
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


#: By the notes of a checkpoint, the option that names the file, and files that are not of that kind.
VICTIMS = [
    ("trajectory", "out", "photo.dcd"),
    ("log", "report", "thesis.tex"),
    ("tensors", "pressure_tensor", "thesis.tex"),
]


@pytest.mark.parametrize(("name", "option", "victim"), VICTIMS)
@pytest.mark.parametrize("size", [0, 10, 60, 2**24])
def test_a_checkpoint_cuts_no_file_of_another_kind(one, capsys, name, option, victim, size):
    """Not even one that fits the content of a file."""
    path = Path(victim)
    if not path.exists():
        path.write_bytes(b"mine, not that of a run\n" * 1000)

    def change(notes):
        notes["plan"][option] = victim
        notes[name] = {"size": size, "count": 0, "fingerprint": _fingerprint(path, size)}

    rewrite_notes("box.chk", change)
    before = contents(Path())
    assert f"{victim} was edited or replaced" in complaint(capsys, *AGAIN, "--steps", "20", "--overwrite")
    assert contents(Path()) == before


@pytest.mark.parametrize(("name", "victim"), [("trajectory", "box.dcd"), ("log", "box.csv")])
@pytest.mark.parametrize("size", [0, 40])
def test_a_file_of_a_run_is_not_emptied(one, capsys, name, victim, size):
    """The first bytes of all logs and trajectories are alike."""
    noted = {"size": size, "count": 0, "fingerprint": _fingerprint(Path(victim), size)}
    rewrite_notes("box.chk", lambda notes: notes.update({name: noted}))
    before = contents(Path())
    assert f"{victim} was edited or replaced" in complaint(capsys, *AGAIN, "--steps", "20", "--overwrite")
    assert contents(Path()) == before
