"""Every kind of top in every kind of state, at random."""

import numpy as np

from tests.support.oracles import random_attitudes, rates_of


def unit(v):
    return v / np.linalg.norm(v, axis=0)


def signs(rng, shape):
    return rng.choice([-1.0, 1.0], shape)


def asymmetric(rng, n):
    return np.exp(rng.normal(scale=0.5, size=(3, n)))


def thin(rng, n):
    return 10 ** rng.uniform(-3, 0, (3, n))


def prolate(rng, n):
    small, large = np.sort(asymmetric(rng, n)[:2], axis=0)
    return np.stack([small, large, large])


def oblate(rng, n):
    small, large = np.sort(asymmetric(rng, n)[:2], axis=0)
    return np.stack([small, small, large])


def spherical(rng, n):
    return np.repeat(asymmetric(rng, n)[:1], 3, axis=0)


def linear(rng, n):
    return spherical(rng, n) * np.array([[1.0], [1.0], [0.0]])


def point(rng, n):
    return np.zeros((3, n))


def split(rng, n):
    """Relative splittings of 1e-16 to 1e-4, of which the smallest are lost in rounding."""
    return 1 + signs(rng, n) * 10 ** rng.uniform(-16, -4, n)


def near_symmetric(rng, n):
    moments = asymmetric(rng, n)
    moments[1] = moments[0] * split(rng, n)
    return moments


def near_spherical(rng, n):
    moments = spherical(rng, n)
    moments[1:] *= [split(rng, n), split(rng, n)]
    return moments


def anywhere(rng, moments):
    return unit(rng.normal(size=moments.shape))


def across(rng, moments):
    """No angular momentum about the axis of a line, the last axis."""
    return unit(rng.normal(size=moments.shape) * np.array([[1.0], [1.0], [0.0]]))


def at_rest(rng, moments):
    return np.zeros_like(moments)


def on_an_axis(rng, moments):
    return np.eye(3)[rng.integers(0, 3, moments.shape[1])].T * signs(rng, moments.shape[1])


def near_an_axis(rng, moments):
    off = signs(rng, moments.shape) * 10 ** rng.uniform(-300, -3, moments.shape) * rng.integers(0, 2, moments.shape)
    axis = on_an_axis(rng, moments)
    return np.where(axis != 0, axis, off)


def in_a_plane(rng, moments):
    return unit(anywhere(rng, moments) * (on_an_axis(rng, moments) == 0))


def on_the_separatrix(rng, moments, off=0.0):
    """2 E Iy = L^2 to rounding, at any phase, half of the states within 1e-16 to 1 of the middle axis."""
    n = moments.shape[1]
    order = np.argsort(moments, axis=0)
    a, b, c = 1 / np.take_along_axis(moments, order, axis=0)
    from_axis = np.where(rng.random(n) < 0.5, 10 ** rng.uniform(-16, 0, n), rng.uniform(0, 1, n))
    angle = np.arctan2(np.sqrt(b - c), np.sqrt(a - b))
    ring = np.sqrt(from_axis * (2 - from_axis)) * np.stack([np.sin(angle) * (1 + off), np.cos(angle)])
    u = np.empty_like(moments)
    np.put_along_axis(u, order, signs(rng, (3, n)) * np.stack([ring[0], 1 - from_axis, ring[1]]), axis=0)
    return unit(u)


def near_the_separatrix(rng, moments):
    n = moments.shape[1]
    return on_the_separatrix(rng, moments, signs(rng, n) * 10 ** rng.uniform(-17, -2, n))


FAMILIES = {
    "asymmetric": (asymmetric, anywhere),
    "thin": (thin, anywhere),
    "prolate": (prolate, anywhere),
    "oblate": (oblate, anywhere),
    "spherical": (spherical, anywhere),
    "linear": (linear, across),
    "point": (point, anywhere),
    "at rest": (asymmetric, at_rest),
    "on an axis": (asymmetric, on_an_axis),
    "near an axis": (asymmetric, near_an_axis),
    "in a plane": (asymmetric, in_a_plane),
    "separatrix": (asymmetric, on_the_separatrix),
    "near the separatrix": (asymmetric, near_the_separatrix),
    "near-symmetric": (near_symmetric, anywhere),
    "near-symmetric near an axis": (near_symmetric, near_an_axis),
    "near-symmetric near the separatrix": (near_symmetric, near_the_separatrix),
    "near-spherical": (near_spherical, anywhere),
    "near-spherical near an axis": (near_spherical, near_an_axis),
    "near-spherical near the separatrix": (near_spherical, near_the_separatrix),
    "prolate on an axis": (prolate, on_an_axis),
}

#: The families of asymmetric bodies, which differ in their states.
STATES = [family for family, (bodies, _) in FAMILIES.items() if bodies is asymmetric]


def instability(moments, k):
    """Phase by which motion along the middle axis runs away from it: rounding of the input grows by its exponential."""
    a, b, c = np.sort(rates_of(moments), axis=0)[::-1]
    return np.abs(k) * np.sqrt((a - b) * (b - c))


def sample(rng, families, n, h, least=1e-6, most=10.0, growth=5.0, alike=False):
    """Bodies of the families, at random: A, L, moments and the angle that each turns in the time h.

    The angle turned is log-uniform from `least` to `most`, except that `instability` is at most `growth`; the principal
    axes come in any order; the moments, and |L| with them, range over 30 orders of magnitude. Bodies that are to be
    `alike` share one set of moments, of the first family.
    """
    moments, u = np.empty((3, n)), np.empty((3, n))
    model = FAMILIES[families[0]][0](rng, 1)
    which = rng.integers(0, len(families), n)
    for i, family in enumerate(families):
        bodies, states = FAMILIES[family]
        chosen = which == i
        moments[:, chosen] = model if alike else bodies(rng, np.count_nonzero(chosen))
        u[:, chosen] = states(rng, moments[:, chosen])
    order = np.argsort(rng.random((3, 1 if alike else n)), axis=0)
    moments, u = (np.take_along_axis(v, np.broadcast_to(order, (3, n)), axis=0) for v in (moments, u))

    speed = np.linalg.norm(u * rates_of(moments), axis=0)
    angle = 10 ** rng.uniform(np.log10(least), np.log10(most), n)
    k = np.divide(angle, speed, out=np.ones(n), where=speed > 0)
    k *= np.minimum(1, growth / np.maximum(instability(moments, k), 1e-300))
    scale = 10 ** rng.uniform(-15, 15, 1 if alike else n)
    A = random_attitudes(rng, n)
    L = np.einsum("abn,an->bn", A, u * (k * scale / abs(h)))
    return A, L, moments * scale, k * speed
