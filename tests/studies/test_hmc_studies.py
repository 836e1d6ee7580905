"""The studies of solvated molecules by hybrid Monte Carlo, in miniature."""

from __future__ import annotations

import numpy as np
import openmm
import pandas as pd
import pytest

from openmm_sier import RigidBodies
from studies.hmc import mixture, samples, solutes, solvated
from studies.hmc.curvature import Curvature
from studies.hmc.dihedrals import dihedral
from tests.support.commands import SYSTEMS

DIPEPTIDE = SYSTEMS / "dipeptide.pdb"


@pytest.mark.slow
def test_trials_of_all_and_of_a_part(tmp_path):
    common = {"box": DIPEPTIDE, "cutoff": 0.7, "equilibrate": 0.01, "out": tmp_path, "trials": 3, "discarded": 1}
    made = [solvated.run(solvated.SolvatedSettings(moving=moving, **common)) for moving in ("all", "solute", "water")]
    assert [len(record.tables["trials"]) for record in made] == [3, 3, 3]
    assert made[0].notes["waters"] == 233
    assert made[0].notes["solute"] == 22
    solvated.study(solvated.SolvatedSettings(table=tuple(tmp_path.glob("dipeptide-*.json")), out=tmp_path))
    assert (tmp_path / "solvated.json").exists()


def test_frozen_parts_have_neither_mass_nor_constraints():
    solution = solutes.read(solutes.SoluteSettings(box=DIPEPTIDE, cutoff=0.7, moving="solute"))
    moving = [i for i in range(721) if solution.system.getParticleMass(i)._value]
    assert moving == solution.solute.tolist()
    # Bonds to hydrogen, 12 of them.
    assert solution.system.getNumConstraints() == 12


def test_heavy_water_weighs_what_water_weighs():
    solution = solutes.read(solutes.SoluteSettings(box=DIPEPTIDE, cutoff=0.7, heavy_water=True))
    masses = [solution.system.getParticleMass(i)._value for i in range(718, 721)]
    assert masses == pytest.approx([12.0154, 3, 3])


def test_the_law_by_size():
    """Boxes whose spreads are 0.01 for each root of the number of atoms."""
    rows = pd.DataFrame({"atoms": [100, 400], "spread": [0.1, 0.2], "trials": [50, 50]})
    rows = rows.assign(moving="all", scheme="sier4g", masses="3", per_force=2.0, solute=10, waters=30)
    (law,) = solvated.laws(rows).to_dict("records")
    assert law["one"] == pytest.approx(0.01)
    # An acceptance of 0.5 is that of a spread of 1.349.
    assert law["atoms_50"] == pytest.approx(134.9**2, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{}, {"method": "langevin"}, {"method": "wrong", "held": True}])
def test_samples(tmp_path, settings):
    common = {"box": DIPEPTIDE, "time": 0.72, "settling": 0.12, "equilibrate": 0.01, "out": tmp_path}
    record = samples.run(samples.SampleSettings(**settings, **common))
    assert len(record.tables["samples"]) == 6
    # Steps of 2 fs for each force in 120 fs, and an energy for a trial and for a move.
    assert record.notes["forces"] == pytest.approx(60, abs=3)
    (row,) = samples.table(sorted(tmp_path.glob("*-1.json"))).to_dict("records")
    assert row["time"] == pytest.approx(0.72)


@pytest.mark.slow
def test_a_mixture(tmp_path, monkeypatch):
    monkeypatch.setattr(mixture, "start", lambda settings: openmm.app.PDBFile(str(DIPEPTIDE)))
    common = {"time": 1.8, "settling": 0.06, "out": tmp_path}
    made = {method: [mixture.run(mixture.MixtureSettings(method=method, **common))] for method in ("hmc", "langevin")}
    rows = mixture.table(made)
    # Means of 1.8 ps after a sudden start.
    assert rows["conf_rotation"].between(150, 450).all()
    assert rows["density"].between(0.8, 1.2).all()
    pytest.importorskip("physical_validation", reason="pip install openmm-sier[validation]")
    tests = mixture.kinetic_tests(made)
    assert tests["group"].tolist() == 2 * ["translation", "rotation", "flexible molecules"]
    # The same: no mean is off by more than the 150 K of above, which is some ten standard errors.
    assert tests["mean"].between(0, 30).all()


def test_a_dihedral():
    positions = np.array([[1.0, 0, 0], [0, 0, 0], [0, 0, 1.0], [np.cos(0.7), np.sin(0.7), 1.0]])
    assert dihedral(positions, [0, 1, 2, 3]) == pytest.approx(0.7)


def test_curvatures_of_known_potentials():
    """Wells for the points, and a field v.w on arms w of rigid water, whose Laplacian on rotations is -2 v.w."""
    system, force = openmm.System(), openmm.CustomExternalForce("0.5*k*(x^2 + y^2 + z^2)")
    force.addPerParticleParameter("k")
    arms = np.array([[0.0, 0, 0], [0.1, 0, 0], [-0.025, 0.0968, 0]])
    springs = np.array([100.0, 300.0, 50.0, 200.0])
    masses = np.array([16.0, 1.0, 1.0, 12.0])
    for mass, spring in zip(masses, springs, strict=True):
        force.addParticle(system.addParticle(mass), [spring])
    for i, j in ((0, 1), (0, 2), (1, 2)):
        system.addConstraint(i, j, np.linalg.norm(arms[i] - arms[j]))
    system.addForce(force)
    positions = np.vstack([arms + np.array([0.5, 0.2, 0.1]), [[0.3, -0.2, 0.1]]])
    curvature = Curvature(system, RigidBodies.from_system(system), 1, "Reference")
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(positions)
    state = context.getState(positions=True)
    found = pd.DataFrame([curvature(state) for _ in range(400)]).mean()
    centre = masses[:3] @ positions[:3] / 18
    # The point is alone: its estimate has no scatter.
    assert found["flexible_square"] == pytest.approx(200**2 * (positions[3] ** 2).sum() / 12, rel=1e-6)
    assert found["flexible_divergence"] == pytest.approx(3 * 200 / 12, rel=1e-6)
    assert found["translation_divergence"] == pytest.approx(3 * springs[:3].sum() / 18, rel=0.1)
    from_centre = positions[:3] - centre
    field = centre @ (springs[:3] @ from_centre)
    torque = np.cross(springs[:3] @ from_centre, -centre)
    assert found["rotation_square"] == pytest.approx((torque**2).sum(), rel=1e-4)
    # 400 estimates whose scatter is about the mean itself.
    assert found["rotation_divergence"] == pytest.approx(-2 * field, rel=0.25)
