"""Hybrid Monte Carlo samples exactly at steps so long that half of the trials are rejected."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import openmm
import pytest

from openmm_sier.dynamics.barostat import MonteCarloVolumeMove
from openmm_sier.dynamics.bodies import BodyState
from openmm_sier.dynamics.rotation import mrdl
from openmm_sier.dynamics.schemes import SIER2, SIER4G, Scheme
from openmm_sier.dynamics.stages import DRIFT, KICK
from openmm_sier.ensembles.metropolis import REVERSAL
from openmm_sier.measure.statistics import mean_and_error
from tests.support.trials import KT, Chain, Dipoles, Wells


def within_three_errors(series, expected):
    """Whether the mean of a series over trials, of one value or of one for each body, is what it should be.

    The error is that of twenty means of blocks, which are far longer than the correlation of a few trials. The seed is
    fixed, so that three errors are exceeded always or never.
    """
    series = np.asarray(series)
    mean, error, _ = mean_and_error(series.reshape(len(series), -1).mean(axis=1))
    print(f"{mean:.4f} +- {error:.4f}, expected {expected:.4f}, {(mean - expected) / error:+.1f} errors")
    # An error of more than this would let a wrong rule pass.
    assert error < 0.1 * abs(expected)
    return abs(mean - expected) < 3 * error


@pytest.mark.slow
@pytest.mark.parametrize(
    ("h", "steps", "kept"), [(0.02, (2, 3, 4), 0.0), (0.016, (1,), 0.9)], ids=["drawn anew", "kept in part"]
)
def test_wells_are_sampled_exactly(h, steps, kept):
    """Where a trial keeps 0.9 of the momenta, those of a rejected one must be reversed, or they know of places."""
    friction = -math.log(kept) / h if kept else None
    chain = Chain(Wells(), SIER2, h, steps, friction=friction)
    samples = list(chain.samples(2000))
    energies = np.array([chain.model.observed(sample.state) for sample in samples])
    # Moments of the square of a normal variable.
    assert within_three_errors(energies, 1)
    assert within_three_errors(energies**2, 3)
    assert within_three_errors([sample.state.p**2 / KT for sample in samples], 1)
    products = [np.sqrt(chain.model.springs) * sample.state.q * sample.state.p / KT for sample in samples]
    # Without the reversal it is 0.05.
    assert within_three_errors(1 + np.array(products), 1)
    assert 0.25 < samples[-1].accepted / samples[-1].trials < 0.65


@pytest.mark.slow
@pytest.mark.parametrize(("steps", "friction"), [((2, 3, 4), None), ((1,), 5.0)], ids=["drawn anew", "in part"])
def test_wells_with_the_centre_of_mass_at_rest(steps, friction):
    """The motion of the centre of mass is removed after a trial; positions are sampled as without that."""
    chain = Chain(Wells(), SIER2, 0.02, steps, friction=friction, at_rest=True)
    samples = list(chain.samples(2000))
    momenta = np.array([sample.state.p for sample in samples])
    assert np.abs(momenta.sum(axis=2)).max() < 1e-12 * np.abs(momenta).max() * 6
    assert 0.25 < samples[-1].accepted / samples[-1].trials < 0.75
    assert within_three_errors([chain.model.observed(sample.state) for sample in samples], 1)
    # Five of six degrees of freedom are left.
    assert within_three_errors(momenta**2 / KT, 5 / 6)


@pytest.mark.slow
def test_dipoles_in_a_field_at_constant_pressure():
    """Langevin function and its derivative, and the volume of an ideal gas."""
    model, n, x = Dipoles(12), 12, Dipoles.FIELD
    # With a free-rotation map that is not exact but reverses, and is the quickest for so few bodies. The pressure gives
    # the volume a gamma distribution of n + 1 degrees in nm^3.
    molecules = [list(range(3 * i, 3 * i + 3)) for i in range(n)]
    move = MonteCarloVolumeMove(KT, 1)
    chain = Chain(model, SIER4G, 0.058, (1, 2), rotation=mrdl, volume_move=move, molecules=molecules)
    samples = list(chain.samples(2500))
    assert 0.25 < samples[-1].accepted / samples[-1].trials < 0.65
    tilts = 1 - np.array([model.observed(sample.state) for sample in samples[::2]])
    mean = 1 - (1 / math.tanh(x) - 1 / x)
    volumes = [sample.volume for sample in samples]
    assert within_three_errors(tilts, mean)
    assert within_three_errors((tilts - mean) ** 2, 1 / x**2 - 1 / math.sinh(x) ** 2)
    assert within_three_errors(volumes, n + 1)
    # A variance of so few volumes is not known to a tenth.
    assert np.var(volumes) == pytest.approx(n + 1, rel=0.5)


def test_trajectories_that_fail_are_rejected():
    """Forces are there where k q^2 <= 2 kT alone: samples have that distribution, which is cut off."""
    chain = Chain(Wells(2, farthest=2.0), SIER2, 0.01)
    # The first trajectory must come back to be taken for reversible.
    chain.record["sier_checked_step"] = chain.h
    samples = list(chain.samples(2000))
    assert sum(math.isinf(sample.error) for sample in samples) > 500
    cut = math.sqrt(2)
    density, inside = math.exp(-(cut**2) / 2) / math.sqrt(2 * math.pi), math.erf(cut / math.sqrt(2))
    observed = [chain.model.observed(sample.state) for sample in samples]
    assert within_three_errors(observed, 1 - 2 * cut * density / inside)


@pytest.mark.parametrize("volume_move", [None, MonteCarloVolumeMove(KT, 2)])
def test_total_energy_less_heat_changes_by_errors_of_accepted_trials(volume_move):
    chain = Chain(Wells(), SIER2, 0.02, friction=5.0, at_rest=True, volume_move=volume_move)

    def conserved(state):
        return sum(chain.model.bodies.kinetic_energies(state)) + chain.model.potential(state) - state.heat

    last, accepted = conserved(chain.model.start()), 0
    kinds = set()
    for sample in chain.samples(60):
        is_accepted, accepted = sample.accepted > accepted, sample.accepted
        kinds.add(is_accepted)
        # Rounding of energies of some 100 kJ/mol.
        assert conserved(sample.state) - last == pytest.approx(sample.error * KT if is_accepted else 0.0, abs=1e-9)
        last = conserved(sample.state)
    assert kinds == {True, False}


def test_a_step_is_a_trial_and_a_rejection_goes_back():
    chain = Chain(Wells(), SIER2, 0.02, steps=(3,))
    before, kinds = chain.model.start(), set()
    for number, sample in enumerate(chain.samples(30), 1):
        assert chain.engine.clock.steps == number
        assert chain.engine.clock.time == pytest.approx(3 * number * 0.02, rel=1e-14)
        is_same = np.array_equal(sample.state.q, before.q)
        kinds.add(is_same)
        if is_same:
            assert sample.error > 0
        before = sample.state
    assert kinds == {True, False}


@pytest.mark.parametrize("error", [KeyboardInterrupt, openmm.OpenMMException])
def test_a_step_that_cannot_be_completed_is_undone(error):
    """An interrupt in the second step of a trajectory, after a volume move: the next trial is the same one again."""
    volume_move = MonteCarloVolumeMove(KT, 1)
    chain, undisturbed = (Chain(Wells(), SIER2, 0.02, (3,), volume_move=volume_move) for _ in range(2))
    list(chain.samples(2))
    before, follow, calls = chain.engine.remember(), chain.engine.follow, []

    def interrupted(steps):
        calls.append(follow(steps - 1))
        raise error

    chain.engine.follow = interrupted
    with pytest.raises(error):
        list(chain.samples(1))
    assert calls
    for one, other in zip(chain.engine.remember(), before, strict=True):
        assert one == other or one is other
    chain.engine.follow = follow
    (one,) = chain.samples(1)
    other = list(undisturbed.samples(3))[-1]
    assert np.array_equal(one.state.q, other.state.q)
    assert (one.trials, one.accepted, one.error) == (other.trials, other.accepted, other.error)


def test_no_trial_begins_without_an_energy():
    chain = Chain(Wells(), SIER2, 0.02)
    start = chain.model.start()
    chain.engine.reached = BodyState(start.q + math.nan, start.p, start.A, start.L)
    with pytest.raises(openmm.OpenMMException, match="where the energy is nan"):
        next(chain.samples(1))


def test_reversal_error():
    chain = Chain(Dipoles(), SIER4G, 0.01, (10,))
    next(chain.samples(1))
    # Rounding of coordinates of 0.1 nm, grown in twenty steps of the drift's maps of 1e-14.
    assert 0 < chain.record[REVERSAL] < 1e-11
    crooked = Chain(Dipoles(), Scheme("Euler", ((KICK, 1.0), (DRIFT, 1.0))), 0.01, (10,))
    with pytest.raises(openmm.OpenMMException, match=r"10 steps .* missed its start by"):
        next(crooked.samples(1))
    assert crooked.engine.reached.draws == 0


def test_positions_that_are_no_numbers_are_no_reversal():
    """OpenMM's program does not stop at them, and what asks constraints to hold them there fails with another error."""
    chain = Chain(Wells(), SIER2, 0.02, (3,))
    engine, follow = chain.engine, chain.engine.follow

    def lost(steps):
        assert np.isfinite(engine.reached.q).all()
        follow(steps)
        engine.reached = replace(engine.reached, q=engine.reached.q * math.nan)

    engine.follow, engine.positions = lost, lambda: engine.reached.q.T
    with pytest.raises(openmm.OpenMMException, match=r"3 steps .* missed its start by inf"):
        next(chain.samples(1))
    assert np.isfinite(engine.reached.q).all()
