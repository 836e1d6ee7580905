"""Principal moments as the free rotation takes them."""

from __future__ import annotations

import numpy as np
import pytest

from openmm_sier.dynamics.backend.formulas import body_frame
from openmm_sier.dynamics.backend.top import top
from tests.support.oracles import apply, random_attitudes


def test_body_frame(rng):
    A, L = random_attitudes(rng, 5), rng.normal(size=(3, 5))
    assert np.abs(body_frame(A, L) - apply(A, L)).max() < 1e-15


def test_top_sorts_rates_and_keeps_the_frame_right_handed():
    for order in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)):
        moments = np.array([0.5, 1.0, 2.0])[list(order)]
        bodies = top(moments)
        assert np.array_equal(bodies.rates, [2.0, 1.0, 0.5])
        frame = np.array([bodies.sort(axis[:, None]) for axis in np.eye(3)])[:, :, 0].T
        assert np.linalg.det(frame) == pytest.approx(1)
        assert np.array_equal(frame @ np.diag(moments) @ frame.T, np.diag([0.5, 1.0, 2.0]))
    assert np.array_equal(top((0.0, 2.0, 2.0)).rates, [0.5, 0.5, 0.5])
    assert np.array_equal(top((0.0, 0.0, 0.0)).rates, [0.0, 0.0, 0.0])
