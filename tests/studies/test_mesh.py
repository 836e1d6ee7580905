"""The scan of PME's meshes: which meshes are tried, what their error is, and its files."""

import pytest

from studies import mesh
from studies.mesh import MeshSettings, Parameters


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


def test_parameters_are_those_that_openmm_takes(box):
    """A mesh of 22 points has the factor 11, which OpenMM's CPU platform raises to 24; a tenth more are 25."""
    settings, replica, exact = box
    openmm_choice, balanced = (mesh._by_tolerance(replica, settings, 5e-4, split) for split in mesh._SPLITS)
    assert openmm_choice.parameters.mesh == 24
    assert balanced.parameters.mesh == 25
    assert openmm_choice.parameters.alpha == pytest.approx(mesh.ewald_parameter(5e-4, 0.9))
    # Four times as exact at this tolerance, seven times at tighter ones.
    assert mesh.error(openmm_choice.read(), exact) > 3 * mesh.error(balanced.read(), exact)
