"""The commands beyond `run` at constant energy: ensembles, and the comparisons of integrators in miniature."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from openmm_sier import bench, cli, equipartition, sampling
from tests.test_cli import SMALL, complaint, log, write_lattice


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    return write_lattice(tmp_path_factory.mktemp("box") / "box.pdb")


@pytest.fixture(autouse=True)
def directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def run(*arguments):
    assert cli.main([str(argument) for argument in arguments]) == 0


def test_constant_temperature_is_restarted_bit_for_bit(box):
    options = [*SMALL, "--ensemble", "nvt", "--scheme", "sier2", "--dt", "2", "--friction", "5", "--seed", "3"]
    run("run", box, *options, "--time", "0.4", "--out", "whole.dcd")
    run("run", box, *options, "--time", "0.2", "--out", "parts.dcd")
    run("run", box, "--restart", "parts.chk", "--time", "0.4", "--platform", "Reference")
    whole, parts = log("whole.csv"), log("parts.csv")
    for name in whole:
        assert np.array_equal(whole[name], parts[name]), name
    # The bath exchanges energy, of which the conserved quantity knows.
    assert np.ptp(whole["total_kJ_per_mol"]) > 10 * np.ptp(whole["conserved_kJ_per_mol"])


def test_constant_pressure_changes_the_box(box):
    run("run", box, *SMALL, "--ensemble", "npt", "--pressure", "-500", "--time", "0.4", "--scheme", "auto")
    volumes = log("box.csv")["volume_nm3"]
    assert len(set(volumes.tolist())) > 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--friction", "1"], "--friction needs --ensemble nvt or npt"),
        (["--ensemble", "nvt", "--pressure", "1"], "--pressure needs --ensemble npt"),
    ],
)
def test_options_of_another_ensemble(capsys, box, arguments, message):
    assert message in complaint(capsys, "run", str(box), *arguments)


def test_restart_keeps_the_ensemble(capsys, box):
    run("run", box, *SMALL, "--steps", "10")
    assert "--ensemble nvt differs from nve" in complaint(
        capsys, "run", str(box), "--restart", "box.chk", "--ensemble", "nvt", "--steps", "20"
    )


def test_equipartition_in_miniature(box, capsys, monkeypatch):
    monkeypatch.setattr(equipartition, "SETTLING", 0.02)
    run(
        *("equipartition", box, "--dt", "1", "2", "--time", "0.1", "--equilibrate", "0.05"),
        *("--methods", "verlet", "sier4", "--platform", "Reference", "--out", "eq"),
    )
    rows = equipartition.load(Path("eq/equipartition.json"))
    assert [(row.method, row.step) for row in rows] == [
        ("OpenMM Verlet", 1.0),
        ("OpenMM Verlet", 2.0),
        ("SIER4", 4.0),
        ("SIER4", 8.0),
    ]
    # The box has not been equilibrated: it is hot, but no simulation of it breaks down.
    assert all(100 < row.rotation[0] < 2000 and not row.broken for row in rows)
    assert rows[0].density[0] == pytest.approx(0.997, abs=1e-3)
    assert "T_rot - T_trans" in capsys.readouterr().out


def test_equipartition_refuses_unknown_methods(box, capsys):
    assert "unknown method 'leapfrog'" in complaint(capsys, "equipartition", str(box), "--methods", "leapfrog")


def test_mean_and_error_of_correlated_samples():
    # An autoregressive series: the mean of n samples with correlation c has the error sqrt((1 + c)/(1 - c)/n).
    rng = np.random.default_rng(5)
    n, c = 20000, 0.9
    values = np.zeros(n)
    for i in range(1, n):
        values[i] = c * values[i - 1] + np.sqrt(1 - c * c) * rng.normal()
    mean, error = sampling.mean_and_error(values)
    expected = np.sqrt((1 + c) / (1 - c) / n)
    # 20 blocks know their scatter to 16 %.
    assert error == pytest.approx(expected, rel=0.5)
    assert abs(mean) < 4 * expected


def test_bench_in_miniature(box):
    run("bench", box, "--copies", "1", "--rounds", "1", "--platform", "Reference", "--out", "b")
    record = json.loads(Path("b/bench.json").read_text())
    assert [row["molecules"] for row in record["steps"]] == [27] * 5
    assert all(row["median"] > 0 for row in record["steps"])


def test_interleaved_timings_discard_the_first_round():
    calls = []
    seconds = bench.interleaved({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, 2)
    assert calls == ["a", "b"] * 3
    assert [len(values) for values in seconds.values()] == [2, 2]
