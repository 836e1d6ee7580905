"""Settings in TOML files: `--config` makes the same run as options, and errors are reported in one line."""

import json
from pathlib import Path

import pytest

from openmm_sier.cli.config import joined
from openmm_sier.cli.files import checkpoints
from openmm_sier.cli.settings import RunSettings
from tests.support.commands import complaint, contents, run

PLATFORM = ["--platform", "Reference", "--tolerance", "1e-3", "--equilibrate", "0.006"]


def noted(checkpoint):
    return checkpoints.read_notes(Path(checkpoint)).plan


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (
            ["--ensemble", "npt", "--pressure", "-500", "--time", "0.008", "--edges", "0.9", "0.95", "1.0"],
            'ensemble = "npt"\npressure = -500\ntime = 0.008\nedges = [0.9, 0.95, 1]',
        ),
        (
            ["--steps", "2", "--pressure-tensor", "p.csv", "--unwrapped", "--no-minimize"],
            'steps = 2\npressure_tensor = "p.csv"\nunwrapped = true\nminimize = false\noverwrite = true',
        ),
    ],
    ids=["npt", "more"],
)
def test_settings_of_a_file_make_the_same_run(box, options, text):
    """All that a checkpoint holds, and the same bytes."""
    lines = [line for line in box.read_text().splitlines(keepends=True) if not line.startswith("CRYST1")]
    Path("box.pdb").write_text("".join(lines) if "--edges" in options else box.read_text())
    run("run", "box.pdb", *PLATFORM, *options)
    before, log = noted("box.chk"), Path("box.csv").read_bytes()
    Path("a.toml").write_text(f'box = "box.pdb"\n{text}\n')
    run("run", "--config", "a.toml", *PLATFORM, "--overwrite")
    assert noted("box.chk") == before
    assert Path("box.csv").read_bytes() == log


def test_options_of_the_command_line_take_the_place_of_those_of_the_file(box, capsys):
    Path("run.toml").write_text(f"box = {json.dumps(str(box))}\nsteps = 5\nhydrogen-mass = 4\nseed = 2\ndt = 2\n")
    run("run", "--config", "run.toml", *PLATFORM, "--seed", "3", "--time", "0.004", "--out", "a.dcd")
    plan = noted("a.chk")
    assert (plan["seed"], plan["dt"], plan["hydrogen_mass"], plan["steps"]) == (3, 2, 4, 2)
    assert "hydrogens of 4 dalton at constant energy: do not, motion is slower" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("dt = 0.006", "run.toml: dt: expected a number from 0.05 to 1000 fs, got 0.006"),
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


def test_a_file_that_is_missing(box, capsys):
    assert "none.toml: No such file" in complaint(capsys, "run", box, "--config", "none.toml")


def test_a_length_of_the_command_line_takes_the_place_of_both():
    assert joined(RunSettings(steps=5, dt=2.0), RunSettings(time=1.0)).chosen == {"dt": 2.0, "time": 1.0}
    assert joined(RunSettings(steps=5), RunSettings(seed=1)).chosen == {"steps": 5, "seed": 1}
