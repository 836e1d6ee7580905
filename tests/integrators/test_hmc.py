"""Hybrid Monte Carlo as users of OpenMM meet it: samples, restarts in mid-trial, changes from outside, refusals."""

from __future__ import annotations

import copy
import math
import warnings

import numpy as np
import openmm
import pytest
from openmm import app, unit

from openmm_sier import SIER2, SIER4G, Scheme, SIERHMCIntegrator, SIERIntegrator
from openmm_sier.observe.reporters import ConservationReporter
from tests.support.methanols import positions_of, system_of
from tests.support.restarts import assert_same
from tests.support.samplers import KT, counted, energies_computed, sampler
from tests.support.waters import cluster_system, context_at, energies, periodic_system, phase_point, platform, relaxed

#: Settings of either engine. Two equal substeps are short enough for SETTLE at the steps of these tests.
ENGINES = pytest.mark.parametrize("engine", [{}, {"engine": "native", "substeps": 2}], ids=["exact", "native"])


@pytest.fixture(scope="module")
def cluster():
    topology, positions, system = cluster_system(4)
    return system, relaxed(topology, positions, system)


def conserved(context):
    return sum(energies(context)) - context.getIntegrator().getHeat()._value


def test_samples_are_at_multiples_of_the_trial(cluster):
    """After a rejection the Context is where the last sample was; the conserved energy counts accepted errors alone."""
    integrator = sampler()
    context = context_at(cluster[0], integrator, cluster[1])
    # Velocities of another integrator are not quite those of rigid bodies.
    integrator.step(4)
    seen = set()
    for trial in range(2, 25):
        before, energy, accepted = phase_point(context), conserved(context), integrator.accepted
        integrator.step(3)
        assert integrator.trials == trial - 1
        assert not np.array_equal(phase_point(context)[0], before[0])
        integrator.step(1)
        assert integrator.trials == trial
        is_accepted = integrator.accepted > accepted
        seen.add(is_accepted)
        assert np.array_equal(phase_point(context)[0], before[0]) is not is_accepted
        # Kinetic energies of the Context are rounded to some 1e-9 kJ/mol, and so are those of the bodies.
        change = integrator.lastEnergyError * KT if is_accepted else 0.0
        assert conserved(context) - energy == pytest.approx(change, abs=1e-7)
    assert seen == {True, False}
    assert integrator.acceptanceRate == integrator.accepted / 24
    assert 0 < integrator.reversalError < 1e-10
    integrator.resetStatistics()
    assert integrator.trials == 0
    assert math.isnan(integrator.acceptanceRate)


@pytest.mark.parametrize("options", [{}, {"frictionCoeff": 20.0}], ids=["drawn anew", "kept in part"])
@pytest.mark.parametrize("after", [0, 2, 3])
@ENGINES
def test_restart_in_mid_trial_is_bit_identical(cluster, after, options, engine):
    options = {**options, **engine}
    integrator = sampler(0.011, **options)
    context = context_at(cluster[0], integrator, cluster[1])
    # The trial in progress is to be one that is rejected, so that its start matters.
    while True:
        integrator.step(after)
        whole_state = context.getState(positions=True, velocities=True, integratorParameters=True)
        restarts, accepted = [context.createCheckpoint(), whole_state], integrator.accepted
        integrator.step(4 - after)
        if integrator.accepted == accepted:
            break
    integrator.step(10)
    for restart, load in zip(restarts, ("loadCheckpoint", "setState"), strict=True):
        again = sampler(0.011, **options)
        other = openmm.Context(cluster[0], again, platform())
        getattr(other, load)(restart)
        for count in (1, 13 - after):
            again.step(count)
        assert_same(counted(other), counted(context))
    # The Context that went on can go back, too.
    end = counted(context)
    context.loadCheckpoint(restarts[0])
    integrator.step(14 - after)
    assert_same(counted(context), end)


def test_constant_pressure_moves_the_volume_between_trials():
    topology, positions, system = periodic_system()
    point = relaxed(topology, positions, system, steps=100)
    integrator = sampler(0.003, 2, pressure=1000 * unit.bar, barostatInterval=2)
    context = context_at(system, integrator, point, "CPU")

    def volume():
        return context.getState().getPeriodicBoxVolume()._value

    volumes = [volume()]
    for _ in range(20):
        integrator.step(1)
        volumes.append(volume())
        # A CMMotionRemover is there.
        assert np.abs(context.getIntegrator().getBodyState().p.sum(axis=1)).max() < 1e-9
    changed = {step for step in range(20) if volumes[step] != volumes[step + 1]}
    assert changed
    # Before the first step of every second trial.
    assert all(step % 4 == 2 for step in changed)
    middle = context.createCheckpoint()
    integrator.step(7)
    end = counted(context)
    again = sampler(0.003, 2, pressure=1000 * unit.bar, barostatInterval=2)
    other = context_at(system, again, point, "CPU")
    other.loadCheckpoint(middle)
    again.step(7)
    assert_same(counted(other), end)


def test_positions_set_in_mid_trial_end_it(cluster):
    integrator = sampler()
    context = context_at(cluster[0], integrator, cluster[1])
    integrator.step(6)
    context.setPositions(phase_point(context)[0] + 0.25)
    for _ in range(2):
        found = integrator.getBodyState()
        assert found.trial is None
    integrator.step(1)
    # The next trial begins there, and ends at the next multiple of its length.
    assert np.array_equal(integrator.getBodyState().trial.start.q, found.q)
    assert integrator.trials == 1
    integrator.step(1)
    assert integrator.trials == 2


@pytest.mark.parametrize("change", ["step size", "parameter", "force"])
def test_a_trial_is_given_up_where_its_energy_means_nothing(cluster, change):
    system = copy.deepcopy(cluster[0])
    field = openmm.CustomExternalForce("field*x")
    field.addGlobalParameter("field", 0.0)
    field.addParticle(0)
    system.addForce(field)
    integrator = sampler(0.0005)
    context = context_at(system, integrator, cluster[1])
    integrator.step(4)
    sample = integrator.getBodyState()
    integrator.step(2)
    begun = integrator.getBodyState()
    if change == "step size":
        integrator.setStepSize(0.0006)
    elif change == "parameter":
        context.setParameter("field", 1e-6)
    else:
        field.updateParametersInContext(context)
    integrator.step(1)
    found = integrator.getBodyState()
    # One step of another trial, whose momenta were drawn from the sample's again.
    assert np.array_equal(found.trial.start.q, sample.q)
    assert (found.trial.left, found.draws) == (1, begun.draws + 1)
    one_step = found.trial.h * np.abs(found.trial.start.p / integrator.bodies.masses).max()
    assert np.abs(found.q - sample.q).max() < 1.2 * one_step


@pytest.mark.parametrize("change", ["parameter", "force", "groups"])
def test_a_change_between_trials_changes_the_energy_of_the_sample(cluster, change):
    system = copy.deepcopy(cluster[0])
    field = openmm.CustomExternalForce("field*(y-2)*strength")
    field.addGlobalParameter("field", 100.0)
    field.addPerParticleParameter("strength")
    field.addParticle(0, [1.0])
    field.setForceGroup(1)
    system.addForce(field)
    integrator = sampler(0.0002)
    context = context_at(system, integrator, cluster[1])
    integrator.step(4)
    if change == "parameter":
        context.setParameter("field", 50.0)
    elif change == "force":
        field.setParticleParameters(0, 0, [0.5])
        field.updateParametersInContext(context)
    else:
        integrator.setIntegrationForceGroups({0})
    integrator.step(4)
    # The change is some 40 kT, the scheme's own error in 0.8 fs below 0.01.
    assert abs(integrator.lastEnergyError) < 0.1


def test_energies_are_computed_once(cluster, monkeypatch):
    """A trial takes one evaluation of the energy, that of its end."""
    integrator = sampler(0.011)
    _context = context_at(cluster[0], integrator, cluster[1])
    integrator.step(4)
    computed = energies_computed(monkeypatch)
    integrator.step(40)
    assert 0 < integrator.accepted < 11
    assert sum(computed) == 10


def test_without_a_change_a_trial_goes_on(cluster):
    integrator = sampler(0.0005)
    context = context_at(cluster[0], integrator, cluster[1])
    integrator.step(6)
    begun = integrator.getBodyState()
    context.setVelocities(phase_point(context)[1])
    integrator.step(1)
    found = integrator.getBodyState()
    assert (found.trial.left, found.draws) == (1, begun.draws)


def test_forces_that_are_not_finite_reject_a_trial():
    """A particle in a well that ends at x = 0.3 nm: what leaves it is rejected, and the run goes on."""
    system = openmm.System()
    system.addParticle(1.0)
    well = openmm.CustomExternalForce("sqrt(0.09-x^2)-0.3")
    well.addParticle(0)
    system.addForce(well)
    integrator = sampler(0.02, 3)
    context = context_at(system, integrator, (np.zeros((1, 3)), np.zeros((1, 3))))
    places, failed = [], 0
    for _ in range(60):
        integrator.step(3)
        places.append(phase_point(context)[0][0, 0])
        failed += math.isinf(integrator.lastEnergyError)
    assert failed > 3
    assert integrator.accepted > 3
    assert np.abs(places).max() < 0.3
    # Where there is no energy to begin with, nothing goes on.
    context.setPositions([[0.5, 0.0, 0.0]])
    with pytest.raises(openmm.OpenMMException, match="energy is nan"):
        integrator.step(1)


@pytest.mark.parametrize(("friction", "kept"), [(None, 0.0), (40.0, math.exp(-40 * 4 * 0.001))])
def test_momenta_that_a_trial_keeps(cluster, friction, kept):
    integrator = sampler(0.001, frictionCoeff=friction)
    context = context_at(cluster[0], integrator, cluster[1])
    context.setVelocities(1000 * cluster[1][1])
    before = integrator.getBodyState().p
    integrator.step(1)
    # What was drawn is a thousandth of what was set.
    assert integrator.getBodyState().trial.start.p == pytest.approx(kept * before, abs=0.005 * np.abs(before).max())


def test_constrained_molecules():
    integrator = sampler(0.004, 3, SIER4G)
    positions = positions_of(2)
    _context = context_at(system_of(2), integrator, (positions, np.zeros_like(positions)))
    integrator.step(9)
    assert integrator.trials == 3
    # Constraints are solved to rounding, and so trajectories reverse to it.
    assert integrator.reversalError < 1e-10
    assert abs(integrator.lastEnergyError) < 100


def test_a_trajectory_that_does_not_come_back_is_refused(cluster, monkeypatch):
    integrator = sampler()
    context = context_at(cluster[0], integrator, cluster[1])
    monkeypatch.setattr("openmm_sier.dynamics.metropolis.reversal_error", lambda *_: 2e-4)
    with pytest.raises(openmm.OpenMMException, match=r"4 steps .* missed its start by 2.0e-04 nm"):
        integrator.step(1)
    # The Context is at its start, but for fitting the bodies.
    assert phase_point(context)[0] == pytest.approx(cluster[1][0], abs=1e-6)


def test_longer_trajectories_are_checked_again(cluster, monkeypatch):
    """Chaos makes the error of reversal grow with the length: what a short trajectory showed says nothing."""
    integrator = sampler(n=2)
    context = context_at(cluster[0], integrator, cluster[1])
    integrator.step(2)
    monkeypatch.setattr("openmm_sier.dynamics.metropolis.reversal_error", lambda *_: 2e-4)
    integrator.setStepsPerTrial(1)
    integrator.step(2)
    integrator.setStepsPerTrial(2)
    with pytest.raises(openmm.OpenMMException, match=r"2 steps .* missed its start"):
        integrator.step(1)
    assert context.getStepCount() == 4


@ENGINES
def test_a_trial_is_finished_at_the_next_multiple(cluster, engine):
    integrator = sampler(0.0005, **engine)
    context = context_at(cluster[0], integrator, cluster[1])
    integrator.step(6)
    integrator.setStepsPerTrial(7)
    integrator.finishTrial()
    # The trial in progress ends at step 8, and a shorter one leads to step 14.
    assert (context.getStepCount(), integrator.trials) == (14, 3)
    before = context.createCheckpoint()
    integrator.finishTrial()
    assert context.createCheckpoint() == before
    # The energy of the sample is that of its trial.
    assert integrator._sampled_energy() == pytest.approx(energies(context)[0], rel=1e-12)


CROOKED = Scheme("Euler", (("kick", 1.0), ("drift", 1.0)))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"temperature": 0}, "temperature must be above zero"),
        ({"frictionCoeff": 0}, "frictionCoeff must be above zero"),
        ({"stepsPerTrial": 0}, "stepsPerTrial must be at least 1"),
        ({"stepsPerTrial": 2.5}, "stepsPerTrial must be a whole number"),
        ({"pressure": 1, "barostatInterval": 0}, "barostatInterval must be at least 1"),
        ({"scheme": SIER2.with_bath()}, "has a bath"),
        ({"scheme": CROOKED}, "is no palindrome"),
    ],
)
def test_arguments_that_make_no_sense(options, message):
    with pytest.raises(ValueError, match=message):
        SIERHMCIntegrator(**{"temperature": 300, "stepSize": 0.002, **options})


def test_reports_of_what_is_no_sample_are_warned_about_once(cluster, tmp_path):
    topology = cluster_system(4)[0]
    simulation = app.Simulation(topology, cluster[0], sampler(n=4), platform())
    simulation.context.setPositions(cluster[1][0])
    simulation.reporters.append(ConservationReporter(tmp_path / "samples.csv", 8))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        simulation.step(8)
    simulation.reporters.append(ConservationReporter(tmp_path / "others.csv", 6))
    with pytest.warns(UserWarning, match="every 6 steps, and trials of hybrid Monte Carlo have 4") as told:
        simulation.step(12)
    assert len(told) == 1
    # Steps 8 and 16: the second row is of four trials.
    rows = np.genfromtxt(tmp_path / "samples.csv", delimiter=",", names=True, deletechars="")
    assert rows["Acceptance"][0] in (0, 0.5, 1)
    assert rows["Energy_Error_(kT)"].shape == (2,)
    other = app.Simulation(topology, cluster[0], SIERIntegrator(0.001), platform())
    other.context.setPositions(cluster[1][0])
    other.reporters.append(ConservationReporter(tmp_path / "samples.csv", 1, append=True))
    with pytest.raises(ValueError, match="20 columns, and this integrator has 18"):
        other.step(1)


@pytest.mark.parametrize(
    ("force", "remedy"),
    [
        (openmm.MonteCarloBarostat(1, 300), "give `pressure` instead"),
        (openmm.AndersenThermostat(300, 1), "leave it out"),
    ],
)
def test_what_acts_within_trajectories_is_refused(force, remedy):
    system = periodic_system()[2]
    system.addForce(force)
    with pytest.raises(openmm.OpenMMException, match=remedy):
        openmm.Context(system, sampler(), platform())
