"""Points are moved into the periodic box by whole box vectors."""

import numpy as np
import pytest
from openmm.app.internal.unitcell import reducePeriodicBoxVectors

from openmm_sier.inputs.pdb_files import extent
from openmm_sier.system.boxes import wrapped


def test_points_in_a_triclinic_box(rng):
    vectors = np.array([[2, 0, 0], [0.7, 1.8, 0], [-0.6, 0.8, 1.5]])
    points = rng.normal(0, 5, (200, 3))
    moved = wrapped(points, vectors)
    assert (moved >= 0).all()
    assert (moved <= np.diag(vectors)).all()
    images = (points - moved) @ np.linalg.inv(vectors)
    assert np.abs(images - np.round(images)).max() < 1e-12


#: Boxes as OpenMM's Modeller makes them, of edges of 1 nm.
DODECAHEDRON = np.array([[1, 0, 0], [0, 1, 0], [0.5, 0.5, 0.5**0.5]])
OCTAHEDRON = np.array([[1, 0, 0], [1 / 3, 8**0.5 / 3, 0], [-1 / 3, 2**0.5 / 3, 6**0.5 / 3]])


@pytest.mark.parametrize("box", [DODECAHEDRON, OCTAHEDRON])
def test_a_box_has_the_same_angles_whatever_rounding_made_of_its_vectors(box):
    """Reduced vectors of one lattice differ where shifts are half an edge; a file rounds them by 1e-4 nm."""
    shown = extent(box)
    for change in (1e-9, -1e-9, 5e-5, -5e-5):
        other = box + change * np.tril(np.ones((3, 3)), -1)
        reduced = np.array(reducePeriodicBoxVectors(other.tolist())._value)
        # Two figures of an angle that a file rounds.
        angles, others = (
            [float(word.rstrip(",")) for word in text.split() if "." in word] for text in (shown, extent(reduced))
        )
        np.testing.assert_allclose(others, angles, atol=0.02)
