"""`tune`: its output is the command line of a valid run."""

import re
import shlex
from pathlib import Path

import pytest

from openmm_sier.cli.command_line import parse
from openmm_sier.cli.files import checkpoints
from openmm_sier.cli.tune import run_line
from openmm_sier.integrators.tuning import Tuning
from tests.support.commands import log, run

FOUND = Tuning(0.0080234, 4, 0.8, ())


@pytest.mark.thorough
def test_line_that_it_prints_is_a_run_with_the_step_that_it_found(capsys, box):
    """Which step is found is a matter of chance; it is that of the run."""
    options = ["--platform", "Reference", "--equilibrate", "0.05", "--seed", "3", "--pressure", "1"]
    options += ["--steps-per-trial", "3"]
    run("tune", box, *options, "--trials", "10", "--acceptance", "0.8")
    assert not list(Path().iterdir())
    output = capsys.readouterr().out
    step, trial = re.search(r"^Steps of (.*) fs, (.*) in a trial:$", output, re.MULTILINE).groups()
    program, *arguments = shlex.split(output.splitlines()[-1])
    assert program == "openmm-sier"
    run(*arguments, "--steps", "3", "--report-every", "0.001")
    plan = checkpoints.read_checkpoint(Path("box.chk"))[1].plan
    assert plan["ensemble"] == "hmc"
    assert plan["scheme"] == "sier2v2"
    assert plan["pressure"] == 1
    assert plan["seed"] == 3
    assert f"{plan['dt']:.4g}" == step
    assert str(plan["steps_per_trial"]) == trial
    assert log("box.csv")["Acceptance"][-1] in (0, pytest.approx(1 / 3), pytest.approx(2 / 3), 1)


def test_line_keeps_what_was_given():
    words = "tune a/b.crd --topology c.psf --forcefield x.prm --edges 1 1 2 --dt 6 --no-minimize --start s.chk"
    options = parse(words.split()).carry_out.args[0].chosen
    assert run_line(options, FOUND) == (
        "openmm-sier run a/b.crd --ensemble hmc --topology c.psf --forcefield x.prm --edges 1.0 1.0 2.0 "
        "--dt 8.023 --no-minimize --start s.chk --steps-per-trial 4"
    )
