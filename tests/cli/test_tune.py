"""`tune`: its output is the command line of a valid run."""

import re
import shlex
from pathlib import Path

import pytest

from openmm_sier.cli import tune as command
from openmm_sier.cli.command_line import parse
from openmm_sier.cli.files import checkpoints
from openmm_sier.cli.tune import run_line
from openmm_sier.dynamics.schemes import SIER2P3
from openmm_sier.integrators import tuning, tuning_measurements
from openmm_sier.integrators.tuning_results import Tuning
from tests.support.commands import log, run

FOUND = Tuning(SIER2P3, 0.0080234, 4, (), ())


@pytest.mark.thorough
def test_line_that_it_prints_is_a_run_with_what_it_found(capsys, box, monkeypatch):
    """Times are numbers of forces. Which step and length win is a matter of chance; they are those of the run."""
    monkeypatch.setattr(
        tuning_measurements, "_seconds", lambda context: float(context.getIntegrator().forceEvaluations)
    )
    made = []

    def remembered(*arguments, **options):
        made.append(tuning.tune(*arguments, **options))
        return made[-1]

    monkeypatch.setattr(command, "tune", remembered)
    options = ["--platform", "Reference", "--equilibrate", "0.05", "--seed", "3", "--pressure", "1"]
    options += ["--steps-per-trial", "3"]
    run("tune", box, *options, "--trials", "10", "--samples", "10", "--acceptance", "0.8")
    assert not list(Path().iterdir())
    output = capsys.readouterr().out
    scheme, step, trial = re.search(r"^(\S+), steps of (.*) fs, (.*) in a trial$", output, re.MULTILINE).groups()
    (result,) = made
    assert (scheme, step, int(trial)) == (
        result.scheme.name,
        f"{1000 * result.schemeStepSize:.4g}",
        result.stepsPerTrial,
    )
    chosen = next(each for each in result.lengths if each.steps == result.stepsPerTrial)
    assert str(chosen) in output
    # A trial has one force more at its start, and one or two for the move of the volume; it goes on twice at most.
    in_steps = result.scheme.force_evaluations * chosen.steps
    assert in_steps <= chosen.forces <= 3 * in_steps + 3
    program, *arguments = shlex.split(output.splitlines()[-1])
    assert program == "openmm-sier"
    run(*arguments, "--steps", "3", "--report-every", "0.001")
    plan = checkpoints.read_checkpoint(Path("box.chk"))[1].plan
    assert plan["ensemble"] == "hmc"
    assert plan["scheme"] == scheme.lower()
    assert plan["pressure"] == 1
    assert plan["seed"] == 3
    assert f"{plan['dt']:.4g}" == step
    assert str(plan["steps_per_trial"]) == trial
    assert log("box.csv")["Acceptance"][-1] in (0, pytest.approx(1 / 3), pytest.approx(2 / 3), 1)


def test_line_keeps_what_was_given():
    words = "tune a/b.crd --topology c.psf --forcefield x.prm --edges 1 1 2 --dt 6 --no-minimize --start s.chk"
    options = parse(words.split()).carry_out.args[0].chosen()
    assert run_line(options, FOUND) == (
        "openmm-sier run a/b.crd --ensemble hmc --topology c.psf --forcefield x.prm --edges 1.0 1.0 2.0 "
        "--dt 8.023 --no-minimize --start s.chk --scheme sier2p3 --steps-per-trial 4"
    )
