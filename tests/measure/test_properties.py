"""Properties of liquids from series whose answers are known."""

import math

import numpy as np
import pytest
from openmm import unit
from scipy.integrate import trapezoid

from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.measure import properties
from openmm_sier.measure.statistics import Estimate
from tests.support.series import correlated, stresses


def agrees(estimate, expected, errors=4):
    """Whether an estimate is within so many of its errors; four are passed by one of 16000 right ones."""
    return abs(estimate.value - expected) < errors * estimate.error


def test_heat_capacity_of_oscillators():
    # The potential energy of 3 N classical oscillators is a gamma distribution: its heat capacity is 3 N R/2.
    rng, T, n = np.random.default_rng(2), 300.0, 50
    energy = rng.gamma(1.5 * n, GAS_CONSTANT * T, 20000)
    found = properties.heat_capacity(energy, T, n)
    assert agrees(found, 1.5e3 * GAS_CONSTANT)
    assert found.error < 0.03 * found.value


def test_dielectric_constant_of_free_dipoles():
    # Dipoles mu without interactions: epsilon - 1 = rho mu^2/(3 epsilon_0 kT), here in SI by openmm.unit.
    rng, n, T, V, mu = np.random.default_rng(3), 100, 300.0, 3.0, 0.049
    directions = rng.normal(size=(4000, n, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    found = properties.dielectric_constant(mu * directions.sum(axis=1), np.full(4000, V), T)
    charge = (1 * unit.elementary_charge).value_in_unit(unit.coulomb)
    kT = 1.380649e-23 * T
    expected = 1 + n / (V * 1e-27) * (mu * 1e-9 * charge) ** 2 / (3 * 8.8541878128e-12 * kT)
    assert agrees(found, expected)
    assert found.error < 0.05 * (expected - 1)


def test_error_of_the_dielectric_constant_of_short_runs():
    """Dipoles with a correlation time of 8 ps, in 200 runs of 60 ps with frames 0.5 ps apart."""
    dipoles = correlated(np.random.default_rng(7), 120, math.exp(-0.5 / 8), 200, 3)
    found = [properties.dielectric_constant(run, np.ones(120), 300) for run in dipoles.swapaxes(0, 1)]
    values, errors, _ = np.array(found).T
    # The scatter of 200 runs is known to 5 %; a run of eight correlation times tells its error to a fifth. An error by
    # the scatter of its parts, which are as long as the correlation time, is 0.65 of it.
    assert errors.mean() == pytest.approx(values.std(ddof=1), rel=0.25)


def test_vaporization():
    found = properties.vaporization_enthalpy(Estimate(-4000.0, 10.0), 300, 100)
    assert found[:2] == (pytest.approx(40 + 8.31446e-3 * 300), 0.1)


def test_mean_square_displacement_is_that_of_all_pairs():
    x = np.random.default_rng(4).normal(size=(7, 3, 3)).cumsum(axis=0)
    expected = [np.mean([((x[i + k] - x[i]) ** 2).sum(axis=1).mean() for i in range(7 - k)]) for k in range(7)]
    # Rounding of the transforms.
    np.testing.assert_allclose(properties.mean_square_displacements(x), expected, atol=1e-12)


def test_diffusion_of_brownian_motion():
    rng, D, interval = np.random.default_rng(5), 2.3e-3, 0.2
    steps = rng.normal(scale=math.sqrt(2 * D * interval), size=(30, 200, 60, 3))
    found = [properties.self_diffusion(run.cumsum(axis=0), interval) for run in steps]
    values, errors, _ = np.array(found).T
    # 30 runs scatter by the error that each tells of itself, to 13 % by chance and as much again by its estimate.
    assert errors.mean() == pytest.approx(values.std(ddof=1), rel=0.4)
    assert agrees(Estimate(values.mean(), errors.mean() / math.sqrt(30)), 2.3)
    # A cage that all molecules rattle in adds a constant to later displacements, and nothing to the slope.
    rattling = steps[0].cumsum(axis=0) + rng.normal(scale=0.05, size=steps[0].shape)
    assert agrees(properties.self_diffusion(rattling, interval), 2.3)


def test_diffusion_of_too_short_a_run_or_of_rare_frames():
    with pytest.raises(
        properties.TooShortError, match=r"more than 15 ps with frames 1 ps apart or less, got 8 ps .* 0.2 ps apart"
    ):
        properties.self_diffusion(np.zeros((40, 3, 3)), 0.2)
    with pytest.raises(properties.TooShortError, match=r"got 80 ps with frames 2 ps apart"):
        properties.self_diffusion(np.zeros((40, 3, 3)), 2.0)


def test_correction_for_the_size_of_the_box():
    # In SI, for 1 mPa s, 2.5 nm and 300 K.
    shift = 2.837297 * 1.380649e-23 * 300 / (6 * math.pi * 1e-3 * 2.5e-9)
    found = properties.without_finite_size(Estimate(2, 0.1), 300, 2.5, 1.0)
    assert found[:2] == (pytest.approx(2 + shift * 1e9, rel=1e-6), 0.1)
    # An error of 10 % in the viscosity is one of 10 % in the correction.
    uncertain = properties.without_finite_size(Estimate(2.0, 0.03), 298.15, 2.5, Estimate(0.9, 0.09))
    assert uncertain.value == properties.without_finite_size(Estimate(2.0, 0.03), 298.15, 2.5, 0.9).value
    assert uncertain.error == pytest.approx(math.hypot(0.03, 0.1 * (uncertain.value - 2.0)))


def test_viscosity_of_a_stress_that_decays_exponentially():
    interval, volume, T, keep = 0.02, 8.0, 300.0, 0.9
    rng = np.random.default_rng(9)
    # A pressure has nothing to do with shear.
    tensors = stresses(rng, 40000, keep) + rng.normal(3, 5, (40000, 1)) * [1, 1, 1, 0, 0, 0]
    # By trapezoids, with less than 1e-6 after 3 ps. 1 bar is 1e5 Pa: V/kT in 1/Pa times Pa² times s, in mPa s.
    area = interval * 1e-12 * (0.5 + keep / (1 - keep))
    expected = volume * 1e-27 / (1.380649e-23 * T) * 1e10 * area * 1e3
    found = properties.shear_viscosity(tensors, interval, volume, T, last=3.0)
    assert agrees(found, expected)
    # The error of an integral up to L of five components over a time t is sqrt(4 L/5 t).
    assert found.error == pytest.approx(expected * math.sqrt(4 * 3 / 5 / 800), rel=0.4)
    tail = properties.viscosity_tail(tensors, interval, volume, T, last=3.0)
    assert agrees(tail, 0)
    early = properties.viscosity_tail(tensors, interval, volume, T, last=0.4)
    assert early.value > 5 * early.error


def test_viscosity_integrals_are_those_of_all_pairs_of_times():
    tensors, (interval, volume, T), lags = stresses(np.random.default_rng(10), 60, 0.8), (0.02, 8.0, 300.0), 10
    found = properties.viscosity_integrals(tensors, interval, volume, T, last=0.2)
    xx, yy, zz, xy, xz, yz = tensors.T
    scale = volume * 1e-27 / (1.380649e-23 * T) * 1e10 * interval * 1e-12 * 1e3
    # Sum over all nine components of the traceless tensor is ten times that of one shear stress.
    mean = (xx + yy + zz) / 3
    squares = [xx - mean, yy - mean, zz - mean, *[xy, xz, yz] * 2]
    correlation = [
        np.mean([sum(s[i] * s[i + k] for s in squares) for i in range(60 - k)]) / 10 for k in range(lags + 1)
    ]
    expected = [scale * trapezoid(correlation[: k + 1]) for k in range(lags + 1)]
    np.testing.assert_allclose(found.mean(axis=0), expected, rtol=1e-6, atol=1e-9 * scale)


def test_viscosity_needs_a_run():
    with pytest.raises(properties.TooShortError, match=r"viscosity needs a run of 10 ps or more.* got 9\.98 ps"):
        properties.shear_viscosity(np.zeros((499, 6)), 0.02, 8.0, 300.0)
    with pytest.raises(properties.TooShortError, match=r"0\.03 ps apart or less, got 0\.04 ps"):
        properties.shear_viscosity(np.zeros((499, 6)), 0.04, 8.0, 300.0)


def test_orientations_of_a_random_walk_on_the_sphere():
    # Small rotations about random axes: <P2> decays as exp(-6 D t), with D = step^2/4 a frame for two angles.
    rng, step, n, m = np.random.default_rng(6), 0.15, 3000, 40
    u = np.zeros((n, m, 3))
    u[0, :, 2] = 1
    for i in range(1, n):
        push = rng.normal(scale=step / math.sqrt(2), size=(m, 3))
        push -= (push * u[i - 1]).sum(axis=1, keepdims=True) * u[i - 1]
        u[i] = u[i - 1] + push
        u[i] /= np.linalg.norm(u[i], axis=1, keepdims=True)
    found = properties.rotation_time(u, 0.05)
    # Normalizing shortens steps by a part of step^2, 2 %; the tail leaves a part of its 10 %.
    assert found.value == pytest.approx(0.05 / (6 * step**2 / 4), abs=4 * found.error + 0.03 * found.value)
    direct = [np.mean(1.5 * (u[: n - k] * u[k:]).sum(axis=2) ** 2 - 0.5) for k in range(4)]
    np.testing.assert_allclose(properties.orientation_correlation(u, 3), direct, atol=1e-12)
    with pytest.raises(properties.TooShortError, match="must lose their correlation"):
        properties.rotation_time(u[:80], 0.05)


def test_rotational_time_of_short_runs():
    """60 runs of few molecules, in which <P2> ends in noise that may be negative, and has no logarithm.

    Orientations are drawn anew with a probability of 0.4 in each frame, so that <P2> is 0.6^t exactly.
    """
    rng, found = np.random.default_rng(11), []
    for _ in range(60):
        u = rng.normal(size=(300, 4, 3))
        u /= np.linalg.norm(u, axis=2, keepdims=True)
        for i in np.arange(1, 300):
            kept = rng.random(4) > 0.4
            u[i, kept] = u[i - 1, kept]
        found.append(properties.rotation_time(u, 1.0))
    values, errors, _ = np.array(found).T
    # 1/2 + 0.6/0.4 by trapezoids. The values scatter by 8 %, and by a root of 60 less in the mean.
    assert values.mean() == pytest.approx(2.0, rel=0.04)
    # The scatter of 60 values is known to 9 %, the mean of errors of eight parts to 3 %.
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(values.std(ddof=1), rel=0.35)
    with pytest.raises(properties.TooShortError, match="must lose their correlation within 2 ps"):
        properties.rotation_time(u[:32], 1.0)


def water_like(distances):
    """A pair distribution as steep on both sides of its first maximum as that of water."""
    first = 3.0 * np.exp(-0.5 * (np.log(np.maximum(distances - 0.248, 1e-9) / 0.0295) / 0.43) ** 2)
    return first + 0.8 / (1 + np.exp((0.31 - distances) / 0.008))


def test_the_maximum_of_a_pair_distribution_is_not_that_of_its_noise():
    """40 runs of 20 frames of 512 molecules, with pairs drawn at random."""
    rng, distances = np.random.default_rng(12), np.arange(0.001, 1.0, 0.002)
    fine = np.linspace(0.25, 0.3, 50_001)
    height, place = water_like(fine).max(), fine[water_like(fine).argmax()]
    ideal = 0.5 * 512 * 33.4 * 4 * np.pi * distances**2 * 0.002
    drawn = rng.poisson(water_like(distances) * ideal, (40, 20, len(distances))) / ideal
    found = np.array([properties.maximum_of_pairs(distances, run) for run in drawn])
    # The highest bin is too high by 0.06; the fit may be off by a hundredth and by half of a thousandth of a nm.
    highest = drawn.mean(axis=1).max(axis=1).mean()
    assert highest > height + 0.04
    assert found[:, 0, 0].mean() == pytest.approx(height, abs=0.012)
    assert found[:, 1, 0].mean() == pytest.approx(place, abs=5e-4)
    for values, errors in zip(found[..., 0].T, found[..., 1].T, strict=True):
        # The scatter of 40 values is known to 11 %, the mean of errors of eight parts to 4 %.
        assert np.sqrt(np.mean(errors**2)) == pytest.approx(values.std(ddof=1), rel=0.4)
        # 65 % with seven degrees of freedom, to 8 % by chance.
        assert np.mean(np.abs(values - values.mean()) < errors) == pytest.approx(0.65, abs=0.25)
    assert math.isnan(properties.maximum_of_pairs(distances, drawn[0, :1])[0].error)
    assert math.isnan(properties.maximum_of_pairs(distances, np.tile(distances, (20, 1)))[0].value)
