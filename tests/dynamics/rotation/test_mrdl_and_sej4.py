"""MRDL and SEJ4 against matrix exponentials and integrated equations of motion."""

import numpy as np
import pytest
from scipy.linalg import expm

from openmm_sier.dynamics import rotation
from tests.support.oracles import apply, matmul, random_attitudes, rotation_by_taylor, skew

MAPS = (rotation.mrdl, rotation.sej4)
WATER = np.array([0.0061457, 0.0115511, 0.0176968])


def gas(rng, n, moments=WATER, energy=2.5):
    """Attitudes and angular momenta of bodies with this mean energy per degree of freedom, as of water at 300 K."""
    A = random_attitudes(rng, n)
    body_L = rng.normal(size=(3, n)) * np.sqrt(energy * moments)[:, None]
    return A, apply(A.transpose(1, 0, 2), body_L)


def columns(moments, n):
    return np.repeat(np.asarray(moments)[:, None], n, axis=1)


ORDERS = ([0, 1, 2], [1, 2, 0], [0, 2, 1])


@pytest.mark.parametrize("order", ORDERS)
def test_mrdl_is_the_product_of_rotations_about_the_axes(rng, order):
    """Five matrix exponentials in the order x y z y x of ascending moments, each with L~ as the one before left it."""
    moments = WATER[order]
    smallest, middle, largest = np.argsort(moments)
    A, L = gas(rng, 20, moments)
    h = 0.008
    new, new_L = rotation.mrdl(A, L, moments, h)
    assert np.array_equal(new_L, L)
    for i in range(A.shape[2]):
        expected = A[:, :, i]
        for axis, fraction in ((smallest, 0.5), (middle, 0.5), (largest, 1), (middle, 0.5), (smallest, 0.5)):
            angle = fraction * h * (expected @ L[:, i])[axis] / moments[axis]
            expected = expm(-skew(angle * np.eye(3)[axis])) @ expected
        # Five products of matrices of order 1.
        assert np.abs(new[:, :, i] - expected).max() < 5e-15


@pytest.mark.parametrize(("h", "order"), list(zip([-0.0017, 0.008, 0.4], ORDERS, strict=True)))
def test_sej4_is_the_magnus_step(rng, h, order):
    """exp(-[Omega]) A with the angular velocities of the integrated Euler equations at the Gauss points."""
    moments = columns(WATER[order], 20)
    A, L = gas(rng, 20, WATER[order])
    new_A, new_L = rotation.sej4(A, L, moments, h)
    at = [rotation_by_taylor(A, L, moments, t * h)[1] for t in (0.5 - 3**0.5 / 6, 0.5 + 3**0.5 / 6, 1)]
    w1, w2 = at[0] / moments, at[1] / moments
    omega = 0.5 * h * (w1 + w2) + 3**0.5 / 12 * h * h * np.cross(w1, w2, axis=0)
    P = np.stack([expm(-skew(omega[:, i])) for i in range(20)], axis=2)
    expected = matmul(P, A)
    # Rounding of the oracle, and of an argument of the sine of up to some 20.
    tolerance = 1e-13 * max(1, abs(h) * 50)
    assert np.abs(new_A - expected).max() < tolerance
    assert np.abs(new_L - apply(expected.transpose(1, 0, 2), at[2])).max() < tolerance


@pytest.mark.parametrize("moments", [(0, 1, 1), (1, 0, 1), (1, 1, 0), (0, 0, 0)])
@pytest.mark.parametrize("turned", MAPS)
def test_lines_and_points_turn_exactly(rng, turned, moments):
    """With one moment there is nothing to split and no commutator. L of a line is perpendicular to it, of a point 0."""
    moments = np.array(moments, dtype=float)
    A, L = gas(rng, 10, moments, 1.0)
    exact, _ = rotation.exact(A, L, moments, 0.3)
    new, l = turned(A, L, moments, 0.3)
    assert np.abs(new - exact).max() < 1e-15
    # Rounding, of the size of L itself.
    assert np.abs(l - L).max() <= 1e-15 * np.abs(L).max()
    # A line stays perpendicular to its L.
    assert np.abs(apply(new, l)[moments == 0]).max() < 1e-15


@pytest.mark.parametrize("turned", MAPS)
def test_mixture(rng, turned):
    """Bodies of all kinds in one call go as they go alone."""
    kinds = [WATER, WATER[::-1], np.array([0, 1, 1.0]), np.array([1, 1, 0.0]), np.zeros(3), np.ones(3)]
    states = [gas(rng, 5, moments, 1.0) for moments in kinds]
    A, L = (np.concatenate(parts, axis=-1) for parts in zip(*states, strict=True))
    moments = np.concatenate([columns(m, 5) for m in kinds], axis=1)
    new, l = turned(A, L, moments, 0.02)
    for i, (kind, state) in enumerate(zip(kinds, states, strict=True)):
        alone = turned(*state, kind, 0.02)
        assert np.abs(new[:, :, 5 * i : 5 * i + 5] - alone[0]).max() < 1e-14
        assert np.abs(l[:, 5 * i : 5 * i + 5] - alone[1]).max() < 1e-14


@pytest.mark.parametrize("turned", MAPS)
@pytest.mark.parametrize("scale", [0.0, 1e-200, 1e30])
def test_any_size_of_the_angular_momentum(rng, turned, scale):
    """A body at rest stays, and h L is what matters: slow bodies over long times go as fast ones over short times."""
    A, L = gas(rng, 10)
    expected = turned(A, L, WATER, 0.008)[0] if scale else A
    h = 0.008 / scale if scale else 0.008
    assert np.abs(turned(A, scale * L, WATER, h)[0] - expected).max() < 1e-14


@pytest.mark.parametrize("turned", MAPS)
def test_arguments(rng, turned):
    A, L = gas(rng, 4)
    before = A.copy(), L.copy()
    turned(A, L, WATER, 0.008)
    assert np.array_equal(A, before[0])
    assert np.array_equal(L, before[1])
    none = turned(A[:, :, :0], L[:, :0], WATER, 0.1)
    assert none[0].shape == (3, 3, 0)
    assert none[1].shape == (3, 0)
    with pytest.raises(ValueError, match="body 2"):
        turned(A, np.where(np.arange(4) == 2, np.nan, L), WATER, 0.1)
