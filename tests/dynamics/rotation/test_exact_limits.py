"""What the exact propagator leaves out, and the ends of the range of its arguments."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from openmm_sier.dynamics import rotation
from openmm_sier.dynamics.kernels.elliptic import LONGEST
from tests.support import oracles
from tests.support.families import FAMILIES, asymmetric, linear, point, sample, spherical
from tests.support.matrices import representatives
from tests.support.oracles import ORTHOGONAL, apply, orthogonality_error, random_attitudes, worst

# --- truncation -------------------------------------------------------------------------------------------------------


def squared_phase(u, rates):
    """max(p, q) of `exact.euler_rates` at |L| h = 1, for rates in descending order."""
    (a, b, c), (x2, y2, z2) = rates, u * u
    return np.maximum(((a - c) * x2 + (b - c) * y2) * (a - b), ((a - b) * y2 + (a - c) * z2) * (b - c))


def bodies_at(rng, n, phase, decades, dtype=float):
    """Descending rates over some decades, unit L~ and |L| h of bodies that nutate by a squared phase."""
    rates = np.sort(10 ** rng.uniform(0, decades, (3, n)), axis=0)[::-1].astype(dtype)
    u = rng.normal(size=(3, n)).astype(dtype) * 10 ** rng.uniform(0, decades / 2, (3, n))
    u /= np.sqrt((u * u).sum(axis=0))
    return rates, u, np.sqrt(phase / squared_phase(u, rates))


@pytest.mark.parametrize("factor", representatives([1 - 1e-9, 1 + 1e-9, 4.0], 1 - 1e-9))
def test_rounding_is_the_only_error_at_the_limit(rng, factor):
    """Just below it, where truncation is worst, and above, where compositions take over."""
    rates, u, k = bodies_at(rng, 250, LONGEST * factor, decades=1)
    A, moments = random_attitudes(rng, 250), 1 / rates
    L = np.einsum("abn,an->bn", A, u * k)
    expected, _ = oracles.rotation_by_taylor(A, L, moments, 1.0, dtype=np.longdouble, order=20)
    # Rounding of A L turns the body by up to 2e-16 of its fastest angle; some ten operations follow.
    scale = np.maximum(1, k * rates[0])
    assert worst(rotation.exact(A, L, moments, 1.0)[0] - expected, scale) < 2e-15


# --- ends of the range ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("least", "most"), representatives([(-300, -20), (1, 6), (6, 15), (15, 100)], (-300, -20)))
def test_any_angle_gives_a_rotation(rng, least, most):
    """Steps far beyond any accuracy: finite, orthogonal and, as long as a period is resolved, the same energy."""
    A, L, moments, _ = sample(rng, list(FAMILIES), 200, 1.0, least=10.0**least, most=10.0**most, growth=np.inf)
    scale = 10.0 ** rng.uniform(-15, 15)
    L, moments = L * scale, moments * scale
    new, new_L = rotation.exact(A, L, moments, 1.0)
    assert np.isfinite(new).all()
    assert orthogonality_error(new) < ORTHOGONAL
    assert np.array_equal(new_L, L)
    if most <= 15:
        rates = oracles.rates_of(moments)
        size = np.maximum(np.linalg.norm(L, axis=0), 1e-300)
        before, after = ((rates * (apply(B, L) / size) ** 2).sum(axis=0) for B in (A, new))
        # A thousand sub-steps, each with the rounding of L~ times the largest rate.
        assert (np.abs(after - before) <= 1e-13 * rates.max(axis=0)).all()


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("angle", representatives([1.0, -1e3, 1e5], -1e3))
def test_uniform_rotation_lasts(axis, angle):
    """A body that turns exactly about a principal axis continues, about the unstable one (here the second) too."""
    moments, direction = np.array([0.6, 1.1, 1.7]), np.eye(3)[axis]
    new, _ = rotation.exact(np.eye(3)[:, :, None], direction[:, None], moments, angle * moments[axis])
    expected = Rotation.from_rotvec(-angle * direction).as_matrix()
    # The angle, a product of three numbers, is rounded.
    assert np.abs(new[:, :, 0] - expected).max() < 1e-15 * max(1, abs(angle))


def test_no_scale_is_preferred(rng):
    """Scaling |L| against h or against the moments over 600 orders of magnitude changes nothing but rounding."""
    A, L, moments = random_attitudes(rng, 50), rng.normal(size=(3, 50)), asymmetric(rng, 50)
    expected = rotation.exact(A, L, moments, 0.9)[0]
    for exponent in (-290, -200, -100, -15, 15, 100, 200, 290):
        scale = 10.0**exponent
        assert np.abs(rotation.exact(A, L * scale, moments, 0.9 / scale)[0] - expected).max() < 1e-13
        assert np.abs(rotation.exact(A, L * scale, moments * scale, 0.9)[0] - expected).max() < 1e-13


@pytest.mark.parametrize(
    ("size", "h"),
    representatives([(1e300, -1e300), (1e-300, 1e300), (1e300, 1e-300), (1e-300, 0.0)], (1e300, -1e300), (1e-300, 0.0)),
)
def test_the_largest_and_smallest_numbers(rng, size, h):
    A, L = random_attitudes(rng, 80), size * rng.uniform(-1, 1, (3, 80))
    moments = np.concatenate([bodies(rng, 20) for bodies in (asymmetric, spherical, linear, point)], axis=1)
    new, _ = rotation.exact(A, L, moments, h)
    assert np.isfinite(new).all()
    assert orthogonality_error(new) < ORTHOGONAL
