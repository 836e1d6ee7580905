"""Viscosity and diffusion from series whose answers are known."""

import math

import numpy as np
import pytest
from scipy.integrate import trapezoid

from openmm_sier.analysis import transport
from openmm_sier.analysis.statistics import Estimate
from tests.support.series import stresses


def agrees(estimate, expected, errors=4):
    """Whether an estimate is within so many of its errors; four are passed by one of 16000 right ones."""
    return abs(estimate.value - expected) < errors * estimate.error


def test_diffusion_of_brownian_motion():
    rng, D, interval = np.random.default_rng(5), 2.3e-3, 0.2
    steps = rng.normal(scale=math.sqrt(2 * D * interval), size=(30, 200, 60, 3))
    diffusions = [transport.self_diffusion(run.cumsum(axis=0), interval) for run in steps]
    values, errors, _ = np.array(diffusions).T
    # 30 runs scatter by the error that each tells of itself, to 13 % by chance and as much again by its estimate.
    assert errors.mean() == pytest.approx(values.std(ddof=1), rel=0.4)
    assert agrees(Estimate(values.mean(), errors.mean() / math.sqrt(30)), 2.3)
    # A cage that all molecules rattle in adds a constant to later displacements, and nothing to the slope.
    rattling = steps[0].cumsum(axis=0) + rng.normal(scale=0.05, size=steps[0].shape)
    assert agrees(transport.self_diffusion(rattling, interval), 2.3)


def test_diffusion_of_too_short_a_run_or_of_rare_frames():
    with pytest.raises(
        transport.TooShortError,
        match=r"15 ps, got 8 ps, .*got 0.2 ps",
    ):
        transport.self_diffusion(np.zeros((40, 3, 3)), 0.2)
    with pytest.raises(transport.TooShortError, match="1 ps apart, got 2 ps"):
        transport.self_diffusion(np.zeros((40, 3, 3)), 2.0)


def test_correction_for_the_size_of_the_box():
    # In SI, for 1 mPa s, 2.5 nm and 300 K.
    shift = 2.837297 * 1.380649e-23 * 300 / (6 * math.pi * 1e-3 * 2.5e-9)
    corrected = transport.without_finite_size(Estimate(2, 0.1), 300, 2.5, Estimate(1.0, 0.0))
    assert corrected[:2] == (pytest.approx(2 + shift * 1e9, rel=1e-6), 0.1)
    # An error of 10 % in the viscosity is one of 10 % in the correction.
    uncertain = transport.without_finite_size(Estimate(2.0, 0.03), 298.15, 2.5, Estimate(0.9, 0.09))
    assert uncertain.error == pytest.approx(math.hypot(0.03, 0.1 * (uncertain.value - 2.0)))


def test_viscosity_of_a_stress_that_decays_exponentially():
    interval, volume, T, keep = 0.02, 8.0, 300.0, 0.9
    rng = np.random.default_rng(9)
    # A pressure has nothing to do with shear.
    tensors = stresses(rng, 40000, keep) + rng.normal(3, 5, (40000, 1)) * [1, 1, 1, 0, 0, 0]
    # By trapezoids, with less than 1e-6 after 3 ps. 1 bar is 1e5 Pa: V/kT in 1/Pa times Pa² times s, in mPa s.
    area = interval * 1e-12 * (0.5 + keep / (1 - keep))
    expected = volume * 1e-27 / (1.380649e-23 * T) * 1e10 * area * 1e3
    viscosity = transport.shear_viscosity(tensors, interval, volume, T, last=3.0)
    assert agrees(viscosity, expected)
    # The error of an integral up to L of five components over a time t is sqrt(4 L/5 t).
    assert viscosity.error == pytest.approx(expected * math.sqrt(4 * 3 / 5 / 800), rel=0.4)
    # Where the correlation lasts longer than the integral goes, the viscosity is too low.
    early = transport.shear_viscosity(tensors, interval, volume, T, last=0.1)
    assert expected - early.value > 5 * early.error


def test_viscosity_is_that_of_all_pairs_of_times():
    tensors, (interval, volume, T), lags = stresses(np.random.default_rng(10), 60, 0.8), (0.02, 8.0, 300.0), 10
    viscosity = transport.shear_viscosity(tensors, interval, volume, T, last=0.2)
    xx, yy, zz, xy, xz, yz = tensors.T
    scale = volume * 1e-27 / (1.380649e-23 * T) * 1e10 * interval * 1e-12 * 1e3
    # Sum over all nine components of the traceless tensor is ten times that of one shear stress.
    mean = (xx + yy + zz) / 3
    squares = [xx - mean, yy - mean, zz - mean, *[xy, xz, yz] * 2]
    correlation = [
        np.mean([sum(s[i] * s[i + k] for s in squares) for i in range(60 - k)]) / 10 for k in range(lags + 1)
    ]
    assert viscosity.value == pytest.approx(scale * trapezoid(correlation), rel=1e-6)


def test_viscosity_needs_a_run():
    with pytest.raises(transport.TooShortError, match=r"10 ps, got 9\.98 ps"):
        transport.shear_viscosity(np.zeros((499, 6)), 0.02, 8.0, 300.0)
    with pytest.raises(transport.TooShortError, match=r"0\.03 ps apart, got 0\.04 ps"):
        transport.shear_viscosity(np.zeros((499, 6)), 0.04, 8.0, 300.0)


def walks(count):
    """Paths of particles with edges of boxes that change, in which they stay wrapped; also in a constant box."""
    rng = np.random.default_rng(7)
    edges = np.array([[2.0, 2.5, 3.0]]) * (1 + 0.001 * rng.normal(size=(50, 1)))
    true = rng.uniform(0, 2, (1, count, 3)) + rng.normal(scale=0.2, size=(50, count, 3)).cumsum(axis=0)
    return true, edges


@pytest.mark.parametrize("count", [1, 6])
def test_places_are_followed_through_faces(count):
    """Also that of one particle, whose motion is its own."""
    true, edges = walks(count)
    constant = np.repeat(edges[:1], 50, axis=0)
    result = transport.unwrapped(np.mod(true, constant[:, None]), constant)
    np.testing.assert_allclose(result - result[0], true - true[0], atol=1e-12)
    # Where the box changes, each step is still the one that was made: a wrap at the new edge is undone.
    moved = transport.unwrapped(np.mod(true, edges[:, None]), edges)
    assert np.abs(moved - moved[0] - true + true[0]).max() < 0.5


def test_the_motion_of_the_centre_of_mass_is_left_out():
    true, edges = walks(6)
    constant, masses = np.repeat(edges[:1], 50, axis=0), [16.0, 1.0, 1.0, 0.0, 30.0, 2.0]
    result = transport.unwrapped(np.mod(true, constant[:, None]), constant, masses)
    centres = np.average(true, axis=1, weights=masses)
    np.testing.assert_allclose(result - result[0], true - true[0] - (centres - centres[0])[:, None], atol=1e-12)
    for wrong in ([1.0], np.zeros(6)):
        with pytest.raises(ValueError, match=r"masses .* 6 particles"):
            transport.unwrapped(true, constant, wrong)
