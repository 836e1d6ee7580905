"""Points are moved into the periodic box by whole box vectors."""

import numpy as np

from openmm_sier.system.boxes import wrapped


def test_points_in_a_triclinic_box(rng):
    vectors = np.array([[2, 0, 0], [0.7, 1.8, 0], [-0.6, 0.8, 1.5]])
    points = rng.normal(0, 5, (200, 3))
    moved = wrapped(points, vectors)
    assert (moved >= 0).all()
    assert (moved <= np.diag(vectors)).all()
    images = (points - moved) @ np.linalg.inv(vectors)
    assert np.abs(images - np.round(images)).max() < 1e-12
