"""What a sample costs: short runs, forces, and series whose samples are independent."""

from __future__ import annotations

import mdtraj
import numpy as np
import pandas as pd
import pytest

from openmm_sier.inputs.forcefields import read_box
from studies import command_runs, records
from studies.hmc import costs
from studies.hmc.samples import charges
from tests.support.studies import make_here

ROWS = 400

TRIALS, MIDDLE = "SIER4G, trials of 30 fs, steps of 6 fs", "OpenMM LangevinMiddle, steps of 4 fs, friction 2/ps"


def columns(seed, energy):
    """A log whose values are independent, so that each of them is a sample."""
    rng = np.random.default_rng(seed)
    found = {"Time (ps)": 0.12 * np.arange(ROWS), "Potential Energy (kJ/mole)": energy + rng.normal(size=ROWS)}
    found |= {"Box Volume (nm^3)": 7 + 0.1 * rng.normal(size=ROWS), "Density (g/mL)": 1 + 0.1 * rng.normal(size=ROWS)}
    errors = np.where(np.arange(ROWS) > 0, rng.normal(scale=0.1, size=ROWS), np.nan)
    return found | {"Acceptance": np.full(ROWS, 0.9), "Energy Error (kT)": errors}


def test_costs_of_runs_that_are_pooled(tmp_path, monkeypatch):
    monkeypatch.setattr(records, "make_missing", make_here)
    monkeypatch.setattr(command_runs, "carry_out", lambda *given: None)
    # Of trials there are two seeds, of the other one.
    logs = {f"seed{seed}": columns(seed, -10.0) for seed in (1, 2)}
    monkeypatch.setattr(command_runs, "read_log", lambda directory, skip: logs[directory.name.rpartition("-")[2]])
    still = pd.DataFrame({"psi": np.zeros(ROWS)})
    monkeypatch.setattr(costs, "in_frames", lambda directory, skip: {"psi": still})
    costs.study(costs.CostSettings(methods=(MIDDLE,), starts=1, out=tmp_path))
    langevin, hmc = (
        costs.study(costs.CostSettings(methods=(TRIALS,), starts=2, out=tmp_path)).tables["rows"].to_dict("records")
    )
    assert langevin["label"] == f"dipeptide: {MIDDLE}"
    assert hmc["label"] == f"dipeptide: {TRIALS}"
    assert (hmc["runs"], langevin["runs"]) == (2, 1)
    assert hmc["time"] == pytest.approx(2 * 0.12 * (ROWS - 1))
    assert hmc["accepted"] == pytest.approx(0.9)
    # 400 numbers tell a standard deviation to 4 %, 800 to 2.5 %.
    assert hmc["spread"] == pytest.approx(0.1, rel=0.1)
    assert np.isnan(langevin["spread"])
    assert hmc["potential"] == pytest.approx(-10, abs=0.2)
    # Four trials of 15 forces, an energy for each and one for the move of the volume; 30 steps, and 30/25 moves. What
    # is independent has an inefficiency of 1, which is estimated from above.
    assert 68 <= hmc["potential_cost"] < 1.5 * 68
    assert 31.2 <= langevin["volume_cost"] < 1.5 * 31.2
    # What does not change has no samples.
    assert np.isnan(hmc["psi_cost"])
    assert (tmp_path / "costs.json").exists()


@pytest.mark.slow
def test_dipoles_and_dihedrals_are_those_of_the_frames(tmp_path, monkeypatch):
    monkeypatch.setattr(costs, "EVERY", 0.03)
    often = {"every": 0.03, "report_every": 0.03, "equilibrate": 0.004, "minimize": False}
    monkeypatch.setattr(costs, "OPTIONS", costs.OPTIONS | often)
    settings = costs.CostSettings(time=0.3, skip=0.15, out=tmp_path)
    task = next(task for task in costs.tasks(settings) if task.method == TRIALS)
    row = costs.run(task)
    found = costs.in_frames(costs.directory(task), 0.15)
    assert {name: each.shape for name, each in found.items()} == {"dipole": (5, 3), "psi": (5, 1)}
    assert row["time"] == pytest.approx(0.15)
    assert 0 <= row["accepted"] <= 1
    frames = command_runs.read_frames(costs.directory(task), costs.BOX)[5:]
    np.testing.assert_allclose(found["psi"], np.cos(mdtraj.compute_psi(frames, periodic=False)[1]), atol=1e-5)
    # Residues are neutral: arms of their atoms to the nearest images make the dipole of whole molecules.
    first = [atom.residue.atom(0).index for atom in frames.topology.atoms]
    arms, edges = frames.xyz - frames.xyz[:, first], frames.unitcell_lengths[:, None]
    arms -= edges * np.round(arms / edges)
    dipoles = charges(read_box(costs.BOX, None, "hbonds").system) @ arms
    # Single precision of 721 charges at 2 nm.
    np.testing.assert_allclose(found["dipole"], dipoles, atol=1e-4)


def test_forces_of_a_step():
    assert [costs.forces_per_step(costs.METHODS[name]) for name in (TRIALS, MIDDLE)] == [17, 1 + 1 / 25]
