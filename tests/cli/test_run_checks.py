"""Runs whose energy or temperature runs away end with a code of their own and keep the last good checkpoint."""

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import openmm
import pytest

from openmm_sier.cli import results, run_checks
from openmm_sier.cli.files import checkpoints
from openmm_sier.cli.planning import new_settings
from openmm_sier.cli.settings import RunSettings
from openmm_sier.inputs import equilibration
from openmm_sier.observe import conservation
from openmm_sier.stability.runaway import HOTTEST, RunawayError
from openmm_sier.system.temperature import DegreesOfFreedom, Temperatures
from tests.support.commands import SMALL, complaint, frames, log, run


def plan(ensemble="nve", **options):
    return new_settings(RunSettings(box=Path("box.pdb"), ensemble=ensemble, **options))


def looked_at(dof, *temperatures):
    """Hold temperatures of translation, rotation and flexible molecules against the bounds of a run at 297 K."""
    integrator = SimpleNamespace(computeTemperatures=Temperatures(math.nan, *temperatures).as_quantities)
    run_checks.check(SimpleNamespace(getIntegrator=lambda: integrator), run_checks.bounds(plan(), dof))


# --- the bounds ---


def test_temperatures_that_stop():
    looked_at(DegreesOfFreedom(1500, 1500), 2900, 2900, math.nan)
    # Points do not rotate.
    looked_at(DegreesOfFreedom(1500, 0), 297, math.nan, math.nan)
    for T in (3100, math.inf, math.nan):
        with pytest.raises(RunawayError, match=r"translation .*above 3000 K"):
            looked_at(DegreesOfFreedom(1500, 1500), T, 297, math.nan)


def test_few_degrees_of_freedom_may_be_hot_by_chance():
    """Of 3 degrees of freedom at 297 K, 10^7 samples; the bound's own claim is a chance of e^-50."""
    hottest = 297 * np.random.default_rng(2).chisquare(3, 10**7).max() / 3
    assert hottest > 3000
    looked_at(DegreesOfFreedom(3, 0), hottest, math.nan, math.nan)
    with pytest.raises(RunawayError):
        looked_at(DegreesOfFreedom(3, 0), 13_000, math.nan, math.nan)


# --- runs ---


def test_long_step_ends_with_its_code_and_a_good_checkpoint(box, capsys):
    long = ["run", box, *SMALL, "--scheme", "sier2", "--dt", "20", "--time", "20", "--checkpoint-every", "0.02"]
    message = complaint(capsys, *long, code=run_checks.EXIT_CODE)
    assert "became unstable at step" in message
    assert "the step of 20 fs is too long for SIER2, for which 2 fs is usual: --dt 2." in message
    rows, (_, notes) = log("box.csv"), checkpoints.read_checkpoint(Path("box.chk"))
    assert f"The last checkpoint is box.chk, of step {notes.step}; --start begins a new run" in message
    # Nothing that is out of bounds has got to a file.
    assert rows["Temperature (K)"].max() < HOTTEST
    assert notes.step in (rows["Step"][-1], rows["Step"][-1] + 1)


@pytest.mark.thorough
def test_bounds_are_looked_at_before_anything_is_written(box, capsys, monkeypatch):
    """Frames at every 5th step, rows at every 10th and checkpoints at every 25th; 50 is a step for all of them."""

    def run_away(context, bounds):
        if context.getStepCount() >= 50:
            raise RunawayError("too hot")

    command = ["run", box, *SMALL, "--scheme", "sier4g", "--time", "0.4"]
    with monkeypatch.context() as patch:
        patch.setattr(run_checks, "check", run_away)
        message = complaint(capsys, *command, code=run_checks.EXIT_CODE)
    assert "The last checkpoint is box.chk, of step 25; --start begins a new run" in message
    assert "the step of 4 fs should be short enough for SIER4G" in message
    _, notes = checkpoints.read_checkpoint(Path("box.chk"))
    assert notes.step == 25
    assert log("box.csv")["Step"][-1] == 40
    assert frames(Path("box.dcd"), box).n_frames == 9
    # The way on that the message names.
    run("run", box, "--start", "box.chk", "--out", "again.dcd", "--steps", "2", "--platform", "Reference")


def test_equilibration_that_breaks_down(box, capsys, monkeypatch):
    monkeypatch.setattr(equilibration, "STEP", 0.034)
    monkeypatch.setattr(equilibration, "SHARE_OF_LONGEST", 10.0)
    message = complaint(capsys, "run", box, *SMALL, "--equilibrate", "200", code=run_checks.EXIT_CODE)
    assert "the equilibration failed" in message
    assert not list(Path().iterdir())


def test_other_errors_of_openmm_are_no_runaway(box, capsys, monkeypatch):
    def fails(*_):
        raise openmm.OpenMMException("the device was lost")

    monkeypatch.setattr("openmm_sier.integrators.integrator.SIERIntegrator.step", fails)
    assert complaint(capsys, "run", box, *SMALL, "--equilibrate", "0") == "openmm-sier: the device was lost\n"


# --- the table ---


def test_table_of_a_bath():
    """The mean of V, and the drift of H as heat; with OpenMM's baths H is not known, and trials have errors instead."""
    time = 0.04 * np.arange(251)
    log = {
        "Time (ps)": time,
        "Conserved Energy (kJ/mole)": 2.0 * time,
        "Potential Energy (kJ/mole)": np.random.default_rng(3).normal(-20000, 60, 251),
        **{name: np.full(251, 297.0) for name in conservation.TEMPERATURES},
    }

    def table(log, ensemble):
        return {quantity.name: str(quantity) for quantity in results.quantities(log, ensemble, moves_volume=False)}

    rows = table(log, "nvt")
    # V has an rms of 60 kJ/mol, and 251 samples.
    assert float(rows["potential energy V"].split()[0]) == pytest.approx(-20000, abs=5 * 60 / np.sqrt(251))
    assert float(rows["heat of the steps, which the bath takes up"].split()[0]) == pytest.approx(2)
    assert "rms(H)/rms(V)" not in rows
    unknown = log | {"Conserved Energy (kJ/mole)": np.full(251, np.nan)}
    for rows in (table(unknown, "nvt"), table(log, "hmc")):
        assert not any(name.startswith("heat") for name in rows)
