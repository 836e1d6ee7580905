"""Tuning of hybrid Monte Carlo: the acceptance it reaches, the state after it, and refusals."""

import itertools
import math

import numpy as np
import openmm
import pytest

from openmm_sier import SIER2, SIER2V2, SIER4G, SIERHMCIntegrator, SIERIntegrator, tune
from openmm_sier.dynamics.acceptance import acceptance_at, best_acceptance, spread_at, usual_steps
from openmm_sier.ensembles import metropolis
from openmm_sier.integrators import tuning, tuning_measurements
from openmm_sier.integrators.tuning_results import LengthFound, StepFound
from tests.support.matrices import representatives
from tests.support.seeded import seeded
from tests.support.silence import silence
from tests.support.systems import assembled
from tests.support.waters import cluster_system, context_at, platform

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
def test_the_acceptance_that_was_asked_for(monkeypatch, h, scheme):
    """From steps that are too short and too long, the wells being unstable from 0.032 ps on."""
    monkeypatch.setattr(tuning_measurements, "_seconds", forces_made)
    context = wells(h, 4, scheme)
    integrator = context.getIntegrator()
    integrator.step(2)
    tuned = tune(context, 0.8, samples=20, schemes=[scheme])
    assert (integrator.getSchemeStepSize()._value, integrator.getStepsPerTrial()) == (
        tuned.schemeStepSize,
        tuned.stepsPerTrial,
    )
    # None of the tuning is counted.
    assert integrator.trials == 0
    integrator.step(400)
    # 400 trials of wells, which forget their energy in some ten, know it to 0.06. The spread of 40 errors knows the
    # step to 6 %, which is 0.03 again for second order; and it depends on the length of trajectories by some tenths.
    assert integrator.acceptanceRate == pytest.approx(0.8, abs=0.15)
    assert f"{tuned.stepsPerTrial} in a trial" in str(tuned)


def forces_made(context):
    """A clock for tests: every force takes as long."""
    return context.getIntegrator().forceEvaluations


@pytest.mark.thorough
def test_equal_seeds_tune_alike(monkeypatch):
    monkeypatch.setattr(tuning_measurements, "_seconds", forces_made)
    one, other, third = (tune(wells(n=3, seed=seed), trials=10, samples=10) for seed in (3, 3, 4))
    assert str(one) == str(other)
    assert one.schemeStepSize == other.schemeStepSize
    assert str(one) != str(third)


def test_the_cheapest_length_is_taken(monkeypatch):
    costs = {2: (8.0, 5.0), 3: (9.0, 1.0), 5: (7.0, math.nan)}

    def known(context, step, steps, samples):
        # As many steps for each length.
        assert samples == max(10, round(200 * 0.04 / (step * steps)))
        # Forces do not decide.
        return LengthFound(steps, 0.9, 100.0 / steps, costs[steps], seconds=0.01)

    monkeypatch.setattr(tuning, "try_length", known)
    tuned = tune(wells(), trials=10, lengths=[5, 3, 3, 2], schemes=["SIER2"])
    assert [each.steps for each in tuned.lengths] == [2, 3, 5]
    # With its error the first is dearer, and the last is not known.
    assert tuned.stepsPerTrial == 3


def test_a_length_that_does_not_reverse_is_left_out(monkeypatch):
    monkeypatch.setattr(metropolis, "reversal_error", lambda engine, steps: 1.0 if steps > 4 else 0.0)
    context = wells(n=4, extraChances=0)
    tuning = tune(context, trials=10, samples=10, lengths=[2, 8], schemes=["SIER2"])
    assert "missed its start" in tuning.lengths[1].refused
    assert "missed its start" in str(tuning)
    assert tuning.stepsPerTrial == 2
    with pytest.raises(openmm.OpenMMException, match="missed its start"):
        tune(context, trials=10, samples=10, lengths=[8], schemes=["SIER2"])


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
    with pytest.warns(UserWarning, match="A step of 4 fs is long"):
        tuning = tune(context, 0.05, trials=10, samples=10, schemes=[SIER2])
    refused = [each.step for each in tuning.schemes[0].tried if math.isinf(each.spread)]
    assert refused
    # What was refused is not tried again.
    assert all(one > other for one, other in itertools.pairwise(refused))
    # Stable up to 2/sqrt(2e4/0.5) = 0.01 ps.
    assert tuning.schemeStepSize < 0.01
    context.getIntegrator().step(1)


def test_steps_stay_where_kicks_do_not_resonate_with_fast_forces():
    """Without slow forces there is no energy error but that of inner steps, and the step grows to 0.45 periods."""
    period = 0.024
    context = bonded(12.0, (2 * math.pi / period) ** 2 * 6, fastForceGroups={1})
    with silence():
        tuning = tune(context, 0.05, trials=10, samples=10, schemes=[context.getIntegrator().scheme])
    assert tuning.schemeStepSize == pytest.approx(0.45 * period)


# --- schemes ---


@pytest.mark.parametrize(("own", "is_set"), [(SIER2V2, True), (SIER2, False)])
def test_the_cheapest_scheme_is_chosen(monkeypatch, own, is_set):
    """In springs a force of SIER2V2 carries a longer time than one of SIER2 does, for equal energy errors."""
    monkeypatch.setattr(tuning_measurements, "_seconds", forces_made)
    context = wells(n=4, scheme=own)
    integrator = context.getIntegrator()
    tuned = tune(context, trials=20, samples=20, schemes=["SIER2", "sier2v2", SIER2])
    assert [each.scheme for each in tuned.schemes] == [SIER2, SIER2V2]
    assert tuned.schemes[0].seconds > tuned.schemes[1].seconds
    assert (tuned.scheme, tuned.isSet) == (SIER2V2, is_set)
    assert (integrator.scheme, integrator.trials) == (own, 0)
    mine = tuned.schemes[1 if is_set else 0]
    assert integrator.getSchemeStepSize()._value == mine.step
    # The same length in time, in whole steps.
    assert integrator.getStepSize()._value == pytest.approx(
        tuned.schemeStepSize * tuned.stepsPerTrial, abs=mine.step / 2
    )
    assert ("make a new integrator" in str(tuned)) != is_set


def test_a_scheme_that_cannot_be_tried_is_left_out(monkeypatch):
    def refused(context, first, time, wanted, trials):
        if context.getIntegrator().scheme is SIER4G:
            raise openmm.OpenMMException("no step")
        return find_step(context, first, time, wanted, trials)

    find_step = tuning.find_step
    monkeypatch.setattr(tuning, "find_step", refused)
    tuned = tune(wells(n=4), trials=10, samples=10, schemes=[SIER4G, SIER2])
    assert (tuned.scheme, tuned.schemes[0].refused) == (SIER2, "no step")
    assert "SIER4G  no step" in str(tuned)
    with pytest.raises(openmm.OpenMMException, match="no step"):
        tune(wells(n=4), trials=10, samples=10, schemes=[SIER4G])


# --- substeps ---


def molecules(**options):
    """A Context of two molecules of water."""
    _, positions, system = cluster_system(2)
    return context_at(
        system, seeded(SIERHMCIntegrator(TEMPERATURE, 0.004, SIER2, 3, **options), 3), (positions, 0 * positions)
    )


def known_steps(monkeypatch):
    """Let one, two and three steps of RATTLE in a drift take 3, 1 and 2 s per ps, and return the numbers tried."""
    tried = []

    def find_step(context, first, time, wanted, trials):
        lines = [line for part in context.getIntegrator().program.parts for line in part]
        (number,) = {len(line.lengths) for line in lines if line.title == "drift"} or {0}
        tried.append(number)
        return [StepFound(first, spread_at(wanted), wanted, (9.0, 3.0, 1.0, 2.0)[number])], first

    monkeypatch.setattr(tuning, "find_step", find_step)
    return tried


@pytest.mark.parametrize(("given", "asked", "expected"), [(None, None, [1, 2, 3]), (1, [1, 2], [1, 2])])
def test_the_cheapest_number_of_substeps_is_chosen(monkeypatch, given, asked, expected):
    tried = known_steps(monkeypatch)
    context = molecules(engine="native", substeps=given)
    integrator = context.getIntegrator()
    found = tune(context, trials=10, samples=10, lengths=[3], schemes=[SIER2], substeps=asked)
    assert tried == expected
    assert [each.substeps for each in found.schemes] == [given, *expected[1:]]
    assert (found.scheme, found.substeps, found.isSet) == (SIER2, 2, False)
    assert "3 in a trial, drifts in 2 substeps" in str(found)
    # The Context keeps its own, at the step that was found for it.
    assert (integrator.substeps, integrator.getSchemeStepSize()._value) == (given, found.schemes[0].step)


@pytest.mark.parametrize(
    "options",
    [{}, {"engine": "native", "substeps": 1}, {"engine": "native", "fastForceGroups": {1}}],
    ids=["exact engine", "number given", "fast forces"],
)
def test_substeps_are_not_compared_where_they_are_given_or_no_steps_of_rattle(monkeypatch, options):
    tried = known_steps(monkeypatch)
    found = tune(molecules(**options), trials=10, samples=10, lengths=[3], schemes=[SIER2])
    assert len(tried) == 1
    assert found.isSet


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
    integrator, trial, count = context.getIntegrator(), tuning_measurements.make_trial, []

    def interrupted(*arguments):
        count.append(1)
        if len(count) > after:
            integrator.step(1)
            raise KeyboardInterrupt
        return trial(*arguments)

    monkeypatch.setattr(tuning_measurements, "make_trial", interrupted)
    with pytest.raises(KeyboardInterrupt):
        tune(context, trials=10, samples=10)
    assert (integrator.getSchemeStepSize()._value, integrator.getStepsPerTrial()) == (0.004, 4)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"acceptance": 1.0}, "acceptance must be between 0 and 1, got 1"),
        ({"acceptance": 0.0}, "acceptance must be between 0 and 1, got 0"),
        ({"trials": 9}, "trials must be at least 10, got 9"),
        ({"samples": 2.5}, "samples must be a whole number"),
        ({"lengths": [3, 0]}, "lengths must be at least 1, got 0"),
        ({"lengths": []}, "at least one number of steps"),
        ({"schemes": []}, "at least one scheme"),
        ({"schemes": ["SIER9"]}, "scheme must be one of SIER2"),
        ({"substeps": [0]}, "substeps must be at least 1, got 0"),
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
    with pytest.raises(TypeError, match="with a SIERHMCIntegrator, got a SIERIntegrator"):
        tune(context)
    with pytest.raises(ValueError, match="step must be above zero"):
        tune(wells(0.0))
