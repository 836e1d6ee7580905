"""The scan of PME's meshes: which meshes are tried, what their error is, and its files."""

from __future__ import annotations

import math

import numpy as np
import pytest

from studies import mesh, records
from studies.mesh import MeshSettings, Parameters
from tests.support.commands import write_lattice
from tests.support.reports import Told


def test_sizes_are_those_with_fast_transforms():
    assert mesh.sizes(2.0, (0.1, 0.2)) == [10, 12, 14, 15, 16, 18, 20]


@pytest.fixture(scope="module")
def box():
    settings = MeshSettings(platform="CPU")
    replica, _ = mesh._replica(settings, 512)
    return settings, replica, mesh.reference(replica, settings)


def test_reference_is_tight(box):
    """Another Ewald parameter and mesh give the same forces, to the rounding of single precision (1e-6 or less)."""
    settings, replica, exact = box
    alpha = mesh.ewald_parameter(mesh.TIGHT, settings.cutoff)
    other = mesh._with(replica, settings, Parameters(alpha + 0.3, 210)).read()
    assert mesh.error(other, exact) < 2e-6


def test_error_is_relative_and_is_that_of_each_copy():
    exact = np.array([[3.0, 0.0, 0.0], [0.0, 4.0, 0.0]])
    assert mesh.error(np.tile(1.01 * exact, (8, 1)), exact) == pytest.approx(0.01)


def test_parameters_are_those_that_openmm_takes(box):
    """A mesh of 22 points has the factor 11, which OpenMM's CPU platform raises to 24; balancing keeps the mesh."""
    settings, replica, exact = box
    openmm_choice, balanced = (mesh._by_tolerance(replica, settings, 5e-4, split) for split in mesh._SPLITS)
    assert openmm_choice.parameters.mesh == balanced.parameters.mesh == 24
    assert openmm_choice.parameters.alpha == pytest.approx(mesh.ewald_parameter(5e-4, 0.9))
    # Five to six times as exact in docs/accuracy.md.
    assert mesh.error(openmm_choice.read(), exact) > 4 * mesh.error(balanced.read(), exact)


@pytest.mark.slow
def test_mesh_in_miniature(tmp_path):
    box = write_lattice(tmp_path / "box.pdb", 64)
    settings = MeshSettings(
        out=tmp_path,
        box=box,
        platform="CPU",
        molecules=(64, 512),
        cutoff=0.55,
        tolerances=(5e-4, 1e-4),
        spacing=(0.06, 0.1),
        alphas=3,
        meshes=3,
        rounds=1,
        turn=1e-6,
    )
    told = Told()
    mesh.study(settings, told)
    found = records.read(tmp_path / "mesh.json").tables
    assert len(found["scan"]) == 3 * len(mesh.sizes(1.24, settings.spacing))
    # In a repeated box a mesh of the same spacing has the same error: single precision apart.
    here, there = (found["meshes"].query(f"molecules == {n}") for n in (64, 512))
    same = here.assign(mesh=2 * here["mesh"]).merge(there, on="mesh")
    assert len(same)
    assert list(same["error_x"]) == pytest.approx(list(same["error_y"]), rel=0.05)
    choices = found["choices"]
    assert list(choices["split"]) == 4 * ["OpenMM", "balanced"]
    known = choices.dropna(subset=["best_error"])
    assert len(known)
    assert (known["best_error"] <= known["error"]).all()
    assert all(math.isfinite(ratio) for ratio in known["ratio"])
    assert (tmp_path / "mesh.png").stat().st_size > 10_000
