"""Settings in TOML files: `--config` and `--save-config` make the same run, and errors are reported in one line."""

import json
from pathlib import Path

import pytest

from openmm_sier.cli.config import joined, read_config
from openmm_sier.cli.files import checkpoints
from openmm_sier.cli.settings import NOTED
from tests.support.commands import complaint, contents, run

PLATFORM = ["--platform", "Reference", "--tolerance", "1e-3", "--equilibrate", "0.006"]


def noted(checkpoint):
    return checkpoints.read_notes(Path(checkpoint)).plan


@pytest.mark.parametrize(
    "options",
    [
        ["--steps", "2"],
        ["--ensemble", "npt", "--pressure", "-500", "--time", "0.008", "--edges", "0.9", "0.95", "1.0"],
        ["--ensemble", "hmc", "--steps-per-trial", "3", "--steps", "2", "--hydrogen-mass", "4", "--no-minimize"],
        ["--steps", "2", "--pressure-tensor", "p.csv", "--constraints", "none", "--unwrapped"],
    ],
    ids=["nve", "npt", "hmc", "more"],
)
def test_saved_settings_make_the_same_run(box, options):
    """All that a checkpoint holds, and the same bytes."""
    if "--edges" in options:
        lines = [line for line in box.read_text().splitlines(keepends=True) if not line.startswith("CRYST1")]
        box = Path("boxless.pdb")
        box.write_text("".join(lines))
    run("run", box, *PLATFORM, *options, "--out", "a.dcd", "--save-config", "a.toml")
    before, log = noted("a.chk"), Path("a.csv").read_bytes()
    run("run", "--config", "a.toml", "--overwrite")
    assert noted("a.chk") == before
    assert Path("a.csv").read_bytes() == log


def test_options_of_the_command_line_take_the_place_of_those_of_the_file(box):
    Path("run.toml").write_text(f"box = {json.dumps(str(box))}\nsteps = 5\nhydrogen-mass = 4\nseed = 2\ndt = 2\n")
    run("run", "--config", "run.toml", *PLATFORM, "--seed", "3", "--time", "0.004", "--out", "a.dcd")
    plan = noted("a.chk")
    assert (plan["seed"], plan["dt"], plan["hydrogen_mass"], plan["steps"]) == (3, 2, 4, 2)


def test_a_restart_saves_the_settings_of_its_run(box):
    run("run", box, *PLATFORM, "--steps", "1", "--seed", "4", "--out", "a.dcd")
    run("run", box, "--restart", "a.chk", "--steps", "2", "--save-config", "a.toml")
    settings = read_config(Path("a.toml"))
    assert (settings["seed"], settings["steps"], "restart" in settings) == (4, 2, False)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("dt = 0.006", "run.toml: dt: expected a number from 0.05 to 1000 fs, got 0.006 fs. It is in fs, not in ps"),
        ('dt = "4"', "run.toml: dt: expected a number from 0.05 to 1000 fs, got '4'"),
        ("dt = true", "run.toml: dt: expected a number from 0.05 to 1000 fs, got True"),
        ("dt = nan", "run.toml: dt: expected a number from 0.05 to 1000 fs, got nan"),
        ("dt = 2026-11-26", "run.toml: dt: expected a number from 0.05 to 1000 fs, got '2026-11-26'"),
        ("dtt = 4", "run.toml: dtt: there is no such option"),
        ("steps = 2.5", "run.toml: steps: expected a whole number from 1 to 1000000000000000, got 2.5"),
        ('rigid = "HOH"', "run.toml: rigid: expected a list with at least one value, got 'HOH'"),
        ("edges = [1, 2]", "run.toml: edges: expected a list of 3 values, got [1, 2]"),
        ("edges = [1, 2, 0]", "run.toml: edges: expected a number from 0.1 to 10000 nm, got 0"),
        ('scheme = "sier3"', "run.toml: scheme: expected one of sier2, sier2v2"),
        ('out = "."', "run.toml: out: expected the name of a file, got '.'"),
        ("[run]\ndt = 4", "run.toml: run: there is no such option"),
        ("minimize = 1", "run.toml: minimize: expected true or false, got 1"),
        ("dt = ", "run.toml is not a TOML file: "),
        ("steps = 5\ntime = 1", "--steps and --time both say how long the run is"),
        ("friction = 1", "--friction needs --ensemble nvt, npt or hmc"),
    ],
)
def test_files_that_are_refused(box, capsys, text, message):
    Path("run.toml").write_text(text)
    before = contents(Path())
    code = 1 if "not a TOML file" in message else 2
    assert message in complaint(capsys, "run", box, "--config", "run.toml", code=code)
    assert contents(Path()) == before


def test_files_of_settings_destroy_nothing(box, capsys):
    assert "none.toml: No such file" in complaint(capsys, "run", box, "--config", "none.toml")
    short = ["run", box, *PLATFORM, "--steps", "1"]
    Path("mine.toml").write_text("mine")
    for name, message in (
        ("mine.toml", "mine.toml exists: give another name with --save-config, or replace it with --overwrite"),
        (box, f"{box} would overwrite the input {box}"),
        ("box.csv", "box.csv and box.csv are the same"),
        ("none/a.toml", "there is no directory none for a.toml"),
    ):
        before = contents(Path())
        assert message in complaint(capsys, *short, "--save-config", name)
        assert contents(Path()) == before


def test_a_length_of_the_command_line_takes_the_place_of_both():
    assert joined({"steps": 5, "dt": 2.0}, {"time": 1.0}) == {"dt": 2.0, "time": 1.0}
    assert set(joined({"steps": 5}, {"seed": 1})) == {"steps", "seed"} <= set(NOTED)
