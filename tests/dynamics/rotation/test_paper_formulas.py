"""The paper's formulas as it prints them, with its misprints mended, against the package; and each misprint's failure.

Source: van Zon and Schofield (2007).
"""

import numpy as np
import pytest

from openmm_sier import SIER4, Scheme
from openmm_sier.dynamics import rotation
from openmm_sier.dynamics.schemes import DRIFT, KICK
from tests.support import oracles
from tests.support.oracles import (
    R1,
    apply,
    in_paper_frame,
    matmul,
    orthogonality_error,
    paper_propagator,
    psi_by_hermite,
    random_attitudes,
)

MOMENTS = np.array([0.6, 1.1, 1.7])


def states(rng, n):
    """Attitudes, angular momenta of size 2 and moments in any order."""
    order = np.argsort(rng.random((3, n)), axis=0)
    L = rng.normal(size=(3, n))
    return random_attitudes(rng, n), 2 * L / np.linalg.norm(L, axis=0), MOMENTS[order]


def by_the_paper(A, L, moments, h, terms):
    """A after the time h by Eqs. Pmatrix and psiapprox; L~* comes from the integrated Euler equations."""
    U, l, I = in_paper_frame(apply(A, L), moments)
    final = apply(U, oracles.rotation_by_taylor(A, L, moments, h)[1])
    psi = np.array([psi_by_hermite(l[:, i], final[:, i], I[:, i], h, terms) for i in range(l.shape[1])])
    return matmul(U.transpose(1, 0, 2), matmul(paper_propagator(l, final, psi), matmul(U, A)))


@pytest.mark.slow
def test_propagator(rng):
    """P(h) = R1(L~*) R2(psi) R1(L~)^T for every order of the moments and both cases of Iy, either way in time."""
    A, L, moments = states(rng, 500)
    for h in (0.1, -0.1):
        expected = by_the_paper(A, L, moments, h, terms=7)
        # L_perp in the paper's frame is at least 0.28 |L|, so that R1 loses no more than a digit.
        assert np.abs(rotation.exact(A, L, moments, h)[0] - expected).max() < 2e-14


# --- misprints --------------------------------------------------------------------------------------------------------


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
    with pytest.raises(ValueError, match=r"fractions of 'kick' must sum to 1, they sum to -0\.506"):
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
