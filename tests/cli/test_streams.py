"""Texts that the command shows."""

from pathlib import Path

import openmm_sier
from openmm_sier.cli.console import note, table
from openmm_sier.cli.main import MISUSED
from openmm_sier.cli.streams import note_warning
from tests.support.commands import complaint


def test_a_box_that_names_no_force_field(tmp_path, capsys):
    path = tmp_path / "box.pdb"
    inputs = (Path(openmm_sier.__file__).parents[1] / "systems/tip3p-512.pdb").read_text()
    path.write_text("".join(line for line in inputs.splitlines(keepends=True) if "FORCEFIELD" not in line))
    message = complaint(capsys, "info", path)
    assert "box.pdb: no force field is named: give its `files` (--forcefield), such as tip3p.xml for water" in message


#: Renames a terminal, and moves its cursor.
ESCAPES, ESCAPED = "a\x1b]0;b\x07\x9b1A\u202ec", r"a\x1b]0;b\x07\x9b1A\u202ec"


def test_texts_of_files_control_no_terminal(capsys):
    note(ESCAPES)
    note_warning(ESCAPES)
    table(ESCAPES, ("", ""), [("cell", ESCAPES)])
    output = capsys.readouterr().out
    assert output.count(ESCAPED) == 4
    assert all(letter.isprintable() for line in output.splitlines() for letter in line)
    assert ESCAPED in complaint(capsys, "run", f"{ESCAPES}.pdb")
    assert ESCAPED in complaint(capsys, "run", "box.pdb", f"--{ESCAPES}", code=MISUSED)
