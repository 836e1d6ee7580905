"""What helps is told in a script's words by the library, and by options in the command."""

import ast
from pathlib import Path

import openmm
import pytest

import openmm_sier
from openmm_sier.cli.console import note, table
from openmm_sier.cli.main import MISUSED
from openmm_sier.cli.streams import AS_OPTIONS, described, note_warning
from openmm_sier.inputs.pdb_files import ForceFieldError
from openmm_sier.stability import advice
from openmm_sier.system.notices import Remedy
from tests.support.commands import complaint

SOURCES = Path(openmm_sier.__file__).parent

OF_THE_LIBRARY = sorted(path for path in SOURCES.rglob("*.py") if path.relative_to(SOURCES).parts[0] != "cli")


def texts(path):
    """String constants of a module, its docstrings left out."""
    tree = ast.parse(path.read_text())
    docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            yield node.value


def test_the_library_names_no_options_of_the_command():
    # Members of many runs are carried out by the command, with its options.
    others = [path for path in OF_THE_LIBRARY if path.name != "many_runs.py"]
    assert [(path.name, text) for path in others for text in texts(path) if " --" in f" {text}"] == []


def test_the_command_has_words_for_remedies_that_there_are():
    kinds = set()
    for path in OF_THE_LIBRARY:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Remedy":
                kinds.add(node.args[0].value)
    assert set(AS_OPTIONS) <= kinds
    # A Force that is softer helps in both.
    assert kinds - set(AS_OPTIONS) == {"soften", "straighten"}


def test_an_error_carries_its_parts():
    remedies = advice.up_to(0.004), advice.HEAVIER, advice.CONSTRAIN_AND_KEEP
    error = advice.StepError("A step of 9 fs is too long", *remedies, remark="More do not help")
    assert isinstance(error, openmm.OpenMMException)
    assert (error.finding, error.remedies, error.remark) == (str(error)[:26], remedies, "More do not help")
    assert str(error).startswith(
        "A step of 9 fs is too long. Take up to 4 fs, or if you need averages but no dynamics, make all hydrogens"
    )
    assert "prepare_system(" in str(error)
    assert described(error) == (
        "A step of 9 fs is too long. Take up to 4 fs (--dt), or if you need averages but no dynamics, make all "
        "hydrogens heavy with --hydrogen-mass 4, or constrain the bond with --constraints hbonds (bonds to hydrogen) "
        "or allbonds. More do not help"
    )


def test_a_box_that_names_no_force_field(tmp_path, capsys):
    path = tmp_path / "box.pdb"
    inputs = (Path(openmm_sier.__file__).parents[1] / "systems/tip3p-512.pdb").read_text()
    path.write_text("".join(line for line in inputs.splitlines(keepends=True) if "FORCEFIELD" not in line))
    said = complaint(capsys, "info", path)
    assert "box.pdb: no force field is named: give its files with --forcefield, such as tip3p.xml for water" in said


def test_words_that_are_the_same_are_said_once():
    error = advice.StepError("Too long", advice.PREPARE, advice.SHORTER_STEP)
    assert described(error) == "Too long. Take a shorter step (--dt)"


@pytest.mark.parametrize(
    ("remedy", "message"),
    [
        (None, "a.pdb is empty"),
        (Remedy("one box", "leave out `edges`"), "a.pdb is empty: leave out --edges"),
        (Remedy("none that the command knows", "look"), "a.pdb is empty: look"),
    ],
)
def test_inputs(remedy, message):
    assert described(ForceFieldError("a.pdb is empty", *filter(None, [remedy]))) == message


#: Renames a terminal, and moves its cursor.
ESCAPES, ESCAPED = "a\x1b]0;b\x07\x9b1A\u202ec", r"a\x1b]0;b\x07\x9b1A\u202ec"


def test_texts_of_files_control_no_terminal(capsys):
    note(ESCAPES)
    note_warning(ESCAPES)
    table(ESCAPES, ("", ""), [("cell", ESCAPES)])
    said = capsys.readouterr().out
    assert said.count(ESCAPED) == 4
    assert all(letter.isprintable() for line in said.splitlines() for letter in line)
    assert ESCAPED in complaint(capsys, "run", f"{ESCAPES}.pdb")
    assert ESCAPED in complaint(capsys, "run", "box.pdb", f"--{ESCAPES}", code=MISUSED)


@pytest.mark.parametrize(
    "command",
    [
        ["run", "{}.pdb"],
        ["run", "box.pdb", "--out={}.dcd"],
        ["run", "box.pdb", "--rigid", "{}"],
        ["run", "box.pdb", "--config", "{}.toml"],
        ["tune", "box.pdb", "--start", "{}.chk"],
        ["info", "{}.pdb"],
        ["setup", "a.pdb", "--out", "{}.pdb"],
        ["plot", "{}.csv"],
        ["summary", "a.csv", "--json", "{}.json"],
    ],
)
def test_names_that_are_not_utf8_are_refused_at_once(capsys, command):
    message = complaint(capsys, *(word.format("m\udcff") for word in command), code=MISUSED)
    assert r"m\xff" in message
    assert "is not UTF-8: give the file another name" in message
