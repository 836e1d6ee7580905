"""Trials of hybrid Monte Carlo that OpenMM makes as a whole: decisions and failures."""

import math

import numpy as np
import openmm
import pytest

from openmm_sier import SIER2, SIER2V2, SIERHMCIntegrator
from openmm_sier.engines.native import trial_variables
from openmm_sier.ensembles import metropolis
from tests.support import anharmonic, spinning
from tests.support.samplers import counted, sampler
from tests.support.seeded import seeded
from tests.support.systems import assembled, field
from tests.support.waters import cluster_system, context_at, energies, phase_point, settled


@pytest.fixture(scope="module")
def cluster():
    return settled("cluster-4", *cluster_system(4))[1:]


def anharmonic_context(well_group=0, chances=0, steps=2, name="Reference", *others):
    """A Context in which half of the first ends are rejected, after 20 trials."""
    fast = {"fastForceGroups": {1}} if well_group else {}
    integrator = SIERHMCIntegrator(
        anharmonic.TEMPERATURE, 0.022, SIER2V2, steps, 2.0, engine="native", extraChances=chances, **fast
    )
    system = anharmonic.system(*others, well_group=well_group)
    x = anharmonic.positions()
    return context_at(system, seeded(integrator, 5), (x, np.zeros_like(x)), name, steps=20)


# --- the decision ---


@pytest.mark.parametrize("at_rest", [False, True])
def test_each_end_is_decided_by_the_same_number_on_its_own_energy(monkeypatch, at_rest):
    """A trial is repeated from a checkpoint with largest errors about those of its ends, and takes the first below."""
    removers = [openmm.CMMotionRemover()] if at_rest else []
    context = anharmonic_context(0, 2, 3, "Reference", *removers)
    integrator = context.getIntegrator()
    ends_seen = set()
    for _ in range(20):
        start, saved = phase_point(context), context.createCheckpoint()
        accepted, forces, energy = integrator.accepted, integrator.forceEvaluations, conserved(context)

        def outcome(largest, chances=2):
            context.loadCheckpoint(saved)  # noqa: B023
            monkeypatch.setattr(metropolis, "largest_error", lambda *_: largest)
            integrator.setExtraChances(chances)
            integrator.impl.tally.counts[metropolis.CHECKED_STEP] = integrator.getSchemeStepSize()._value
            forces = integrator.forceEvaluations
            integrator.step(1)
            return integrator.accepted - accepted, (integrator.forceEvaluations - forces) // 6  # noqa: B023

        errors = []
        for chances in range(3):
            assert outcome(-1e300, chances) == (0, chances + 1)
            errors.append(integrator.getGlobalVariableByName(trial_variables.END_ERROR))
            assert integrator.lastEnergyError == errors[0]
            assert np.array_equal(phase_point(context)[0], start[0])
            # A rejection adds nothing to the energy less heat.
            assert conserved(context) == pytest.approx(energy, abs=1e-9)
        for largest in [*errors, min(errors) - 1e-6]:
            end = next((i for i, error in enumerate(errors) if error <= largest), None)
            ends_seen.add(end)
            assert outcome(largest) == (end is not None, 3 if end is None else end + 1)
            change = 0.0 if end is None else errors[end] * anharmonic.KT
            # Sums of some hundred kJ/mol.
            assert conserved(context) - energy == pytest.approx(change, abs=1e-9)
    assert forces > 0
    assert ends_seen == {0, 1, 2, None}


def conserved(context):
    return sum(energies(context)) - context.getIntegrator().getHeat()._value


# --- restarts, changes and failures ---


def test_trials_of_other_lengths_steps_and_temperatures():
    """Settings of a trial may change between two trials, and apply to the next."""
    context = anharmonic_context()
    integrator = context.getIntegrator()
    energies_of_atoms = []
    integrator.setTemperature(600.0)
    integrator.setStepsPerTrial(4)
    integrator.setSchemeStepSize(0.01)
    for _ in range(3):
        integrator.step(1)
        forces, time = integrator.forceEvaluations, context.getTime()._value
        integrator.step(1)
        assert (integrator.forceEvaluations - forces) // 2 == 4
        assert context.getTime()._value - time == pytest.approx(0.04, rel=1e-10)
    for _ in range(400):
        integrator.step(1)
        energies_of_atoms.append(energies(context)[1])
    # 48 degrees of freedom. Each kinetic energy is nearly opposite to the one before, so that their mean is better than
    # that of as many independent ones: six standard errors of these.
    expected = 48 / 2 * 2 * anharmonic.KT
    assert np.mean(energies_of_atoms) == pytest.approx(expected, rel=6 * math.sqrt(2 / 48 / 400))


@pytest.mark.parametrize("name", ["Reference", "CPU"])
def test_ends_that_are_not_finite_are_rejected(name):
    """A particle in a well that ends at x = 0.3 nm. The start is restored, bit for bit, with reversed velocities."""
    integrator = sampler(0.02, 3, seed=6, engine="native")
    context = context_at(assembled([1.0], field("sqrt(0.09-x^2)-0.3", [0])), integrator, np.zeros((2, 1, 3)), name)
    failed = 0
    for _ in range(200):
        start = phase_point(context)[0]
        integrator.step(1)
        assert integrator.lastEnergyError > -1e300
        if math.isinf(integrator.lastEnergyError):
            failed += 1
            assert np.array_equal(phase_point(context)[0], start)
    assert failed > 3
    assert (context.getStepCount(), integrator.trials) == (200, 200)


@pytest.mark.parametrize(("name", "box"), [("Reference", None), ("Reference", 3.0), ("CPU", None)])
def test_ends_with_broken_constraints_are_rejected(monkeypatch, name, box):
    """Whatever their energy. In a box Reference makes steps, which Python decides on."""
    monkeypatch.setattr(metropolis, "largest_error", lambda *_: 1e15)
    integrator = seeded(SIERHMCIntegrator(300, spinning.STEP, SIER2, 1, None, engine="native", extraChances=0), 5)
    context = context_at(spinning.system(box), integrator, (spinning.POSITIONS, 0 * spinning.POSITIONS), name)
    assert integrator.impl.engine.makes_trials is (box is None)
    # Some 19. The seed is fixed, and momenta are drawn for each trial, so that no rounding grows.
    assert 3 < spinning.rejected(context, 60) < 50


def test_a_force_that_fails_in_mid_trial_leaves_the_last_sample():
    """At a call after the first few; the run then continues."""
    fails_at = math.inf
    calls = 0

    def force(state):
        nonlocal calls
        calls += 1
        if calls == fails_at:
            raise ValueError("no force")
        x = state.getPositions(asNumpy=True)._value
        return 500.0 * (x**2).sum(), -1000.0 * x

    integrator = sampler(0.01, 4, engine="native", frictionCoeff=3.0)
    context = context_at(
        assembled([10.0, 10.0, 0.0], openmm.PythonForce(force)), integrator, np.zeros((2, 3, 3)), steps=3
    )
    sample, before = phase_point(context)[0], counted(context)[3:5]
    energy = conserved(context)
    fails_at = calls + 3
    with pytest.raises(openmm.OpenMMException, match="no force"):
        integrator.step(5)
    assert np.array_equal(phase_point(context)[0], sample)
    assert (integrator.trials, counted(context)[3:5]) == (3, before)
    # Momenta were drawn, and their heat is counted.
    assert conserved(context) == pytest.approx(energy, abs=1e-9)
    integrator.step(2)
    assert integrator.trials == 5


# --- trials that fail ---


@pytest.mark.parametrize("engine", ["exact", "native"])
def test_the_centre_stays_where_a_trial_ends_in_nan(engine):
    """One atom has walls of NaN 1e-4 nm from it. There trials fail, and behind them none begins."""
    system = openmm.System()
    for _ in range(40):
        system.addParticle(16.0)
    wall = openmm.CustomExternalForce("select(step(abs(x - middle) - 1e-4), sqrt(-1 - x*x), 0)")
    wall.addGlobalParameter("middle", 0)
    wall.addParticle(0)
    system.addForce(wall)
    system.addForce(openmm.CMMotionRemover(1))
    positions = np.random.default_rng(0).random((40, 3))
    integrator = seeded(SIERHMCIntegrator(300, 0.004, stepsPerTrial=8, engine=engine), 7)
    context = context_at(system, integrator, (positions, np.zeros_like(positions)), "CPU")
    failed = 0
    for _ in range(20):
        context.setParameter("middle", phase_point(context)[0][0, 0])
        integrator.step(1)
        failed += not math.isfinite(integrator.lastEnergyError)
        # Of velocities of 0.4 nm/ps, to rounding.
        assert np.abs(phase_point(context)[1].mean(axis=0)).max() < 1e-14
    # In a trial the atom goes 0.01 nm, and less than 1e-4 in one of a hundred.
    assert failed > 10
    before = phase_point(context)
    context.setParameter("middle", -1e6)
    with pytest.raises(openmm.OpenMMException, match="step 21 is nan"):
        integrator.step(1)
    assert np.array_equal(phase_point(context), before)
    assert (integrator.trials, context.getStepCount()) == (20, 20)
