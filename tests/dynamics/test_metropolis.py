"""Hybrid Monte Carlo samples exactly at steps so long that half of the trials are rejected."""

from __future__ import annotations

import math

import numpy as np
import pytest

from openmm_sier.dynamics import metropolis, operators
from openmm_sier.dynamics.barostat import MonteCarloVolumeMove
from openmm_sier.dynamics.bodies import BodyState
from openmm_sier.dynamics.metropolis import NoEnergyError, SampledState, expected_acceptance, reversal_error, spread_at
from openmm_sier.dynamics.rotation import mrdl
from openmm_sier.dynamics.schemes import SIER2, SIER4G, Scheme
from openmm_sier.dynamics.stages import DRIFT, KICK
from openmm_sier.measure.statistics import mean_and_error
from tests.support.trials import KT, Chain, Dipoles, Wells, whole_trial


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
    friction = -math.log(kept) / h if kept else math.inf
    chain = Chain(Wells(), SIER2, h, steps, friction=friction)
    states = list(chain.samples(2000))
    energies = np.array([chain.model.observed(state) for state in states])
    # Moments of the square of a normal variable.
    assert within_three_errors(energies, 1)
    assert within_three_errors(energies**2, 3)
    assert within_three_errors([state.p**2 / KT for state in states], 1)
    products = [np.sqrt(chain.model.springs) * state.q * state.p / KT for state in states]
    # Without the reversal it is 0.05.
    assert within_three_errors(1 + np.array(products), 1)
    assert 0.25 < states[-1].accepted / states[-1].trials < 0.65


@pytest.mark.slow
def test_wells_with_the_centre_of_mass_at_rest():
    """Forces that do not sum to zero must not move it; the samples are those with the sum of all q at its start, 0."""
    chain = Chain(Wells(), SIER2, 0.02, at_rest=True)
    states = list(chain.samples(2000))
    assert max(abs(state.p.sum(axis=1)).max() for state in states) < 1e-12 * abs(states[-1].p).max() * 6
    assert max(abs(state.q.sum(axis=1)).max() for state in states) < 1e-9
    assert 0.25 < states[-1].accepted / states[-1].trials < 0.65
    # Normal variables of variances 1/k, given that their sum is zero: n - 1 of n degrees of freedom are left.
    assert within_three_errors([chain.model.observed(state) for state in states], 5 / 6)
    assert within_three_errors([state.p**2 / KT for state in states], 5 / 6)


@pytest.mark.slow
def test_dipoles_in_a_field_at_constant_pressure():
    """Langevin function and its derivative, and the volume of an ideal gas."""
    model, n, x = Dipoles(12), 12, Dipoles.FIELD
    # With a free-rotation map that is not exact but reverses, and is the quickest for so few bodies.
    chain = Chain(model, SIER4G, 0.058, steps=(1, 2), rotation=mrdl)
    pressure = KT  # So that the volume has a gamma distribution of n + 1 degrees in nm^3.
    piston = MonteCarloVolumeMove(pressure, 1, chain.bath)
    move = piston.operator(model.bodies, [range(3 * i, 3 * i + 3) for i in range(n)])
    step, state, volume = chain.step, model.start(), float(n)
    cosines, volumes = [], []
    for _ in range(500):
        state = whole_trial(step, state)
        cosines.append(model.observed(state))
        for _ in range(5):
            state, factor = move(state, volume, lambda q, factor: 0.0)
            volume *= factor**3
            volumes.append(volume)
    assert 0.25 < state.accepted / state.trials < 0.65
    tilts = 1 - np.array(cosines)
    mean = 1 - (1 / math.tanh(x) - 1 / x)
    assert within_three_errors(tilts, mean)
    assert within_three_errors((tilts - mean) ** 2, 1 / x**2 - 1 / math.sinh(x) ** 2)
    assert within_three_errors(volumes, n + 1)
    # A variance of so few volumes is not known to a tenth.
    assert np.var(volumes) == pytest.approx(n + 1, rel=0.5)


def test_trajectories_that_fail_are_rejected():
    """Forces are there where k q^2 <= 2 kT alone: samples have that distribution, which is cut off."""
    chain = Chain(Wells(2, farthest=2.0), SIER2, 0.01)
    states = list(chain.samples(2000))
    assert sum(math.isinf(state.error) for state in states) > 500
    cut = math.sqrt(2)
    density, inside = math.exp(-(cut**2) / 2) / math.sqrt(2 * math.pi), math.erf(cut / math.sqrt(2))
    assert within_three_errors([chain.model.observed(state) for state in states], 1 - 2 * cut * density / inside)


def test_total_energy_less_heat_changes_by_errors_of_accepted_trials():
    chain = Chain(Wells(), SIER2, 0.02, friction=5.0, at_rest=True)

    def conserved(state):
        return sum(chain.model.bodies.kinetic_energies(state)) + chain.model.potential(state) - state.heat

    last, accepted = conserved(chain.model.start()), 0
    kinds = set()
    for state in chain.samples(60):
        is_accepted, accepted = state.accepted > accepted, state.accepted
        kinds.add(is_accepted)
        # Rounding of energies of some 100 kJ/mol.
        assert conserved(state) - last == pytest.approx(state.error * KT if is_accepted else 0.0, abs=1e-9)
        last = conserved(state)
    assert kinds == {True, False}


def test_rejection_takes_the_start_with_momenta_reversed():
    chain = Chain(Wells(), SIER2, 0.02, steps=(3,))
    step, state = chain.step, chain.model.start()
    for _ in range(50):
        first = step(state)
        accepted, state = first.accepted, step(step(first))
        assert (first.trial.left, state.trial) == (2, None)
        if state.accepted == accepted:
            assert np.array_equal(state.q, first.trial.start.q)
            assert np.array_equal(state.p, -first.trial.start.p)
            assert state.error > 0
            break
    else:
        pytest.fail("no trial was rejected")


def test_another_step_gives_the_trial_up():
    chain = Chain(Wells(), SIER2, 0.02, steps=(3,))
    sample = SampledState.of(next(chain.samples(1)))
    begun = chain.step(sample)
    other = Chain(chain.model, SIER2, 0.01, steps=(3,)).step(begun)
    assert np.array_equal(other.trial.start.q, sample.q)
    assert other.trial.left == 2
    # Numbers that were drawn are not drawn again.
    assert other.draws == begun.draws + 1
    assert other.trials == sample.trials


def test_no_trial_begins_without_an_energy():
    chain = Chain(Wells(), SIER2, 0.02)
    start = chain.model.start()
    with pytest.raises(NoEnergyError, match="where the energy is nan"):
        next(chain.samples(1, BodyState(start.q + math.nan, start.p, start.A, start.L)))


def test_reversal_error():
    chain = Chain(Dipoles(), SIER4G, 0.01)
    start = metropolis.refreshment(chain.bath.operator(chain.model.bodies), chain.model.bodies, False)(
        chain.model.start(), 1.0
    )
    # Rounding of coordinates of 0.1 nm, grown in twenty steps of the drift's maps of 1e-14.
    assert reversal_error(chain.model.bodies, chain.advance, start, 10) < 1e-11
    crooked = Scheme("Euler", ((KICK, 1.0), (DRIFT, 1.0)))
    advance = operators.stepper(crooked, chain.operations, chain.h)
    assert reversal_error(chain.model.bodies, advance, start, 10) > 1e-3


@pytest.mark.parametrize("spread", [0.05, 0.7, 3.0])
def test_acceptance_is_that_of_normal_errors(rng, spread):
    """Their mean is half their variance, as <exp(-error)> = 1 asks."""
    errors = rng.normal(0.5 * spread**2, spread, size=200_000)
    # Four standard errors of a mean of numbers between 0 and 1, of standard deviation below 0.5.
    assert expected_acceptance(spread) == pytest.approx(
        np.minimum(1, np.exp(-errors)).mean(), abs=4 * 0.5 / 200_000**0.5
    )


@pytest.mark.parametrize("accepted", [0.1, 0.5, 0.9, 0.999])
def test_spread_is_its_inverse(accepted):
    assert expected_acceptance(spread_at(accepted)) == pytest.approx(accepted, rel=1e-12)
