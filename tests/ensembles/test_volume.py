"""Monte Carlo moves of the volume: its distribution, and what is moved."""

from __future__ import annotations

import math

import numpy as np
import pytest

from openmm_sier.dynamics.barostat import MonteCarloVolumeMove
from openmm_sier.dynamics.bodies import BodyState, RigidBodies
from openmm_sier.dynamics.constants import BAR, GAS_CONSTANT
from openmm_sier.dynamics.species import Species
from openmm_sier.ensembles.volume import move_volume
from tests.support.trials import ModelEngine

TEMPERATURE, PRESSURE = 300.0, 100 * BAR
KT = GAS_CONSTANT * TEMPERATURE


class Points:
    """Points with a potential that is a function of their positions."""

    def __init__(self, n, potential=lambda q: 0.0):
        self.bodies = RigidBodies([Species(np.arange(n)[:, None], np.ones(1), np.zeros((3, 1)), np.zeros(3))], n)
        self.potential = lambda state: potential(state.q)
        self.forces = None

    def start(self):
        zero = np.zeros((3, self.bodies.n))
        return BodyState(zero, zero, np.repeat(np.eye(3)[:, :, None], self.bodies.n, axis=2), zero)


def volumes(n, moves, potential, centres):
    """Volumes after every move of n points, whose centres are drawn anew before each."""
    engine, move = ModelEngine(Points(n, potential), volume=n * KT / PRESSURE), MonteCarloVolumeMove(PRESSURE, 1)
    found = []
    for _ in range(moves):
        old = engine.reached
        engine.reached = BodyState(centres(engine.volume()), old.p, old.A, old.L, old.heat, old.draws)
        move_volume(engine, move, TEMPERATURE, seed=1)
        found.append(engine.volume())
    return np.array(found)


@pytest.mark.slow
def test_ideal_gas(rng):
    """p(V) ~ V^n exp(-PV/kT): mean (n + 1) kT/P, and a variance of n + 1 of its squares.

    20000 moves with a correlation time of some 40 leave 1.4 % of the mean and 7 % of the variance. A power of n - 1 or
    n + 1 would change both by 10 %.
    """
    n = 9
    found = volumes(n, 20000, lambda q: 0.0, lambda volume: rng.uniform(0, volume ** (1 / 3), (3, n)))
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
        lambda q: 0.5 * spring * float((q * q).sum()),
        lambda volume: rng.normal(0, np.sqrt(KT / spring), (3, n)),
    )
    assert found.mean() * PRESSURE / KT == pytest.approx(1, rel=0.15)


def test_molecules_are_moved_as_a_whole():
    """Bodies of one molecule keep their distance, its centre of mass is scaled; what it took is counted as heat."""
    engine = ModelEngine(Points(4, lambda q: 0.01 * float(q.sum())), volume=10.0, molecules=[[1, 2], [0], [3]])
    state = engine.reached
    engine.reached = BodyState(np.arange(12.0).reshape(3, 4), state.p, state.A, state.L, 2.0, 7)
    kinds = set()
    while kinds != {True, False}:
        before, volume = engine.reached, engine.volume()
        move_volume(engine, MonteCarloVolumeMove(-10 * BAR, 1), TEMPERATURE, seed=2)
        after, factor = engine.reached, (engine.volume() / volume) ** (1 / 3)
        assert after.draws == before.draws + 1
        kinds.add(factor != 1)
        for atoms in ([1, 2], [0], [3]):
            old, new = before.q[:, atoms], after.q[:, atoms]
            assert new.mean(axis=1) == pytest.approx(factor * old.mean(axis=1))
            assert new - new.mean(axis=1)[:, None] == pytest.approx(old - old.mean(axis=1)[:, None], abs=1e-14)
        assert after.heat - before.heat == pytest.approx(0.01 * (after.q.sum() - before.q.sum()), abs=1e-12)
        assert after.A is before.A
        assert after.p is before.p


def test_without_a_temperature_the_enthalpy_falls():
    engine = ModelEngine(Points(3), volume=5.0)
    for _ in range(50):
        before = engine.volume()
        move_volume(engine, MonteCarloVolumeMove(PRESSURE, 1), 0.0, seed=1)
        assert engine.volume() <= before
    assert engine.volume() < 4.0


def test_a_move_that_cannot_be_tried_changes_nothing():
    engine = ModelEngine(Points(3, lambda q: 0.0 if engine.volume() == 5.0 else math.sqrt(-1)), volume=5.0)
    before = engine.reached
    with pytest.raises(ValueError, match="math domain"):
        move_volume(engine, MonteCarloVolumeMove(PRESSURE, 1), TEMPERATURE, seed=1)
    assert engine.reached is before
    assert engine.volume() == 5.0
