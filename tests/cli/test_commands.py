"""The commands beyond `run` at constant energy: ensembles, and the comparisons of integrators in miniature."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from openmm_sier import SIER4G, SIERIntegrator
from openmm_sier.cli import records
from openmm_sier.dynamics.schemes import CATALOGUE
from studies import equipartition
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
def test_hybrid_monte_carlo_is_restarted_in_mid_trial(box):
    options = [*SMALL, "--ensemble", "hmc", "--steps-per-trial", "4", "--pressure", "1", "--seed", "3"]
    run("run", box, *options, "--steps", "24", "--out", "whole.dcd")
    run("run", box, *options, "--steps", "10", "--out", "parts.dcd")
    run("run", box, "--restart", "parts.chk", "--steps", "24", "--platform", "Reference")
    whole, parts = log("whole.csv"), log("parts.csv")
    # Every 0.04 ps of the default are ten steps, of which two trials are the nearest.
    assert whole["Step"].tolist() == [0, 8, 16, 24]
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


@pytest.mark.slow
def test_equipartition_in_miniature(box, capsys, monkeypatch):
    monkeypatch.setattr(equipartition, "SETTLING", 0.02)
    run(
        *("equipartition", box, "--dt", "1", "2", "--time", "0.1", "--equilibrate", "0.05"),
        *("--methods", "verlet", "sier2", "sier4", "--platform", "Reference", "--out", "eq"),
    )
    rows = equipartition.load(Path("eq/equipartition.json"))
    assert [(row.method, row.step) for row in rows] == [
        ("OpenMM Verlet", 1.0),
        ("OpenMM Verlet", 2.0),
        ("SIER2", 1.0),
        ("SIER2", 2.0),
        ("SIER4", 4.0),
        ("SIER4", 8.0),
    ]
    # The box has not been equilibrated: it is hot, but no simulation of it breaks down.
    assert all(100 < row.rotation[0] < 2000 and not row.broken for row in rows)
    assert rows[0].density[0] == pytest.approx(0.997, abs=1e-3)
    # Known for SIER2 alone, where it is that of h^2.
    assert rows[2].predicted < 0
    assert rows[3].predicted == pytest.approx(4 * rows[2].predicted)
    assert all(math.isnan(row.predicted) for row in rows[:2] + rows[4:])
    assert "T_rot - T_trans" in capsys.readouterr().out


def row(mean, error, time, **values):
    pair = (mean, error)
    given = dict.fromkeys(("translation", "rotation", "difference", "potential", "density"), pair)
    return equipartition.Row("SIER4", 4.0, 1.0, time, **given, drift=mean, **values)


def test_replicas_are_pooled_by_their_lengths():
    """Three times the length weighs as much, and has a standard error less by the square root of it."""
    (found,) = equipartition.pooled([row(1.0, 0.3, 30.0), row(2.0, 0.3 * 3**0.5, 10.0)])
    assert found.time == 40.0
    # The best estimate of all, whose error is that of one run of 40 ps.
    assert found.difference == pytest.approx((1.25, 0.3 * (3 / 4) ** 0.5))
    assert found.drift == pytest.approx(1.25)
    assert math.isnan(found.predicted)
    known = [row(1.0, 0.3, 30.0, predicted=-2.0), row(1.0, 0.3, 10.0, predicted=-1.0), row(1.0, 0.3, 10.0)]
    assert equipartition.pooled(known)[0].predicted == -1.5
    broken = row(0.0, 1.0, 10.0, broken="too hot")
    assert equipartition.pooled([row(1.0, 0.3, 30.0), broken]) == [broken]


@pytest.mark.slow
def test_equipartition_pools_directories(box, capsys, monkeypatch):
    monkeypatch.setattr(equipartition, "SETTLING", 0.02)
    short = ("--dt", "2", "--methods", "sier2", "--time", "0.1", "--equilibrate", "0.02", "--platform", "Reference")
    run("equipartition", box, *short, "--replicas", "2", "--out", "both")
    for seed in ("1", "2"):
        run("equipartition", box, *short, "--seed", seed, "--out", seed)
    run("equipartition", "--pool", "1", "2", "--out", "pooled")
    together = equipartition.load(Path("both/equipartition.json"))
    assert equipartition.load(Path("pooled/equipartition.json")) == together
    assert together[0].time == pytest.approx(0.2)
    run("equipartition", box, *short, "--temperature", "350", "--out", "hot")
    assert "hot and 1 cannot be pooled: their settings of temperature are 350.0 and 297.0" in complaint(
        capsys, "equipartition", "--pool", "1", "hot", "--out", "no"
    )
    assert "2 and both cannot be pooled: both have SIER2 at 2 fs with seed 2" in complaint(
        capsys, "equipartition", "--pool", "both", "2", "--out", "no"
    )
    assert "takes no box" in complaint(capsys, "equipartition", str(box), "--pool", "1", "2")
    assert not Path("no").exists()


@pytest.mark.slow
def test_short_times_give_one_sample(box, monkeypatch):
    monkeypatch.setattr(equipartition, "SETTLING", 0.002)
    short = ("--dt", "2", "--methods", "sier2", "--time", "0.004", "--equilibrate", "0.02", "--platform", "Reference")
    run("equipartition", box, *short, "--ensemble", "npt", "--pressure", "0", "--out", "one")
    record = json.loads(Path("one/equipartition.json").read_text())
    assert record["settings"]["pressure"] == 0
    assert record["rows"][0]["broken"] == ""


def test_equipartition_refuses_unknown_methods(box, capsys):
    assert "unknown method 'leapfrog'" in complaint(capsys, "equipartition", str(box), "--methods", "leapfrog")


def test_default_scheme_is_that_of_the_integrators(box):
    run("run", box, "--platform", "Reference", "--equilibrate", "0", "--steps", "1")
    plan = records.read_checkpoint(Path("box.chk"))[1]["plan"]
    assert CATALOGUE[plan["scheme"]] == SIERIntegrator(0.001).scheme == SIER4G
    # The README's recommendation.
    assert plan["dt"] == 6.0


def test_runs_begun_with_another_default_scheme_are_continued(box):
    """Until 0.1.0 the default was SIER4 with 4 fs; checkpoints hold scheme and step."""
    run("run", box, "--scheme", "sier4", "--platform", "Reference", "--equilibrate", "0", "--steps", "2")
    run("run", box, "--platform", "Reference", "--restart", "box.chk", "--steps", "3")
    plan = records.read_checkpoint(Path("box.chk"))[1]["plan"]
    assert (plan["scheme"], plan["dt"], plan["steps"]) == ("sier4", 4.0, 3)
