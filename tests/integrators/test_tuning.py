"""Tuning of hybrid Monte Carlo: the acceptance it reaches, the state after it, and refusals."""

import itertools
import math

import numpy as np
import openmm
import pytest

from openmm_sier import SIER2, SIER4G, SIERHMCIntegrator, SIERIntegrator, tune
from openmm_sier.dynamics.acceptance import acceptance_at, best_acceptance, spread_at, usual_steps
from openmm_sier.ensembles import metropolis
from openmm_sier.integrators import tuning
from tests.support.matrices import representatives
from tests.support.seeded import seeded
from tests.support.silence import silence
from tests.support.systems import assembled
from tests.support.waters import context_at, platform

TEMPERATURE = 300.0


def wells(h=0.004, n=10, scheme=SIER2, seed=3, particles=20, **options):
    """A Context of particles in wells of several frequencies, 30 to 60 per ps."""
    well = openmm.CustomExternalForce("0.5*k*(x^2+y^2+z^2)")
    well.addPerParticleParameter("k")
    for i in range(particles):
        well.addParticle(i, [1000.0 * (1 + 3 * i / particles)])
    system = assembled(particles * [1.0], well)
    integrator = seeded(SIERHMCIntegrator(TEMPERATURE, h, scheme, n, frictionCoeff=None, **options), seed)
    return context_at(system, integrator, np.zeros((2, particles, 3)))


@pytest.mark.parametrize(
    ("h", "scheme"), representatives([(0.002, SIER2), (0.03, SIER2), (0.01, SIER4G)], (0.03, SIER2))
)
def test_the_acceptance_that_was_asked_for(h, scheme):
    """From steps that are too short and too long, the wells being unstable from 0.032 ps on."""
    context = wells(h, 4, scheme)
    integrator = context.getIntegrator()
    integrator.step(2)
    tuned = tune(context, 0.8)
    assert (integrator.getSchemeStepSize()._value, integrator.getStepsPerTrial()) == (
        tuned.schemeStepSize,
        tuned.stepsPerTrial,
    )
    # The same length in time, in whole steps.
    assert integrator.getStepSize()._value == pytest.approx(4 * h, abs=tuned.schemeStepSize / 2)
    # None of the tuning is counted.
    assert integrator.trials == 0
    integrator.step(400)
    # 400 trials of wells, which forget their energy in some ten, know it to 0.06. The spread of 40 errors knows the
    # step to 6 %, which is 0.03 again for second order; and it depends on the length of trajectories by some tenths.
    assert integrator.acceptanceRate == pytest.approx(0.8, abs=0.15)
    assert f"{tuned.stepsPerTrial} in a trial" in str(tuned)


def test_equal_seeds_tune_alike():
    one, other, third = (tune(wells(n=3, seed=seed), trials=10) for seed in (3, 3, 4))
    assert str(one) == str(other)
    assert one == other
    assert one != third


def test_trajectories_that_do_not_reverse_are_refused(monkeypatch):
    monkeypatch.setattr(metropolis, "reversal_error", lambda engine, steps: 1.0)
    context = wells(n=4, extraChances=0)
    with pytest.raises(openmm.OpenMMException, match="missed its start"):
        tune(context, trials=10)
    assert (context.getIntegrator().getSchemeStepSize()._value, context.getIntegrator().getStepsPerTrial()) == (
        0.004,
        4,
    )


def bonded(mass, strength, **options):
    """A Context of two atoms with a bond in force group 1."""
    bond = openmm.HarmonicBondForce()
    bond.setForceGroup(1)
    bond.addBond(0, 1, 0.1, strength)
    integrator = seeded(SIERHMCIntegrator(TEMPERATURE, 0.004, stepsPerTrial=3, **options), 5)
    point = np.array([[0.0, 0, 0], [0.1, 0, 0]]), np.zeros((2, 3))
    return context_at(assembled(2 * [mass], bond), integrator, point)


def test_steps_stay_below_the_limit_of_a_bond():
    """The spread of a single bond's energy errors is never what an acceptance of 0.05 has."""
    context = bonded(1.0, 2e4, scheme=SIER2)
    with pytest.warns(UserWarning, match="4 fs is long"):
        tuned = tune(context, 0.05, trials=10)
    refused = [each.step for each in tuned.tried if math.isinf(each.spread)]
    assert refused
    # What was refused is not tried again.
    assert all(one > other for one, other in itertools.pairwise(refused))
    # Stable up to 2/sqrt(2e4/0.5) = 0.01 ps.
    assert tuned.schemeStepSize < 0.01
    context.getIntegrator().step(1)


def test_steps_stay_where_kicks_do_not_resonate_with_fast_forces():
    """Without slow forces there is no energy error but that of inner steps, and the step grows to 0.45 periods."""
    period = 0.024
    context = bonded(12.0, (2 * math.pi / period) ** 2 * 6, fastForceGroups={1})
    with silence():
        tuned = tune(context, 0.05, trials=10)
    assert tuned.schemeStepSize == pytest.approx(0.45 * period)


@pytest.mark.parametrize("order", [2, 4])
def test_at_the_best_acceptance_a_longer_step_gains_little(order):
    spread = spread_at(best_acceptance(order))
    gains = [times * acceptance_at(spread * times**order) for times in np.linspace(1, 2, 200)]
    # By its definition 0.95 of the largest, whose place is known to a step of this grid, where it is flat.
    assert acceptance_at(spread) / max(gains) == pytest.approx(0.95, abs=0.002)


def test_usual_trials_are_as_long_for_every_step():
    assert [usual_steps(step) for step in (0.0, 0.006, 0.01, 0.3)] == [1, 12, 7, 1]


@pytest.mark.parametrize("after", [5, 60])
def test_an_interrupt_restores_step_and_length(monkeypatch, after):
    context = wells(n=4)
    integrator, trial, count = context.getIntegrator(), tuning.make_trial, []

    def interrupted(*arguments):
        count.append(1)
        if len(count) > after:
            integrator.step(1)
            raise KeyboardInterrupt
        return trial(*arguments)

    monkeypatch.setattr(tuning, "make_trial", interrupted)
    with pytest.raises(KeyboardInterrupt):
        tune(context, trials=10)
    assert (integrator.getSchemeStepSize()._value, integrator.getStepsPerTrial()) == (0.004, 4)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"acceptance": 1.0}, "acceptance must be between 0 and 1, got 1"),
        ({"acceptance": 0.0}, "acceptance must be between 0 and 1, got 0"),
        ({"trials": 9}, "trials must be at least 10, got 9"),
        ({"trials": 10.5}, "trials must be a whole number"),
    ],
)
def test_arguments_that_make_no_sense(options, message):
    context = wells()
    before = context.createCheckpoint()
    with pytest.raises(ValueError, match=message):
        tune(context, **options)
    assert context.createCheckpoint() == before


def test_other_integrators_are_refused():
    context = openmm.Context(assembled([1.0]), SIERIntegrator(0.001), platform())
    with pytest.raises(TypeError, match="SIERHMCIntegrator, got a SIERIntegrator"):
        tune(context)
    with pytest.raises(ValueError, match="step must be"):
        tune(wells(0.0))
