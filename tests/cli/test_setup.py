"""`setup`: from a structure to a file that `run` reads."""

from pathlib import Path

import pytest

from tests.support.commands import complaint, contents, run
from tests.support.incomplete_structures import write_incomplete

pytest.importorskip("pdbfixer")


@pytest.fixture
def structure():
    return write_incomplete(Path("1VII.pdb"))


def test_what_is_made_is_read(structure, capsys):
    run("setup", structure, "--padding", "0.5", "--salt", "0.2", "--shape", "octahedron")
    output = capsys.readouterr().out
    for change in ("residues added", "1 between", "heavy atoms added", "hydrogens added", "waters added", "octahedron"):
        assert change in output
    assert "wrote 1VII-water.pdb; continue with: openmm-sier run 1VII-water.pdb --ensemble npt" in output
    # As `run` does, it reads the force field that the file names, and makes the System.
    run("info", "1VII-water.pdb")
    output = capsys.readouterr().out
    assert "1VII-water.pdb, amber14-all.xml amber14/tip3p.xml (named in the PDB file)" in output
    assert "HOH" in output


def test_files_in_the_way(structure, capsys):
    message = "--out box.cif: expected the name of a PDB file, which ends in .pdb"
    assert message in complaint(capsys, "setup", structure, "--out", "box.cif", code=2)
    for name, text in (
        ("1VII.pdb", "1VII.pdb would overwrite the input 1VII.pdb: give another name"),
        ("none/box.pdb", "there is no directory none for box.pdb"),
    ):
        assert text in complaint(capsys, "setup", structure, "--out", name)
    Path("1VII-water.pdb").write_text("mine")
    before = contents(Path())
    assert "1VII-water.pdb exists: give another name" in complaint(capsys, "setup", structure)
    assert contents(Path()) == before


def test_a_file_that_is_no_structure(capsys):
    Path("a.pdb").write_text("nothing")
    assert "a.pdb is not a PDB file with atoms" in complaint(capsys, "setup", "a.pdb")
    assert "No such file" in complaint(capsys, "setup", "b.pdb")
