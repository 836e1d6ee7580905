"""`openmm-sier validate`: which runs belong together, what is checked, and how it ends."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.canonical import P, T, log
from tests.support.commands import complaint, run
from tests.support.finished_runs import write_run

pytest.importorskip("physical_validation", reason="pip install openmm-sier[validation]")

FAILED = 5


def test_runs_that_differ_in_their_seeds_are_one(capsys):
    options = {"ensemble": "npt", "temperature": T, "pressure": P}
    runs = [write_run(f"seed{seed}", log(seed=seed, rows=200), seed=seed, **options) for seed in (1, 2)]
    run("validate", *runs)
    said = capsys.readouterr().out
    assert "SIER4G, NPT, 300 K, 1000 bar, 6 fs, 2 runs" in said
    assert said.count("passes") == 6
    assert "a second run at a temperature higher by" in said
    assert "a pressure higher by" in said


def test_runs_that_tell_no_widths_suggest_no_second_run(capsys):
    """Volumes that did not move asked for a pressure higher by 9.23e+16 bar."""
    options = {"ensemble": "npt", "temperature": T, "pressure": P}
    still = log(rows=200) | {"Box Volume (nm^3)": np.full(200, 8.0)}
    still["Box Volume (nm^3)"][1::2] += 1e-14
    run("validate", write_run("still", still, **options))
    said = " ".join(capsys.readouterr().out.split())
    assert "a second run at a temperature higher by" in said
    assert "pressure higher" not in said
    # All samples of a slow drift are worth one.
    drift = np.linspace(0, 1, 200)
    slow = {"Potential Energy (kJ/mole)": drift, "Box Volume (nm^3)": 8 + drift}
    run("validate", write_run("slow", log(rows=200) | slow, **options))
    said = " ".join(capsys.readouterr().out.split())
    assert "independent samples, 20 are needed" in said
    assert "a second run" not in said


def test_a_failed_check_is_the_exit_code(capsys):
    write_run("cold", log(heated=(1.0, 0.95)), ensemble="nvt", temperature=T, scheme="sier2", dt=4.0)
    said = complaint_after_table(capsys, "cold")
    assert "rotation: mean kinetic energy of SIER2, NVT, 300 K, 4 fs by" in said
    run("validate", "cold", "--limit", "100")


def complaint_after_table(capsys, *arguments):
    """The last line on standard error; notes come before it."""
    from openmm_sier.cli import main

    assert main.main(["validate", *arguments]) == FAILED
    return capsys.readouterr().err.splitlines()[-1]


def test_state_points_are_compared_where_they_differ_in_one_setting(capsys):
    points = {"one": (T, P), "hot": (345.0, P), "pressed": (T, 1250.0)}
    for seed, (name, (temperature, pressure)) in enumerate(points.items()):
        values = log(temperature, pressure, seed=seed)
        write_run(name, values, ensemble="npt", temperature=temperature, pressure=pressure)
    run("validate", *points)
    said = " ".join(capsys.readouterr().out.split())
    assert "enthalpy at 300 and 345 K" in said
    assert "volume at 1000 and 1250 bar" in said
    # Hot and pressed differ in both.
    assert said.count(" at ") == 2


def test_the_order_at_constant_energy_is_the_schemes(capsys):
    rng = np.random.default_rng(1)
    time = np.arange(1000) * 0.02
    for dt, width in ((4.0, 16.0), (2.0, 1.0)):
        values = log(rows=1000) | {"Time (ps)": time, "Conserved Energy (kJ/mole)": rng.normal(0, width, 1000)}
        write_run(f"sier4-{dt:g}", values, scheme="sier4", dt=dt)
        write_run(f"verlet-{dt:g}", values, scheme="verlet", dt=dt)
    run("validate", "sier4-4", "sier4-2")
    assert "16 expected of order 4" in " ".join(capsys.readouterr().out.split())
    assert "OpenMM Verlet, NVE" in complaint_after_table(capsys, "verlet-4", "verlet-2")


def test_all_runs_at_constant_energy_count(capsys):
    """Of two seeds at the longer step, the second conserves its energy four times as badly as the order demands."""
    rng = np.random.default_rng(2)
    time = np.arange(1000) * 0.02
    for dt, seed, width in ((4.0, 1, 16.0), (4.0, 2, 64.0), (2.0, 1, 1.0), (2.0, 2, 1.0)):
        values = log(rows=1000, seed=seed) | {
            "Time (ps)": time,
            "Conserved Energy (kJ/mole)": rng.normal(0, width, 1000),
        }
        write_run(f"{dt:g}-{seed}", values, scheme="sier4", dt=dt, seed=seed)
    run("validate", "4-1", "2-1", "2-2")
    capsys.readouterr()
    assert "energy at 4 and 2 fs" in complaint_after_table(capsys, "4-1", "4-2", "2-1", "2-2")


def test_what_tells_nothing_is_refused(capsys):
    write_run("alone", log(), scheme="sier4")
    assert "nothing can be checked" in complaint(capsys, "validate", "alone")
    assert "has 10 rows after 390 ps" in complaint(capsys, "validate", "alone", "--skip", "390")
