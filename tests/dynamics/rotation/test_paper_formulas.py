"""The paper's misprints: formulas that fail as printed and hold after correction. `test_exact` compares others.

Source: van Zon and Schofield (2007).
"""

import numpy as np
import pytest

from openmm_sier import SIER4, Scheme
from openmm_sier.dynamics.schemes import DRIFT, KICK
from tests.support.oracles import (
    R1,
    matmul,
    orthogonality_error,
)

MOMENTS = np.array([0.6, 1.1, 1.7])


def test_misprint_in_R1(rng):
    """Element (2, 2) is +L Lx: so R1 is a rotation that takes z to L~; with the printed sign it is not orthogonal."""
    l = rng.normal(size=(3, 200))
    mended = R1(l)
    assert orthogonality_error(mended) < 1e-14
    assert np.linalg.det(mended.transpose(2, 0, 1)) == pytest.approx(1)
    assert np.abs(mended[:, 2] - l / np.linalg.norm(l, axis=0)).max() < 1e-15
    printed = R1(l, middle_sign=-1)
    deviation = np.abs(matmul(printed, printed.transpose(1, 0, 2)) - np.eye(3)[:, :, None]).max(axis=(0, 1))
    assert np.median(deviation) > 0.1


def test_misprint_in_the_scheme():
    """With h5 = h - 2(h1 + h2) the kicks sum to -0.51 h; h5 = h - 2(h1 + h3) is what the package has."""
    h1, h2, h3 = 0.1720865590295143, 0.5915620307551568, -0.1616217622107222
    h4 = 0.5 - h2

    def scheme(h5):
        wing = ((KICK, h1), (DRIFT, h2), (KICK, h3), (DRIFT, h4))
        return Scheme("EFRL", (*wing, (KICK, h5), *reversed(wing)))

    printed, mended = 1 - 2 * (h1 + h2), 1 - 2 * (h1 + h3)
    assert 2 * (h1 + h3) + printed == pytest.approx(-0.5064, abs=1e-4)
    with pytest.raises(ValueError, match=r"'kick' .*-0\.506"):
        scheme(printed)
    assert scheme(mended).order == 4
    fractions = [[stage.fraction for stage in s.stages] for s in (scheme(mended), SIER4)]
    assert np.allclose(*fractions, rtol=1e-15)


def printed_condition(l, I):
    """2 E > Iy L^2, as printed."""
    return (l * l / I).sum(axis=0) > I[1] * (l * l).sum(axis=0)


def test_misprint_in_the_condition(rng):
    """The printed condition depends on the unit of mass, while the motion does not."""
    l, I = rng.normal(size=(3, 200)), MOMENTS[:, None]
    gram = [printed_condition(l * unit, I * unit) for unit in (1e-3, 1.0, 1e3)]
    assert gram[0].all()
    assert gram[1].any()
    assert not gram[2].any()
    mended = [I[1] * unit * (l * l / I).sum(axis=0) * unit > (l * l).sum(axis=0) * unit**2 for unit in (1e-3, 1.0, 1e3)]
    assert np.array_equal(mended[0], mended[1])
    assert np.array_equal(mended[1], mended[2])
