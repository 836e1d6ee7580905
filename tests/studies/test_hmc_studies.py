"""The studies of solvated molecules by hybrid Monte Carlo, in miniature."""

import math

import numpy as np
import openmm
import pandas as pd
import pytest

from openmm_sier import RigidBodies
from studies.hmc import solutes, trials
from studies.hmc.curvature import Curvature
from studies.hmc.samples import dihedral
from tests.support.commands import SYSTEMS
from tests.support.systems import assembled
from tests.support.waters import plain_context

DIPEPTIDE = SYSTEMS / "dipeptide.pdb"


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


def test_a_dihedral():
    positions = np.array([[1.0, 0, 0], [0, 0, 0], [0, 0, 1.0], [np.cos(0.7), np.sin(0.7), 1.0]])
    assert dihedral(positions, [0, 1, 2, 3]) == pytest.approx(0.7)


def test_curvatures_of_known_potentials():
    """Wells for the points, and a field v.w on arms w of rigid water, whose Laplacian on rotations is -2 v.w."""
    force = openmm.CustomExternalForce("0.5*k*(x^2 + y^2 + z^2)")
    force.addPerParticleParameter("k")
    arms = np.array([[0.0, 0, 0], [0.1, 0, 0], [-0.025, 0.0968, 0]])
    springs = np.array([100.0, 300.0, 50.0, 200.0])
    masses = np.array([16.0, 1.0, 1.0, 12.0])
    for i, spring in enumerate(springs):
        force.addParticle(i, [spring])
    held = [(i, j, np.linalg.norm(arms[i] - arms[j])) for i, j in ((0, 1), (0, 2), (1, 2))]
    system = assembled(masses, force, constraints=held)
    positions = np.vstack([arms + np.array([0.5, 0.2, 0.1]), [[0.3, -0.2, 0.1]]])
    curvature = Curvature(system, RigidBodies.from_system(system), 1, "Reference")
    state = plain_context(system, positions).getState(positions=True)
    result = pd.DataFrame([curvature(state) for _ in range(400)]).mean()
    centre = masses[:3] @ positions[:3] / 18
    # The point is alone: its estimate has no scatter.
    assert result["flexible_square"] == pytest.approx(200**2 * (positions[3] ** 2).sum() / 12, rel=1e-6)
    assert result["flexible_divergence"] == pytest.approx(3 * 200 / 12, rel=1e-6)
    assert result["translation_divergence"] == pytest.approx(3 * springs[:3].sum() / 18, rel=0.1)
    from_centre = positions[:3] - centre
    field = centre @ (springs[:3] @ from_centre)
    torque = np.cross(springs[:3] @ from_centre, -centre)
    assert result["rotation_square"] == pytest.approx((torque**2).sum(), rel=1e-4)
    # 400 estimates whose scatter is about the mean itself.
    assert result["rotation_divergence"] == pytest.approx(-2 * field, rel=0.25)


def test_costs_compared_with_those_of_langevin_middle():
    """Two runs of trials, weighted by their times, beside one of the reference; a run that is too short tells none."""
    common = {"box": "b", "at": "constant volume", "hydrogens": "4 Da", "broken": "", "fs_per_second": 100.0}
    of_trials = common | {"method": "SIER2V2 HMC, 9 fs x 8, 1/ps", "accepted": 0.9, "trials": 10}
    short = {"dipole_cost": 50.0, "dipole_cost_error": math.nan}
    runs = [
        common | {"method": trials.REFERENCE, "time": 10.0, "cost": 200.0, "cost_error": 20.0} | short,
        of_trials | {"time": 10.0, "cost": 100.0, "cost_error": 30.0} | short,
        of_trials | {"time": 30.0, "cost": 140.0, "cost_error": 40.0} | short,
    ]
    row = trials.compared(pd.DataFrame(runs)).iloc[1]
    assert row["cost"] == pytest.approx(130)
    # Two forces in 9 fs, and 100 fs in a second.
    assert row["milliseconds"] == pytest.approx(1e3 * 9 / 200)
    assert row["relative"] == pytest.approx(0.65)
    error = math.hypot(math.hypot(0.25 * 30, 0.75 * 40) / 130, 0.1)
    assert row["relative_error"] == pytest.approx(0.65 * error)
    assert row["seconds"] == pytest.approx(130 * 0.045)
    assert math.isnan(row["dipole_cost"])
