"""The exact propagator against independent solutions, over every kind of body and state."""

import numpy as np
import pytest

from openmm_sier.dynamics import rotation
from tests.support import oracles
from tests.support.families import FAMILIES, STATES, sample, unit
from tests.support.matrices import representatives
from tests.support.oracles import ORTHOGONAL, apply, orthogonality_error, random_attitudes, worst

# In double precision A L carries some 2e-16 |L|. That grows by at most exp(5) = 150 next to the separatrix (`growth` in
# `sample`) and turns a thin body, whose moments span three decades, up to 1000 times further than others. So 1e-12 is
# what any algorithm in double precision can promise over all families; away from these two the errors are near 1e-15.
ERROR = 1e-12
RETURN = 1e-13


def times(rng, count):
    """Times of alternating sign and any magnitude."""
    return [float((-1) ** i * 10 ** rng.uniform(-9, 9)) for i in range(count)]


def check(A, L, moments, angle, h):
    """No NaN, the right rotation, an orthogonal matrix, and the L at the start."""
    new, new_L = rotation.exact(A, L, moments, h)
    expected, body_L = oracles.rotation_by_taylor(A, L, np.broadcast_to(moments.reshape(3, -1), L.shape), h)
    assert np.isfinite(new).all()
    assert worst(new - expected, angle) < ERROR
    assert orthogonality_error(new) < ORTHOGONAL
    assert np.array_equal(new_L, L)
    # The lab frame's L, recovered from what Euler's equations alone say of L~, is the one at the start.
    recovered = np.einsum("abn,an->bn", new, body_L)
    assert (np.abs(recovered - L) <= ERROR * np.linalg.norm(L, axis=0) * np.maximum(1, angle)).all()


# --- accuracy ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("families", representatives([*FAMILIES, "all families"], "all families"))
def test_many_bodies_of_each_family(rng, families):
    """Each body has its own moments."""
    families = list(FAMILIES) if families == "all families" else [families]
    for h in times(rng, 6):
        A, L, moments, angle = sample(rng, families, 2000 if len(families) > 1 else 1000, h)
        check(A, L, moments, angle, h)


def test_bodies_that_share_their_moments(rng):
    for h in times(rng, 6):
        A, L, moments, angle = sample(rng, STATES, 100 * len(STATES), h, alike=True)
        check(A, L, moments[:, 0], angle, h)


@pytest.mark.parametrize("family", FAMILIES)
def test_backwards_and_in_parts(rng, family):
    for i, h in enumerate(times(rng, 4)):
        A, L, moments, angle = sample(rng, [family], 500, h, growth=4.0, alike=i < 3)
        moments = moments[:, 0] if i < 3 else moments
        there = rotation.exact(A, L, moments, h)[0]
        back = rotation.exact(there, L, moments, -h)[0]
        assert worst(back - A, angle) < RETURN
        first = float(rng.uniform(0, 1)) * h
        parts = rotation.exact(rotation.exact(A, L, moments, first)[0], L, moments, h - first)[0]
        assert worst(parts - there, angle) < RETURN


def test_bodies_of_all_families_in_one_call(rng):
    """What one body needs (long steps, rescaled momenta, symmetry) does not disturb its neighbours."""
    A, L, moments, _ = sample(rng, list(FAMILIES), 20_000, 0.37)
    new = rotation.exact(A, L, moments, 0.37)[0]
    alone = np.concatenate(
        [rotation.exact(A[:, :, [i]], L[:, [i]], moments[:, [i]], 0.37)[0] for i in range(200)], axis=2
    )
    assert np.array_equal(alone, new[:, :, :200])


@pytest.mark.parametrize("most", [10.0, 1e3, 1e6])
def test_long_steps_match_elliptic_functions(rng, most):
    """Whole periods of the nutation, for 10^5 asymmetric bodies in all, against SciPy's ellipj, R_F and R_J."""
    A, L, moments, angle = sample(rng, ["asymmetric"], 34_000, 2.5, least=1e-3, most=most, growth=np.inf)
    l = unit(apply(A, L))
    order = np.argsort(moments, axis=0)
    x, y, z = np.take_along_axis(l, order, axis=0)
    a, b, c = 1 / np.take_along_axis(moments, order, axis=0)
    # The closed form loses digits near the separatrix and for symmetric bodies, the propagator does not.
    p, q = ((a - c) * x * x + (b - c) * y * y) * (a - b), ((a - b) * y * y + (a - c) * z * z) * (b - c)
    good = (np.abs(p - q) > 0.05 * np.maximum(p, q)) & (np.minimum(a - b, b - c) > 0.02 * a)
    good &= np.minimum(np.abs(x), np.abs(z)) > 1e-2
    assert np.count_nonzero(good) > 25_000
    A, L, moments, angle = A[:, :, good], L[:, good], moments[:, good], angle[good]
    expected = oracles.closed_form_rotation(A, L, moments, 2.5)
    assert worst(rotation.exact(A, L, moments, 2.5)[0] - expected, angle) < ERROR


# --- interface --------------------------------------------------------------------------------------------------------


def test_inputs_are_left_alone(rng):
    A, L, moments, _ = sample(rng, list(FAMILIES), 300, 0.4)
    copies = A.copy(), L.copy(), moments.copy()
    new, new_L = rotation.exact(A, L, moments, 0.4)
    assert all(np.array_equal(array, copy) for array, copy in zip((A, L, moments), copies, strict=True))
    assert not np.shares_memory(new_L, L)
    assert not np.shares_memory(new, A)


def test_any_memory_layout_and_no_bodies(rng):
    A, L = random_attitudes(rng, 60), rng.normal(size=(3, 60))
    expected = rotation.exact(A, L, (0.6, 1.1, 1.7), 0.4)[0]
    apart = np.asfortranarray(A), np.asfortranarray(L)
    assert np.abs(rotation.exact(*apart, [0.6, 1.1, 1.7], 0.4)[0] - expected).max() < 1e-15
    half = rotation.exact(A[:, :, ::2], L[:, ::2], (0.6, 1.1, 1.7), 0.4)[0]
    assert np.abs(half - expected[:, :, ::2]).max() < 1e-15
    new, new_L = rotation.exact(np.empty((3, 3, 0)), np.empty((3, 0)), (1.0, 2.0, 3.0), 0.1)
    assert new.shape == (3, 3, 0)
    assert new_L.shape == (3, 0)


A_2, L_2 = np.repeat(np.eye(3)[:, :, None], 2, axis=2), np.ones((3, 2))
NOT_FINITE = np.array([[1.0, 1.0], [1.0, np.nan], [1.0, 1.0]])


@pytest.mark.parametrize(
    ("A", "L", "moments", "h", "message"),
    [
        (A_2[:, :, 0], L_2, (1, 2, 3), 0.1, r"A must have shape \(3, 3, n\).*got \(3, 3\)"),
        (A_2, L_2.T, (1, 2, 3), 0.1, r"L \(3, n\), got .* \(2, 3\)"),
        (A_2, L_2[:, :1], (1, 2, 3), 0.1, r"got \(3, 3, 2\) and \(3, 1\)"),
        (A_2, L_2, (1, 2), 0.1, r"moments must have shape \(3,\) or \(3, n\), got \(2,\)"),
        (A_2, L_2, np.ones((3, 5)), 0.1, "moments are given for 5 bodies, but A and L for 2"),
        (A_2, L_2, (1, -2, 3), 0.1, r"moments must be finite and not negative, got -2\.0"),
        (A_2, L_2, [[1, 1], [1, 1], [1, np.inf]], 0.1, "got inf for body 1"),
        (A_2, L_2, (0, 1, 2), 0.1, "one zero moment is linear and its other two must be equal"),
        (A_2, L_2, (0, 0, 2), 0.1, "one zero moment is linear and its other two must be equal"),
        (A_2, L_2, (1, 2, 3), np.nan, "h must be finite, got nan"),
        (A_2, NOT_FINITE, (1, 2, 3), 0.1, "angular momentum of body 1 is not finite"),
    ],
)
def test_errors_name_what_is_wrong(A, L, moments, h, message):
    with pytest.raises(ValueError, match=message):
        rotation.exact(A, L, moments, h)


def test_the_body_named_is_the_callers(rng):
    L = np.ones((3, 5_000))
    L[1, 4_321] = np.nan
    with pytest.raises(ValueError, match="body 4321 "):
        rotation.exact(random_attitudes(rng, 5_000), L, (1, 2, 3), 0.1)
