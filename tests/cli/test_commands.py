"""`run` beyond constant energy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from openmm_sier import SIER4G, SIERIntegrator
from openmm_sier.cli.files import checkpoints
from openmm_sier.dynamics.schemes import CATALOGUE
from tests.support.commands import SMALL, complaint, log, run


@pytest.mark.slow
@pytest.mark.parametrize("ensemble", [["nvt"], ["npt", "--pressure", "-500"]], ids=["NVT", "NPT"])
def test_heat_bath_and_piston_are_restarted_bit_for_bit(box, ensemble):
    options = [*SMALL, "--ensemble", *ensemble, "--scheme", "sier2", "--dt", "2", "--friction", "5", "--seed", "3"]
    run("run", box, *options, "--time", "0.4", "--out", "whole.dcd")
    run("run", box, *options, "--time", "0.2", "--out", "parts.dcd")
    run("run", box, "--restart", "parts.chk", "--time", "0.4", "--platform", "Reference")
    whole, parts = log("whole.csv"), log("parts.csv")
    for name in whole:
        assert np.array_equal(whole[name], parts[name], equal_nan=True), name
    # The bath exchanges energy, of which the conserved quantity knows.
    assert np.ptp(whole["Total Energy (kJ/mole)"]) > 10 * np.ptp(whole["Conserved Energy (kJ/mole)"])


@pytest.mark.slow
def test_hybrid_monte_carlo_is_restarted(box):
    options = [*SMALL, "--ensemble", "hmc", "--steps-per-trial", "4", "--pressure", "1", "--seed", "3"]
    run("run", box, *options, "--steps", "6", "--out", "whole.dcd")
    run("run", box, *options, "--steps", "3", "--out", "parts.dcd")
    run("run", box, "--restart", "parts.chk", "--steps", "6", "--platform", "Reference")
    whole, parts = log("whole.csv"), log("parts.csv")
    # A step is a trial of 16 fs, and every 0.04 ps of the default are the nearest to two.
    assert whole["Step"].tolist() == [0, 2, 4, 6]
    assert whole["Time (ps)"] == pytest.approx(0.016 * whole["Step"], rel=1e-12)
    assert whole["Acceptance"][-1] in np.arange(7) / 6
    for name in whole:
        assert np.array_equal(whole[name], parts[name], equal_nan=True), name


@pytest.mark.slow
def test_constant_pressure_changes_the_box(box):
    run("run", box, *SMALL, "--ensemble", "npt", "--pressure", "-500", "--time", "0.4")
    volumes = log("box.csv")["Box Volume (nm^3)"]
    assert len(set(volumes.tolist())) > 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--friction", "1"], "--friction needs --ensemble nvt, npt or hmc"),
        (["--ensemble", "nvt", "--pressure", "1"], "--pressure needs --ensemble npt or hmc"),
        (["--ensemble", "nvt", "--steps-per-trial", "5"], "--steps-per-trial needs --ensemble hmc"),
    ],
)
def test_options_of_another_ensemble(capsys, box, arguments, message):
    assert message in complaint(capsys, "run", str(box), *arguments)


@pytest.mark.slow
def test_restart_keeps_the_ensemble(capsys, box):
    run("run", box, *SMALL, "--steps", "10")
    assert "--ensemble nvt differs from nve" in complaint(
        capsys, "run", str(box), "--restart", "box.chk", "--ensemble", "nvt", "--steps", "20"
    )


def test_default_scheme_is_that_of_the_integrators(box):
    run("run", box, "--platform", "Reference", "--equilibrate", "0", "--steps", "1")
    plan = checkpoints.read_checkpoint(Path("box.chk"))[1]["plan"]
    assert CATALOGUE[plan["scheme"]] == SIERIntegrator(0.001).scheme == SIER4G
    # The README's recommendation.
    assert plan["dt"] == 6.0


def test_runs_begun_with_another_default_scheme_are_continued(box):
    """Until 0.1.0 the default was SIER4 with 4 fs; checkpoints hold scheme and step."""
    run("run", box, "--scheme", "sier4", "--platform", "Reference", "--equilibrate", "0", "--steps", "2")
    run("run", box, "--platform", "Reference", "--restart", "box.chk", "--steps", "3")
    plan = checkpoints.read_checkpoint(Path("box.chk"))[1]["plan"]
    assert (plan["scheme"], plan["dt"], plan["steps"]) == ("sier4", 4.0, 3)
