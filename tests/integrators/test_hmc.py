"""Hybrid Monte Carlo as users of OpenMM meet it, with either engine: samples, restarts, changes from outside."""

import math

import numpy as np
import openmm
import pytest
from openmm import app, unit
from scipy import stats

from openmm_sier import SIER2, SIER2V2, SIER4G, Scheme, SIERHMCIntegrator, SIERIntegrator
from openmm_sier.dynamics.acceptance import TRIAL_FRICTION, TRIAL_LENGTH, usual_chances
from openmm_sier.ensembles import metropolis
from tests.support.samplers import KT, counted, sampler, states_asked
from tests.support.systems import assembled, field, rotors, with_forces
from tests.support.waters import cluster_system, context_at, energies, periodic_system, phase_point, platform, settled

#: Settings of either engine. Two equal substeps are short enough for SETTLE at the steps of these tests.
ENGINES = pytest.mark.parametrize("engine", [{}, {"engine": "native", "substeps": 2}], ids=["exact", "native"])
PARTS_KEPT = pytest.mark.parametrize("options", [{}, {"frictionCoeff": 20.0}], ids=["drawn anew", "kept in part"])


CROOKED = Scheme("Euler", (("kick", 1.0), ("drift", 1.0)))


@pytest.fixture(scope="module")
def cluster():
    return settled("cluster-4", *cluster_system(4))[1:]


def conserved(context):
    return sum(energies(context)) - context.getIntegrator().getHeat()._value


@pytest.mark.usefixtures("coin")
@PARTS_KEPT
@ENGINES
def test_a_step_is_a_trial(cluster, options, engine):
    """After a rejection the Context is where the last sample was; the conserved energy counts accepted errors alone."""
    integrator = sampler(0.010, extraChances=0, **options, **engine)
    context = context_at(cluster[0], integrator, cluster[1])
    assert integrator.engine == engine.get("engine", "exact")
    # Velocities of another integrator are not quite those of rigid bodies.
    integrator.step(1)
    seen = set()
    for trial in range(2, 31):
        before, energy, accepted = phase_point(context), conserved(context), integrator.accepted
        integrator.step(1)
        assert (integrator.trials, context.getStepCount()) == (trial, trial)
        is_accepted = integrator.accepted > accepted
        seen.add(is_accepted)
        assert np.array_equal(phase_point(context)[0], before[0]) is not is_accepted
        # Kinetic energies of the Context are rounded to some 1e-9 kJ/mol, and so are those of the bodies.
        change = integrator.lastEnergyError * KT if is_accepted else 0.0
        assert conserved(context) - energy == pytest.approx(change, abs=1e-7)
    assert seen == {True, False}
    # Sums of thirty numbers.
    assert context.getTime()._value == pytest.approx(30 * 4 * 0.010, rel=1e-14)
    assert integrator.acceptanceRate == integrator.accepted / 30
    # The exact engine reverses to rounding, SETTLE's lengths are of single precision, 5e-9 nm a step.
    assert 0 <= integrator.reversalError < (1e-7 if engine else 1e-10)
    integrator.resetStatistics()
    assert integrator.trials == 0
    assert math.isnan(integrator.acceptanceRate)


@pytest.mark.parametrize("step", [SIER2V2.trial_step, SIER2V2.heavy_trial_step, 9 * unit.femtoseconds])
def test_trials_have_a_usual_length(step):
    integrator = SIERHMCIntegrator(300, step)
    assert integrator.scheme is SIER2V2
    assert integrator.getFriction()._value == TRIAL_FRICTION
    assert math.isinf(SIERHMCIntegrator(300, step, frictionCoeff=None).getFriction()._value)
    # In whole steps.
    assert integrator.getStepSize()._value == pytest.approx(TRIAL_LENGTH, abs=integrator.getSchemeStepSize()._value / 2)
    # Where nothing moves any number is as good.
    assert SIERHMCIntegrator(300, 0).getStepsPerTrial() == 1


def test_steps_of_trials_and_of_the_scheme(cluster, tmp_path):
    """The Context's time, and the time between frames in OpenMM's trajectories, are those of trials."""
    integrator = SIERHMCIntegrator(300, 0.002, SIER2, stepsPerTrial=5)
    assert integrator.getStepSize() == 0.01 * unit.picosecond
    assert integrator.getSchemeStepSize() == 0.002 * unit.picosecond
    integrator.setStepSize(integrator.getStepSize())
    assert integrator.getSchemeStepSize() == 0.002 * unit.picosecond
    integrator.setStepsPerTrial(4)
    assert integrator.getStepSize()._value == pytest.approx(0.008, rel=1e-15)
    integrator.setSchemeStepSize(1 * unit.femtosecond)
    assert integrator.getStepSize()._value == pytest.approx(0.004, rel=1e-15)
    simulation = app.Simulation(cluster_system(4)[0], cluster[0], integrator, platform())
    simulation.context.setPositions(cluster[1][0])
    simulation.reporters.append(app.DCDReporter(str(tmp_path / "samples.dcd"), 2))
    simulation.step(4)
    header = (tmp_path / "samples.dcd").read_bytes()[8:48]
    every, dt = int.from_bytes(header[8:12], "little"), np.frombuffer(header[36:40], "<f4")[0]
    # In units of AKMA, 0.04888821 ps, in single precision.
    assert every * dt * 0.04888821 == pytest.approx(simulation.context.getTime()._value / 2, rel=1e-6)


@pytest.mark.parametrize(("first", "second"), [("exact", "native"), ("native", "exact")])
def test_the_other_engine_continues_from_a_sample(cluster, first, second):
    one, other = (sampler(engine=engine, substeps=2) for engine in (first, second))
    context, later = (context_at(cluster[0], integrator, cluster[1]) for integrator in (one, other))
    one.step(2)
    sample, energy = phase_point(context)[0], conserved(context)
    later.loadCheckpoint(context.createCheckpoint())
    # Bodies are fitted to rounding, and SETTLE leaves 5e-9 nm.
    assert phase_point(later)[0] == pytest.approx(sample, abs=1e-8)
    assert conserved(later) == pytest.approx(energy, abs=1e-3)
    other.step(1)
    assert (other.trials, later.getStepCount()) == (3, 3)


@pytest.mark.usefixtures("coin")
@ENGINES
def test_constant_pressure_moves_the_volume_between_trials(engine):
    _, system, point = settled("box-59", *periodic_system())
    options = {"pressure": 1000 * unit.bar, "barostatInterval": 2, "frictionCoeff": 30, "extraChances": 0}
    integrator = sampler(0.003, 2, **options, **engine)
    context = context_at(system, integrator, point, "CPU")

    def volume():
        return context.getState().getPeriodicBoxVolume()._value

    integrator.step(1)
    volumes, energy = [volume()], conserved(context)
    for _ in range(20):
        accepted = integrator.accepted
        integrator.step(1)
        volumes.append(volume())
        # A CMMotionRemover is there, and what it takes is counted as heat.
        assert np.abs(integrator.getBodyState().p.sum(axis=1)).max() < 1e-9
        change = integrator.lastEnergyError * KT if integrator.accepted > accepted else 0.0
        # Forces in single precision: energies of one place differ by some 1e-3 kJ/mol with the neighbour list.
        assert conserved(context) - energy == pytest.approx(change, abs=2e-2)
        energy = conserved(context)
    changed = {step for step in range(20) if volumes[step] != volumes[step + 1]}
    assert changed
    # Before every second trial.
    assert all(step % 2 == 0 for step in changed)


class Decision:
    """A largest error that the end with a given number satisfies, whatever its energy, and no other."""

    def __init__(self, wanted):
        self.wanted = wanted
        self.errors = []

    def __ge__(self, error):
        self.errors.append(error)
        return len(self.errors) == self.wanted


def test_a_trajectory_that_would_be_rejected_continues(cluster, monkeypatch):
    """Each of its ends is accepted or not by the same random number, on its own energy; forces are counted.

    In turn the first, the second, the third end and none is accepted, whatever its energy. `test_whole_trials.py` has
    a test of trials that OpenMM makes as a whole.
    """
    integrator = sampler(0.010, extraChances=2, scheme=SIER2)
    context = context_at(cluster[0], integrator, cluster[1], steps=1)
    requests = []

    def decide(seed, draw):
        requests.append((seed, draw))
        return decision

    monkeypatch.setattr(metropolis, "largest_error", decide)
    for wanted in (1, 2, 3, 4) * 3:
        decision = Decision(wanted)
        before, forces = conserved(context), integrator.forceEvaluations
        accepted, place = integrator.accepted, phase_point(context)[0]
        integrator.step(1)
        errors = decision.errors
        assert len(errors) == min(wanted, 3)
        assert (integrator.forceEvaluations - forces) // 4 == len(errors)
        assert integrator.accepted - accepted == (wanted < 4)
        assert np.array_equal(phase_point(context)[0], place) is (wanted == 4)
        assert integrator.lastEnergyError == errors[0]
        # Kinetic energies of the Context are rounded to some 1e-9 kJ/mol, and so are those of the bodies.
        change = errors[-1] * KT if wanted < 4 else 0.0
        assert conserved(context) - before == pytest.approx(change, abs=1e-7)
    assert len(requests) == len(set(requests)) == 12
    assert context.getTime()._value == pytest.approx(13 * 4 * 0.010, rel=1e-13)
    assert (integrator.getExtraChances(), sampler(extraChances=0).getExtraChances()) == (2, 0)


def test_long_trials_do_not_continue():
    assert list(map(usual_chances, (0.02, 0.072, 0.09, 0.108, 0.11, 0.5, 0))) == [2, 2, 1, 1, 0, 0, 0]
    assert SIERHMCIntegrator(300, 0.009).getExtraChances() is None
    with pytest.raises(ValueError, match=r"extraChances .*-1"):
        SIERHMCIntegrator(300, 0.009, extraChances=-1)


@pytest.mark.parametrize(("engine", "kept", "at_rest"), [("exact", True, True), ("native", False, False)])
def test_kinetic_energies_of_trials_are_canonical_and_opposite(engine, kept, at_rest):
    """Without forces the kinetic energy of a trial is as it was drawn, and its rank is opposite to the one before.

    Of 13 degrees of freedom the centre of mass has three. One more or less shifts the mean by some 8 %, and 1000
    energies allow 5 %, the less since they are opposite to each other. Every 20th is nearly independent of the one
    before, and a right sampler fails the test of their distribution with a probability of 1e-9.
    """
    system, positions = rotors()
    system = with_forces(system, openmm.CMMotionRemover()) if at_rest else system
    options = {"frictionCoeff": 20.0} if kept else {}
    integrator = sampler(0.001, 1, engine=engine, **options)
    _context = context_at(system, integrator, (positions, np.zeros_like(positions)), steps=10)
    freedoms, result = (10 if at_rest else 13), []
    for _ in range(1000):
        integrator.step(1)
        result.append(2 * integrator.impl.engine.kinetic_energy() / KT)
    assert stats.kstest(result[::20], stats.chi2(freedoms).cdf).pvalue > 1e-9
    assert np.mean(result) == pytest.approx(freedoms, rel=4 * math.sqrt(2 / freedoms / 1000))
    opposite = stats.spearmanr(result[1:], result[:-1]).statistic
    if at_rest:
        # The energy that is over-relaxed has that of the centre of mass, which is drawn anew: 3 of 13 freedoms here.
        assert opposite < -0.25
    else:
        # Those of `test_acceptance.py`.
        assert opposite == pytest.approx(-14 / 17, abs=4 * (1 - (14 / 17) ** 2) / 1000**0.5)


@ENGINES
@pytest.mark.parametrize("change", ["positions", "parameter", "force", "groups", "box"])
def test_a_change_between_trials_changes_the_energy_of_the_sample(change, engine):
    _, positions, system = periodic_system(removeCMMotion=False)
    pull = openmm.CustomExternalForce("field*(y-2)*strength")
    pull.addGlobalParameter("field", 100.0)
    pull.addPerParticleParameter("strength")
    pull.addParticle(0, [1.0])
    pull.setForceGroup(1)
    system.addForce(pull)
    integrator = sampler(0.00005, **engine)
    context = context_at(system, integrator, (positions, np.zeros_like(positions)), steps=1)
    pull.setParticleParameters(0, 0, [0.5])
    wider = (1.01 * vector for vector in context.getState().getPeriodicBoxVectors())
    changes = {
        "positions": lambda: context.setPositions(phase_point(context)[0] + 0.25),
        "parameter": lambda: context.setParameter("field", 50.0),
        "force": lambda: pull.updateParametersInContext(context),
        "groups": lambda: integrator.setIntegrationForceGroups({0}),
        "box": lambda: context.setPeriodicBoxVectors(*wider),
    }
    changes[change]()
    integrator.step(1)
    # The change is some 10 kT or more, the scheme's own error in 0.2 fs below 0.06.
    assert abs(integrator.lastEnergyError) < 0.1


@ENGINES
def test_forces_that_are_not_finite_reject_a_trial(engine):
    """A particle in a well that ends at x = 0.3 nm: trials that leave it are rejected, and the run continues."""
    system = assembled([1.0], field("sqrt(0.09-x^2)-0.3", [0]))
    integrator = sampler(0.02, 3, seed=6, **engine)
    context = context_at(system, integrator, (np.zeros((1, 3)), np.zeros((1, 3))))
    places, failed = [], 0
    for _ in range(200):
        integrator.step(1)
        places.append(phase_point(context)[0][0, 0])
        failed += math.isinf(integrator.lastEnergyError)
    assert failed > 3
    assert integrator.accepted > 3
    assert (context.getStepCount(), integrator.trials) == (200, 200)
    assert np.abs(places).max() < 0.3
    # Where there is no energy to begin with, nothing goes on.
    context.setPositions([[0.5, 0.0, 0.0]])
    with pytest.raises(openmm.OpenMMException, match="step 201 is nan"):
        integrator.step(1)
    assert context.getStepCount() == 200


def test_a_trial_that_failed_in_mid_step_leaves_nothing_to_the_next():
    """Virtual sites divide a step into four of OpenMM, and the CPU platform stops within one where atoms are nowhere.

    In one call of `step` and in many the trials are the same.
    """
    points, places, failed = np.zeros((3, 3)), [], 0
    for calls in (1, 60):
        system = assembled([1.0, 1.0, 0.0], field("sqrt(0.09-x^2)-0.3", [0]))
        system.setVirtualSite(2, openmm.TwoParticleAverageSite(0, 1, 0.5, 0.5))
        integrator = sampler(0.02, 3, SIER4G, seed=5, engine="native")
        context = context_at(system, integrator, (points, points), "CPU")
        for _ in range(calls):
            integrator.step(60 // calls)
            failed += math.isinf(integrator.lastEnergyError)
        places.append(phase_point(context)[0])
    assert failed > 2
    assert np.array_equal(*places)


@pytest.mark.usefixtures("coin")
@pytest.mark.parametrize("at_rest", [False, True])
def test_a_native_trial_reads_no_atoms(cluster, monkeypatch, at_rest):
    """On GPUs each reading of positions or velocities waits for the device, and takes longer than the host's work."""
    system = with_forces(cluster[0], openmm.CMMotionRemover()) if at_rest else cluster[0]
    integrator = sampler(0.010, engine="native", substeps=2, extraChances=0)
    _context = context_at(system, integrator, cluster[1], steps=5)
    # The watch for runaways reads velocities now and then.
    monkeypatch.setattr(integrator.impl.session.watch, "look", lambda *_: None)
    requests, accepted = states_asked(monkeypatch), integrator.accepted
    for _ in range(30):
        integrator.step(1)
    assert 0 < integrator.accepted - accepted < 30
    read = openmm.State.Positions | openmm.State.Velocities | openmm.State.Forces | openmm.State.Energy
    assert not any(kinds & read for kinds in requests)


def test_the_energy_of_an_end_comes_with_its_force(cluster, monkeypatch):
    """A trial of the exact engine has no evaluation for its energy alone."""
    for scheme in (SIER2, SIER4G):
        integrator = sampler(scheme=scheme, engine="exact", extraChances=0)
        _context = context_at(cluster[0], integrator, cluster[1], steps=2)
        requests = states_asked(monkeypatch)
        integrator.step(10)
        energies = [kinds for kinds in requests if kinds & openmm.State.Energy]
        assert len(energies) == 10
        assert all(kinds & openmm.State.Forces for kinds in energies)


@ENGINES
def test_a_trajectory_that_does_not_come_back_is_refused(cluster, monkeypatch, engine):
    integrator = sampler(**engine)
    context = context_at(cluster[0], integrator, cluster[1], steps=1)
    before = counted(context)
    integrator.setSchemeStepSize(0.009)
    with monkeypatch.context() as patch:
        patch.setattr("openmm_sier.ensembles.metropolis.REVERSIBLE", -1.0)
        with pytest.raises(openmm.OpenMMException, match=r"12 steps.* missed its start"):
            integrator.step(1)
        # The native engine's constraints leave 1e-9 nm when momenta are drawn.
        for one, other in zip(counted(context), before, strict=True):
            assert one == pytest.approx(other, abs=1e-8)
        # Chaos makes the error of reversal grow with the length: what a short trajectory showed says nothing.
        integrator.setSchemeStepSize(0.008)
        integrator.setStepsPerTrial(2)
        integrator.step(1)
        integrator.setStepsPerTrial(4)
        with pytest.raises(openmm.OpenMMException, match=r"12 steps.* missed its start"):
            integrator.step(1)
    integrator.step(1)


@pytest.mark.parametrize(
    ("precision", "allowed", "steps", "words"),
    [
        ("single", 1e-2, 4, r"1e-02 nm is allowed in single precision.*a platform and {'Precision': 'mixed'}$"),
        ("mixed", 1e-4, 12, r"1e-04 nm is allowed in mixed precision.*fewer extraChances$"),
        (None, 1e-4, 12, r"1e-04 nm is allowed\. .*fewer extraChances$"),
    ],
)
def test_rounding_in_single_precision_may_miss_the_start_by_more(
    cluster, monkeypatch, precision, allowed, steps, words
):
    """It hides whether later ends are reversible."""
    integrator = sampler()
    # Kept: an integrator's Context must live as long as it is asked.
    context = context_at(cluster[0], integrator, cluster[1], steps=0)
    engine = integrator.impl.engine
    assert engine.precision is None
    monkeypatch.setattr(engine, "precision", precision)
    monkeypatch.setattr(metropolis, "reversal_error", lambda *_: 1.01 * allowed)
    with pytest.raises(openmm.OpenMMException, match=f"{steps} steps.*{words}"):
        integrator.step(1)
    monkeypatch.setattr(metropolis, "reversal_error", lambda *_: 0.99 * allowed)
    integrator.step(1)
    assert context.getStepCount() == 1


def test_only_trajectories_of_schemes_that_are_no_palindromes_miss_their_start(cluster):
    system, point = cluster
    results = {}
    for scheme in (SIER4G, CROOKED):
        integrator = SIERIntegrator(0.002, scheme)
        # Kept: an integrator's Context must live as long as it is asked.
        context = context_at(system, integrator, point, steps=0)
        results[scheme.name] = metropolis.reversal_error(integrator.impl.engine, 10)
        integrator.step(1)
        assert context.getStepCount() == 1
    # Rounding of 1e-16 nm in twenty steps, which water hardly magnifies in 0.04 ps.
    assert results[SIER4G.name] < 1e-11
    assert results[CROOKED.name] > metropolis.REVERSIBLE


@pytest.mark.parametrize(
    ("force", "remedy"),
    [
        (openmm.MonteCarloBarostat(1, 300), "Remove the MonteCarloBarostat: .* give it pressure=1"),
        (openmm.AndersenThermostat(300, 1), "Remove the AndersenThermostat: .* keeps the temperature"),
    ],
)
def test_what_acts_within_trajectories_is_refused(force, remedy):
    system = periodic_system()[2]
    system.addForce(force)
    with pytest.raises(openmm.OpenMMException, match=remedy):
        openmm.Context(system, sampler(), platform())
