"""The declaration of options: `--help`, and checks of files before anything is written."""

import json
import math
import shutil
import zipfile
from pathlib import Path
from typing import get_args

import pytest

from openmm_sier.cli.files.checkpoints import Notes
from openmm_sier.cli.main import MISUSED, main
from openmm_sier.cli.methods import ENSEMBLES, METHODS
from openmm_sier.cli.planning import new_settings
from openmm_sier.cli.settings import FILES, NOTED, RECOMMENDED, RunSettings
from openmm_sier.dynamics.schemes import CATALOGUE
from openmm_sier.inputs import forcefields
from tests.support.commands import complaint, contents, rewrite_notes, write_lattice
from tests.support.matrices import representatives

SHORT = ["--platform", "Reference", "--equilibrate", "0.006", "--every", "0.006", "--pressure-tensor", "tensor.csv"]


@pytest.fixture(scope="module")
def short_run(tmp_path_factory):
    """Directory of a run of two steps."""
    place = tmp_path_factory.mktemp("short")
    box = write_lattice(place / "box.pdb", 8)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        assert main(["run", str(box), *SHORT, "--steps", "2"]) == 0
    return place


@pytest.fixture
def copied(short_run, tmp_path):
    """The current directory, with the files of that run."""
    shutil.copytree(short_run, tmp_path, dirs_exist_ok=True)
    return tmp_path


# --- the declaration ---


def test_the_declaration_agrees_with_what_it_is_about():
    assert set(METHODS) == {*CATALOGUE, "verlet", "langevinmiddle"}
    assert set(RECOMMENDED) == set(ENSEMBLES)
    assert set(RECOMMENDED.values()) <= set(CATALOGUE)
    # Every scheme that users can name has its usual steps.
    assert all(scheme.constant_energy_step and scheme.bath_step for scheme in CATALOGUE.values())
    assert pytest.approx(5 / 6) == forcefields.SWITCH / forcefields.CUTOFF
    assert set(FILES) == {"box", "topology", "out", "report", "pressure_tensor"}


@pytest.mark.parametrize(
    ("option", "value", "expected"),
    [
        ("--pressure", "101325", "from -5000 to 50000 bar (1 bar is 100000 Pa), got '101325'"),
        ("--seed", "99999999999", "from 1 to 2147483647, got '99999999999'"),
        ("--time", "1e300", "above 0 and up to 1e+09 ps, got '1e300'"),
        ("--dt", "nan", "from 0.05 to 1000 fs, got 'nan' (see"),
        ("--dt", "0.006", "from 0.05 to 1000 fs, got '0.006'"),
        ("--hydrogen-mass", "12", "from 1 to 4.5 dalton, got '12'"),
        ("--steps", "1e3", "from 1 to 1000000000000000, got '1e3'"),
        ("--out", "/", "the name of a file, got '/'"),
        ("--restart", ".", "the name of a file, got '.'"),
        ("--forcefield", "..", "the name of a file, got '..'"),
    ],
)
def test_values_out_of_range(capsys, option, value, expected):
    message = complaint(capsys, "run", "box.pdb", option, value, code=MISUSED)
    assert f"argument {option}: expected " in message
    assert expected in message


def test_this_directory_is_no_file_of_coordinates(capsys):
    """Outputs are named after it."""
    message = complaint(capsys, "run", ".", code=MISUSED)
    assert "argument BOX: expected the name of a file, got '.'" in message


def test_the_help_has_the_usual_steps():
    light = {name: METHODS[scheme].usual_step(name) for name, scheme in RECOMMENDED.items()}
    heavy = {name: METHODS[scheme].usual_step(name, 4) for name, scheme in RECOMMENDED.items()}
    assert light == {"nve": 4, "nvt": 4, "npt": 4, "hmc": 6}
    assert heavy == {"nve": 4, "nvt": 9, "npt": 9, "hmc": 9}
    described = "4 for the default ones, 6 with hmc, 9 with heavy hydrogens by langevin or hmc"
    assert described in RunSettings.model_fields["dt"].description


def test_bonds_to_hydrogen_are_constrained_unless_a_run_says_otherwise():
    box = Path("box.pdb")
    assert new_settings(RunSettings(box=box)).constraints == "hbonds"
    unconstrained = new_settings(RunSettings(box=box, constraints="none"))
    assert unconstrained.constraints == "none"
    assert new_settings(RunSettings(box=box, start=Path("a.chk")), unconstrained).constraints == "none"


@pytest.mark.parametrize(
    ("given", "scheme", "dt", "steps"),
    [
        ({}, "sier2v2", 6, 12),
        ({"hydrogen_mass": 4.0}, "sier2v2", 9, 8),
        ({"scheme": "sier4g", "hydrogen_mass": 4.0}, "sier4g", 9, 8),
        ({"hydrogen_mass": 4.0, "dt": 10.0}, "sier2v2", 10, 7),
    ],
)
def test_trials_have_steps_and_a_length_of_their_own(given, scheme, dt, steps):
    """Trials of 72 fs, in steps that are not those of a bath."""
    result = new_settings(RunSettings(box=Path("box.pdb"), ensemble="hmc", **given))
    assert (result.scheme, result.steps_per_trial, result.friction) == (scheme, steps, 1)
    assert result.dt == pytest.approx(dt)


# --- wrong values in files ---

#: What no option takes; JSON as Python writes it knows NaN.
WRONG = [{}, [None], math.nan, -1e300, "", "\0"]


def refuse(capsys, place, file, field, *command):
    """A command must fail in one line that names file and field, and leave all files as they are."""
    before = contents(place)
    message = complaint(capsys, *command)
    assert file in message
    assert field in message
    assert contents(place) == before


@pytest.mark.parametrize("name", representatives(NOTED, "dt", "ensemble"))
def test_wrong_options_in_a_checkpoint(copied, capsys, name):
    original = (copied / "box.chk").read_bytes()
    may_lack = type(None) in get_args(RunSettings.model_fields[name].annotation)
    values = WRONG if may_lack else [*WRONG, None]
    restart, start = ["--restart", "box.chk", "--steps", "4"], ["--start", "box.chk", "--out", "new.dcd"]
    for command, value in [(start, math.nan), *((restart, value) for value in values)]:
        (copied / "box.chk").write_bytes(original)
        rewrite_notes("box.chk", lambda notes, value=value: notes["plan"].update({name: value}))
        refuse(capsys, copied, "box.chk", name, "run", "box.pdb", "--platform", "Reference", *command)


def test_unknown_and_missing_options_in_a_checkpoint(copied, capsys):
    original = (copied / "box.chk").read_bytes()
    for name, change in (("bodies", lambda plan: plan.update(bodies="b.h5")), ("dt", lambda plan: plan.pop("dt"))):
        (copied / "box.chk").write_bytes(original)
        rewrite_notes("box.chk", lambda notes, change=change: change(notes["plan"]))
        refuse(capsys, copied, "box.chk ", f"setting {name}", "run", "box.pdb", "--restart", "box.chk", "--steps", "4")


@pytest.mark.parametrize(
    ("plan", "reason"),
    [
        ({"scheme": "langevinmiddle"}, "supports the ensembles"),
        ({"scheme": "verlet", "ensemble": "hmc"}, "supports the ensembles"),
        ({"out": "box.csv"}, "the name of a trajectory must end in .dcd, got box.csv"),
        ({"report": "log.dcd"}, "log.dcd will be a table"),
    ],
)
def test_options_in_a_checkpoint_that_no_run_has(copied, capsys, plan, reason):
    rewrite_notes("box.chk", lambda notes: notes["plan"].update({"ensemble": "nve", **plan}))
    before = contents(copied)
    assert reason in complaint(capsys, "run", "box.pdb", "--restart", "box.chk", "--steps", "4", code=MISUSED)
    assert contents(copied) == before


ESCAPE = "\x1b]0;owned\x07"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("step", value) for value in (-1, 0, 1.5, True, "2", 10**16, None)),
        *(("potential_energy", value) for value in (math.nan, math.inf, "0", None)),
        *(("unsettled", value) for value in (ESCAPE, "", 1)),
        *(("platform", value) for value in ({}, {"Platform": ESCAPE}, {"Platform": 1}, "Reference")),
        *(("inputs", value) for value in ({"box": "0"}, [], None)),
        *(("log", value) for value in ({}, None, {"size": -1, "count": 0, "fingerprint": 32 * "0"})),
        ("trajectory", {"size": 300, "count": True, "fingerprint": 32 * "0"}),
        ("tensors", None),
        ("plan", []),
        ("bodies", 1),
    ],
)
def test_wrong_notes_in_a_checkpoint(copied, capsys, name, value):
    rewrite_notes("box.chk", lambda notes: notes.update({name: value}))
    refuse(capsys, copied, "box.chk is damaged, or is not a checkpoint", name, "run", "--restart", "box.chk")


@pytest.mark.parametrize("name", [*Notes.model_fields])
def test_missing_notes_in_a_checkpoint(copied, capsys, name):
    rewrite_notes("box.chk", lambda notes: notes.pop(name))
    refuse(capsys, copied, "box.chk is damaged, or is not a checkpoint", name, "run", "--restart", "box.chk")
    refuse(capsys, copied, "box.chk is damaged", name, "run", "box.pdb", "--start", "box.chk", "--out", "new.dcd")


@pytest.mark.parametrize("notes", [[], None, 1, "\ud800", {"format": [ESCAPE]}])
def test_notes_that_are_none(copied, capsys, notes):
    with zipfile.ZipFile("box.chk") as archive:
        state = archive.read("state.xml")
    with zipfile.ZipFile("box.chk", "w") as archive:
        archive.writestr("state.xml", state)
        archive.writestr("notes.json", json.dumps(notes))
    refuse(capsys, copied, "box.chk is damaged", "note", "run", "--restart", "box.chk")
