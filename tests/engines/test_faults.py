"""Errors stop a run with a reason, and leave Context and integrator in a state from which the run can continue."""

import gc
import signal
import threading
from itertools import count, pairwise

import numpy as np
import openmm
import pytest

from openmm_sier import (
    SIER2,
    SIER4,
    RigidBodies,
    RigidityError,
    Scheme,
    SIERIntegrator,
    SIERLangevinIntegrator,
)
from openmm_sier.dynamics import threads
from openmm_sier.engines.exact.engine import ExactEngine
from tests.support.faults import Fault, lines_run
from tests.support.restarts import assert_same, everything
from tests.support.seeded import seeded
from tests.support.systems import field, with_forces
from tests.support.waters import cluster_system, context_at, force_of, periodic_system, phase_point, platform, settled


@pytest.fixture(scope="module")
def cluster():
    return settled("cluster-3-tip4pew", *cluster_system(3, "tip4pew"))


@pytest.fixture
def on_interrupt():
    """Installs a handler of Ctrl-C; the usual one is back at the end."""
    before = signal.getsignal(signal.SIGINT)
    yield lambda handler: signal.signal(signal.SIGINT, handler)
    signal.signal(signal.SIGINT, before)


def langevin(scheme=SIER2, **options):
    return seeded(SIERLangevinIntegrator(297.0, 5.0, 0.001, scheme=scheme, **options))


# --- a fault at every line --------------------------------------------------------------------------------------


class Trajectory:
    """The states of an undisturbed run by step number, computed as they are asked for."""

    def __init__(self, system, make, point, name="Reference"):
        self._context = context_at(system, make(), point, name, steps=0)
        self.states = [everything(self._context)]

    def __getitem__(self, step):
        while len(self.states) <= step:
            self._context.getIntegrator().step(1)
            self.states.append(everything(self._context))
        return self.states[step]


def assert_at(context, trajectory):
    step = context.getStepCount()
    assert_same(everything(context), trajectory[step])
    return step


def test_a_fault_at_any_line_leaves_a_completed_step(cluster):
    interrupt_at_any_line(cluster, langevin, KeyboardInterrupt)


def interrupt_at_any_line(box, make, error):
    """Make two steps with a fault at each of their lines in turn: each leaves a completed step."""
    _, system, point = box
    trajectory = Trajectory(system, make, point)
    integrator = make()
    context = context_at(system, integrator, point, steps=1)
    reached = set()
    for line in count(1):
        before = assert_at(context, trajectory)
        total = lines_run(lambda: integrator.step(2), line, error)
        reached.add(assert_at(context, trajectory) - before)
        if total < line:
            break
    assert total > 50
    # The undisturbed run goes on.
    integrator.step(5)
    assert_at(context, trajectory)
    # Faults came before, between and after the two steps.
    assert reached == {0, 1, 2}


@pytest.fixture(scope="module")
def box():
    topology, positions, system = periodic_system(molecules=27)
    force_of(system).setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    force_of(system).setCutoffDistance(0.4)
    return settled("box-27-cut-off", topology, positions, system)


@pytest.mark.thorough
def test_a_fault_at_any_line_with_threads(cluster, monkeypatch):
    """Three threads place atoms and sum forces: none may write any more when the last completed step is written."""
    shared = []
    pool = threads.ThreadPoolExecutor
    monkeypatch.setattr(threads, "ThreadPoolExecutor", lambda team: shared.append(team) or pool(team))
    monkeypatch.setattr(threads, "count", lambda: 3)
    monkeypatch.setattr(threads, "SHARE", 1)
    interrupt_at_any_line(cluster, lambda: SIERIntegrator(0.001, "SIER2"), KeyboardInterrupt)
    assert set(shared) == {3}


@pytest.mark.thorough
def test_a_fault_at_any_line_with_a_barostat(box):
    """With a fixed particle of no body, which barostats move too."""
    system = with_forces(box[1], seeded(openmm.MonteCarloBarostat(1.0, 297.0, 1), 5))
    force_of(system).addParticle(0.0, 0.3, 0.0)
    system.addParticle(0.0)
    point = [np.vstack([values, [0.3, 0.2, 0.1]]) for values in box[2]]
    integrator = langevin()
    context = context_at(system, integrator, point, "CPU")
    volume = context.getState().getPeriodicBoxVolume()
    integrator.step(1)
    moved = 0
    for line in count(1):
        before, step = everything(context), context.getStepCount()
        total = lines_run(lambda: integrator.step(1), line)
        if total < line:
            break
        if context.getStepCount() == step:
            assert_same(everything(context), before)
        else:
            moved += 1
            assert context.getTime()._value == pytest.approx(0.001 * (step + 1))
        integrator.step(1)
        # What a fault leaves is whole: the run would stop at molecules that are not, or at atoms on one another.
        assert context.getState(energy=True).getPotentialEnergy()._value < 0
    assert 0 < moved < total
    # Of some hundred moves.
    assert context.getState().getPeriodicBoxVolume() != volume


@pytest.mark.parametrize("acts", [[openmm.MonteCarloBarostat], [openmm.MonteCarloBarostat, openmm.AndersenThermostat]])
def test_a_fault_after_a_step_leaves_it_the_box_that_a_barostat_gave_it(box, acts, monkeypatch, on_interrupt):
    # At 10^5 bar each move to a smaller box is accepted.
    arguments = {openmm.MonteCarloBarostat: (1e5, 297.0, 1), openmm.AndersenThermostat: (297.0, 1.0)}
    system = with_forces(box[1], *(seeded(kind(*arguments[kind]), 5) for kind in acts))
    integrator = seeded(SIERIntegrator(0.001, "SIER2"))
    context = context_at(system, integrator, box[2], "CPU", steps=1)
    seen = []

    def interrupted(engine, point):
        complete(engine, point)
        signal.raise_signal(signal.SIGINT)

    def fail(number, frame):
        seen.append(context.getState().getPeriodicBoxVectors())
        raise Fault

    complete = ExactEngine._complete
    on_interrupt(fail)
    monkeypatch.setattr(ExactEngine, "_complete", interrupted)
    boxes = [context.getState().getPeriodicBoxVectors()]
    for step in range(2, 12):
        with pytest.raises(Fault):
            integrator.step(1)
        assert context.getStepCount() == step
        boxes.append(context.getState().getPeriodicBoxVectors())
        assert boxes[-1] == seen[-1]
    assert any(one != other for one, other in pairwise(boxes))


# --- numbers that are none --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["Reference", "CPU"])
def test_force_that_is_not_finite(cluster, name):
    topology, system, point = cluster
    # Every fourth particle is a virtual site.
    system = with_forces(system, field("k*x", [i for i in range(12) if i % 4 != 3], k=1.0))

    def make():
        return langevin(SIER4, bodies=RigidBodies.from_system(system, topology))

    trajectory, integrator = Trajectory(system, make, point, name), make()
    context = context_at(system, integrator, point, name, steps=4)
    context.setParameter("k", float("nan"))
    with pytest.raises(openmm.OpenMMException, match=r"residue HOH \d+ \(atoms 0, 1, 2\) .*step 5"):
        integrator.step(3)
    assert assert_at(context, trajectory) == 4
    context.setParameter("k", 1.0)
    integrator.step(6)
    assert assert_at(context, trajectory) == 10


def test_position_that_is_not_finite_is_not_written(cluster, monkeypatch):
    """In a scheme that ends with a drift no force would show it."""
    _, system, point = cluster
    drifting = Scheme("position Verlet", (("drift", 0.5), ("kick", 1.0), ("drift", 0.5)))
    integrator = SIERIntegrator(0.001, drifting)
    context = context_at(system, integrator, (point[0], 0 * point[1]), steps=2)
    before = phase_point(context)
    velocities = before[1].copy()
    velocities[8:12] = [1e306, 0, 0]
    context.setVelocities(velocities)
    integrator.setStepSize(1000.0)
    # Such a step is refused where molecules can make each other swing.
    monkeypatch.setattr("openmm_sier.stability.step_check.StepCheck.__call__", lambda *_: None)
    with (
        np.errstate(over="ignore", invalid="ignore"),
        pytest.raises(openmm.OpenMMException, match=r"atoms 8, 9, 10 .*step 3"),
    ):
        integrator.step(1)
    assert context.getStepCount() == 2
    assert np.array_equal(phase_point(context)[0], before[0])


def test_bodies_that_are_no_longer_rigid(cluster):
    topology, system, point = cluster
    bodies = RigidBodies.from_system(system, topology)
    integrator = SIERIntegrator(0.001, "SIER2", bodies=bodies)
    trajectory = Trajectory(system, lambda: SIERIntegrator(0.001, "SIER2", bodies=bodies), point)
    context = context_at(system, integrator, point, steps=3)
    positions = phase_point(context)[0]
    bent = positions.copy()
    bent[5] += [0.0, 0.08, 0.0]
    context.setPositions(bent)
    message = r"residue HOH \d+ \(atoms 4, 5, 6\) does not fit its rigid shape"
    for ask in (lambda: integrator.step(1), integrator.getBodyState, integrator.computeSystemTemperature):
        with pytest.raises(RigidityError, match=message):
            ask()
    assert context.getStepCount() == 3
    assert np.array_equal(phase_point(context)[0], bent)
    context.setPositions(positions)
    integrator.step(3)
    # The same atoms, at the same places with the same velocities: the stored state is theirs.
    assert assert_at(context, trajectory) == 6


# --- integrators where they do not belong -----------------------------------------------------------------------


def test_context_that_is_gone(cluster):
    _, system, point = cluster
    integrator = SIERIntegrator(0.001, "SIER2")
    context = context_at(system, integrator, point, steps=1)
    del context
    gc.collect()
    for ask in (lambda: integrator.step(1), integrator.getBodyState):
        with pytest.raises(openmm.OpenMMException, match="no longer exists"):
            ask()


def test_context_alone_keeps_its_integrator(cluster):
    _, system, point = cluster
    context = context_at(system, SIERIntegrator(0.001, "SIER2"), point)
    gc.collect()
    context.getIntegrator().step(2)
    assert context.getStepCount() == 2


def test_contexts_are_freed(cluster):
    """Neither keeps the other alive in a circle that only the garbage collector opens."""
    _, system, point = cluster
    integrator = SIERIntegrator(0.001, "SIER2")
    context = context_at(system, integrator, point, steps=1)
    gc.disable()
    try:
        engine = integrator.impl.engine
        del context
        with pytest.raises(ReferenceError):
            engine._context.getTime()
    finally:
        gc.enable()


def test_compound_integrator_is_refused(cluster):
    _, system, _ = cluster
    compound = openmm.CompoundIntegrator()
    compound.addIntegrator(openmm.VerletIntegrator(0.001))
    compound.addIntegrator(SIERIntegrator(0.001, "SIER2"))
    with pytest.raises(openmm.OpenMMException, match="CompoundIntegrator"):
        openmm.Context(system, compound, platform())


# --- a System that changes --------------------------------------------------------------------------------------


@pytest.mark.parametrize("preserve", [True, False])
def test_changed_masses_act_after_reinitialization(cluster, preserve):
    _, system, point = cluster
    system = openmm.XmlSerializer.clone(system)
    integrator = SIERIntegrator(0.001, "SIER2")
    context = context_at(system, integrator, point, steps=0)
    for i in range(system.getNumParticles()):
        system.setParticleMass(i, 3 * system.getParticleMass(i))
    before = phase_point(context)
    light = integrator.bodies.masses.copy()
    context.reinitialize(preserveState=preserve)
    if not preserve:
        context.setPositions(before[0])
        context.setVelocities(before[1])
    assert np.allclose(integrator.bodies.masses, 3 * light, rtol=1e-14)
    integrator.step(20)
    fresh = SIERIntegrator(0.001, "SIER2")
    reference = context_at(system, fresh, before, steps=20)
    # The same molecules, read from the atoms once or twice: rounding.
    assert np.abs(phase_point(context)[0] - phase_point(reference)[0]).max() < 1e-12
    assert np.abs(phase_point(context)[0] - before[0]).max() > 1e-3


def test_another_thread_is_refused(cluster, monkeypatch):
    _, system, point = cluster
    integrator, said = SIERIntegrator(0.001, "SIER2"), []
    context = context_at(system, integrator, point)

    def begin(*_):
        def step():
            try:
                integrator.step(1)
            except openmm.OpenMMException as error:
                said.append(str(error))

        thread = threading.Thread(target=step)
        thread.start()
        thread.join(60)

    with monkeypatch.context() as patched:
        patched.setattr(integrator.impl.session.watch, "begin", begin)
        integrator.step(1)
    assert said == ["Another thread is stepping this Context: give each thread a Context of its own"]
    integrator.step(1)
    assert context.getStepCount() == 2


def test_bodies_of_other_masses_are_refused(cluster):
    topology, system, point = cluster
    system = openmm.XmlSerializer.clone(system)
    bodies = RigidBodies.from_system(system, topology)
    integrator = SIERIntegrator(0.001, "SIER2", bodies=bodies)
    context = context_at(system, integrator, point, steps=1)
    system.setParticleMass(6, 2.0)
    message = r"atom 6 of .*residue HOH \d+ .* has a mass of 1.00\d+ dalton in the bodies, but 2.0 dalton in the System"
    with pytest.raises(ValueError, match=message):
        context.reinitialize(preserveState=True)
    with pytest.raises(openmm.OpenMMException, match="no Context"):
        integrator.step(1)
    with pytest.raises(ValueError, match=message):
        openmm.Context(system, SIERIntegrator(0.001, "SIER2", bodies=bodies), platform())
    system.setParticleMass(6, bodies.species[0].masses[2])
    context.reinitialize(preserveState=True)
    integrator.step(1)
    assert context.getStepCount() == 2
