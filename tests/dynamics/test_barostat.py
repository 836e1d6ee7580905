"""Monte Carlo moves of the volume: its distribution, and what is moved."""

from __future__ import annotations

import numpy as np
import pytest

from openmm_sier.dynamics.barostat import MonteCarloVolumeMove
from openmm_sier.dynamics.bodies import BodyState, RigidBodies
from openmm_sier.dynamics.constants import BAR, GAS_CONSTANT
from openmm_sier.dynamics.species import Species
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck

TEMPERATURE, PRESSURE = 300.0, 100 * BAR
KT = GAS_CONSTANT * TEMPERATURE


def points(n):
    bodies = RigidBodies([Species(np.arange(n)[:, None], np.ones(1), np.zeros((3, 1)), np.zeros(3))], n)
    zero = np.zeros((3, n))
    return bodies, BodyState(zero, zero, np.repeat(np.eye(3)[:, :, None], n, axis=2), zero)


def volumes(n, moves, energy, centres):
    """Volumes after every move of n points, whose centres are drawn anew before each."""
    bodies, state = points(n)
    move = MonteCarloVolumeMove(PRESSURE, 1, OrnsteinUhlenbeck(TEMPERATURE, 1.0, 1.0, seed=1)).operator(
        bodies, [[i] for i in range(n)]
    )
    volume, found = n * KT / PRESSURE, []
    for _ in range(moves):
        state = BodyState(centres(volume), state.p, state.A, state.L, state.heat, state.draws)
        state, factor = move(state, volume, energy)
        volume *= factor**3
        found.append(volume)
    return np.array(found)


@pytest.mark.slow
def test_ideal_gas(rng):
    """p(V) ~ V^n exp(-PV/kT): mean (n + 1) kT/P, and a variance of n + 1 of its squares.

    20000 moves with a correlation time of some 40 leave 1.4 % of the mean and 7 % of the variance. A power of n - 1 or
    n + 1 would change both by 10 %.
    """
    n = 9
    found = volumes(n, 20000, lambda q, factor: 0.0, lambda volume: rng.uniform(0, volume ** (1 / 3), (3, n)))
    assert found.mean() * PRESSURE / KT == pytest.approx(n + 1, rel=0.045)
    assert found.var() * (PRESSURE / KT) ** 2 == pytest.approx(n + 1, rel=0.2)


@pytest.mark.slow
def test_points_held_by_springs(rng):
    """p(q, V) ~ exp(-(PV + kq^2/2)/kT): the volume does not matter to the points, and has the mean kT/P.

    20000 moves with a correlation time of some 30: 4 %. Without the energy it would be three times as much.
    """
    n, spring = 2, 1e4
    found = volumes(
        n,
        20000,
        lambda q, factor: 0.5 * spring * float((q * q).sum()),
        lambda volume: rng.normal(0, np.sqrt(KT / spring), (3, n)),
    )
    assert found.mean() * PRESSURE / KT == pytest.approx(1, rel=0.15)


def test_molecules_are_moved_as_a_whole():
    """Bodies of one molecule keep their distance, its centre of mass is scaled; what it took is counted as heat."""
    bodies, state = points(4)
    state = BodyState(np.arange(12.0).reshape(3, 4), state.p, state.A, state.L, 2.0, 7)
    move = MonteCarloVolumeMove(-1e3 * BAR, 1, OrnsteinUhlenbeck(TEMPERATURE, 1.0, 1.0, seed=2)).operator(
        bodies, [[1, 2], [0], [3]]
    )
    factor = 1.0
    while factor == 1.0:
        draws = state.draws
        new, factor = move(state, 10.0, lambda q, factor: 0.01 * float(q.sum()))
        assert new.draws == draws + 1
        state = new if factor == 1.0 else state
    for atoms in ([1, 2], [0], [3]):
        before, after = state.q[:, atoms], new.q[:, atoms]
        assert after.mean(axis=1) == pytest.approx(factor * before.mean(axis=1))
        assert after - after.mean(axis=1)[:, None] == pytest.approx(before - before.mean(axis=1)[:, None], abs=1e-14)
    assert new.heat - state.heat == pytest.approx(0.01 * (new.q.sum() - state.q.sum()))
    assert new.A is state.A
    assert new.p is state.p


def test_without_a_temperature_the_enthalpy_falls():
    bodies, state = points(3)
    move = MonteCarloVolumeMove(PRESSURE, 1, OrnsteinUhlenbeck(0.0, 1.0, 1.0, seed=1)).operator(bodies, [[0], [1], [2]])
    volume = 5.0
    for _ in range(50):
        state, factor = move(state, volume, lambda q, factor: 0.0)
        assert factor <= 1.0
        volume *= factor**3
    assert volume < 4.0
