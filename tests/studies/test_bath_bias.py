"""The law of the bias in a heat bath, and what its study computes of small liquids."""

import math

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp

from studies.bath_bias import kernels, law, liquids

MOMENTS = np.array([0.0152, 0.0458, 0.061])

#: Of a body that is not flat.
UNEVEN = np.array([0.02, 0.04, 0.05])


def test_a_harmonic_mode_has_no_bias_in_a_bath():
    """The bias without a bath and that of the bath cancel."""
    rng = np.random.default_rng(1)
    n, kT, h, frequency, friction = 400, 2.5, 0.002, 30.0, 20.0
    damping = math.exp(-friction * h)
    gained = math.sqrt((1 - damping**2) * kT)
    q, v = rng.normal(size=(2, n)) * math.sqrt(kT)
    q /= frequency
    made = []
    for _ in range(2000):
        v = v - h * frequency**2 * q
        q = q + 0.5 * h * v
        v = damping * v + gained * rng.normal(size=n)
        q = q + 0.5 * h * v
        made.append([q, v])
    # One after the other they are one long run.
    q, v = np.transpose(made, (1, 2, 0)).reshape(2, -1)
    F = -(frequency**2) * q
    values = {
        "potential": 0.5 * (frequency * q) ** 2,
        "kinetic_rotation": 0.5 * v**2,
        "square_rotation": F**2,
        "trace_rotation": frequency**2,
        "power_rotation": -F * (v + 0.5 * h * F),
    }
    samples = pd.DataFrame(dict.fromkeys(kernels.COLUMNS, 0.0) | values, index=range(len(q)))
    # With frictions that differ nothing is taken to be known.
    bias = law.predicted(samples, h, 0.4, law.Bath(5.0, friction, kT, (0, 1), MOMENTS))
    at_once = kT * frequency**2 / 24
    for name in ("potential", "kinetic_rotation"):
        # Errors are from 40 parts.
        assert abs(bias[name].value) < 6.5 * bias[name].error < 0.7 * at_once
    assert abs(bias["weak_potential"].value) < 6.5 * bias["weak_potential"].error < 0.7 * at_once


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("rotation", "share"), [(kernels.EXACT_MEAN, 0.0), (kernels.BETWEEN_MEAN, 0.5), (kernels.RATTLE_MEAN, 1.0)]
)
def test_rotations_turn_as_the_energy_that_they_conserve_says(rotation, share):
    """Body-frame angular momenta follow L' = L x dE/dL, with E that of the study and by scipy's solver."""
    start, h, steps = 3 * np.sqrt(2.5 * UNEVEN), 0.004, 50
    A, L, p = np.eye(3)[None], start[None].copy(), np.zeros((1, 3))
    for _ in range(steps):
        # A bath of no friction.
        kernels.turn_around_bath(p, L, A, 0, UNEVEN, 1 / UNEVEN, h, (1.0, 1.0), np.zeros(4), rotation)

    def rate(along, part):
        slopes = []
        for axis in np.eye(3):
            ends = [kernels.rattle_energy.py_func(along + k * 1e-4 * axis, 1 / UNEVEN)[0] for k in (-1, 1)]
            slopes.append((ends[1] - ends[0]) / 2e-4)
        return np.cross(along, along / UNEVEN + part * h**2 * np.array(slopes))

    off = []
    for part in (share, share + 0.5):
        solution = solve_ivp(lambda t, y, part=part: rate(y, part), (0, steps * h), start, rtol=1e-9, atol=1e-12)
        off.append(np.abs(solution.y[:, -1] - A[0] @ L[0]).max())
    # The next order is smaller by the square of the angle of a step, 0.1 or less.
    assert off[0] < 0.1 * off[1]


def test_change_of_that_energy_by_a_bath():
    """-4 E + kT sum I d^2 E / dL^2, by differences of a quartic, which are exact."""
    L, rates, step = np.array([0.1, -0.2, 0.3]), 1 / MOMENTS, 0.01

    def energy(at):
        return kernels.rattle_energy.py_func(at, rates)[0]

    second = 0.0
    for axis in np.eye(3):
        # Fourth order, to which a quartic has no error.
        values = [energy(L + step * k * axis) for k in (-2, -1, 0, 1, 2)]
        second += (MOMENTS @ axis) * (np.array([-1, 16, -30, 16, -1]) @ values) / (12 * step**2)
    assert kernels.rattle_energy.py_func(L, rates)[1] == pytest.approx(second, rel=1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize("name", liquids.MODELS)
def test_forces_and_traces_are_derivatives_of_the_potential(name):
    model = liquids.MODELS[name]
    liquid, bodies = model.liquid(), model.start(3)
    # Molecules on the lattice are far apart but for a few; two are enough to see.
    n = model.molecules
    arms, F, torque = np.empty((n, len(liquid.sites), 3)), np.empty((n, 3)), np.empty((n, 3))
    traces = np.empty(2)

    def potential(q, A):
        moved = liquids.Bodies(q, bodies.p, A, bodies.L)
        return kernels.potential(liquid, moved, arms, F, torque, np.empty(0))

    # In a field bodies start at rest, where no torque shows its sign.
    away, around = np.random.default_rng(4).normal(size=(2, n, 3))
    q, A = bodies.q + 0.02 * away, np.array([_turned(a, 0.3 * w) for a, w in zip(bodies.A, around, strict=True)])
    kernels.potential(liquid, liquids.Bodies(q, bodies.p, A, bodies.L), arms, F, torque, traces)
    forces, torques = F.copy(), torque.copy()
    rng = np.random.default_rng(5)
    shift, axis = rng.normal(size=(2, n, 3))
    step = 1e-5
    along = [potential(q + k * step * shift, A) for k in (-1, 1)]
    assert (along[1] - along[0]) / (2 * step) == pytest.approx(-(forces * shift).sum(), rel=1e-6, abs=1e-6)
    turned = [potential(q, np.array([_turned(a, k * step * w) for a, w in zip(A, axis, strict=True)])) for k in (-1, 1)]
    assert (turned[1] - turned[0]) / (2 * step) == pytest.approx(-(torques * axis).sum(), rel=1e-6, abs=1e-6)
    # The mean over random signs of a second derivative is the trace; over all axes of one body at a time it is exact.
    chosen = range(n) if n <= 64 else ()
    straight, turning, step, middle = 0.0, 0.0, 1e-4, potential(q, A)
    for body in chosen:
        for axis_number, unit in enumerate(np.eye(3)):
            move = np.zeros((n, 3))
            move[body] = step * unit
            straight += potential(q + move, A) + potential(q - move, A) - 2 * middle
            if liquid.moments[axis_number] > 0:
                for sign in (-1, 1):
                    new = A.copy()
                    new[body] = _turned(A[body], sign * step * A[body, axis_number])
                    turning += (potential(q, new) - middle) * liquid.inverse_moments[axis_number]
    if n <= 64:
        # Rounding of V, 1e-12 of some 1e5 kJ/mol, over the step squared.
        assert straight / step**2 / liquid.mass == pytest.approx(traces[0], rel=1e-3)
        assert turning / step**2 == pytest.approx(traces[1], rel=1e-3, abs=1e-3)


def _turned(A, w):
    """Rows of an attitude matrix turned by a small vector in the lab frame."""
    angle = np.linalg.norm(w)
    K = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    R = np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * K @ K
    return A @ R.T
