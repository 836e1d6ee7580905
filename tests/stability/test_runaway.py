"""Integrators stop when steps have made a System impossibly hot, and say nothing of what users do themselves."""

import copy
import itertools

import numpy as np
import openmm
import pytest

from openmm_sier import SIERIntegrator, SIERLangevinIntegrator
from openmm_sier.stability import runaway
from tests.support.silence import silence
from tests.support.systems import assembled
from tests.support.waters import context_at, platform

ENGINES = ("exact", "native")


def test_a_runaway_stops_with_an_error(box, monkeypatch):
    """With the exact engine: on the native one OpenMM's constraints fail first, and positions are not finite then.

    The watch looks after each step, before numbers of single precision overflow.
    """
    monkeypatch.setattr(runaway, "INTERVAL", 1)
    _, system, point = box
    integrator = SIERIntegrator(0.012, "SIER2", engine="exact")
    with pytest.warns(UserWarning, match="is long"):
        # OpenMM's PME on the Reference platform writes past its mesh where positions are not finite.
        context = context_at(system, integrator, point, "CPU", steps=0)
    # SIER2 is unstable from 10 fs on: in librations at 12 fs each step multiplies amplitudes by three.
    calls = iter(lambda: integrator.step(1), 0)
    message = "Steps of 12 fs have raised the temperature to .* minimize the energy first"
    with pytest.raises(runaway.RunawayError, match=message):
        list(itertools.islice(calls, 500))
    assert context.getStepCount() < 500
    context.setPositions(point[0])
    context.setVelocities(point[1])
    with silence():
        integrator.setStepSize(0.0001)
        integrator.step(10)


def gas(n=100):
    return assembled(n * [18.0]), np.random.default_rng(1).normal(size=(n, 3))


def looks(integrator, calls=3):
    """Steps in calls of several lengths, after each of which the watch looks."""
    for _ in range(calls):
        integrator.step(1)
        integrator.step(runaway.INTERVAL)


@pytest.mark.thorough
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("engine", ENGINES)
def test_hot_starts_and_hot_baths_are_the_users_own(engine):
    system, positions = gas()
    integrator = SIERIntegrator(0.002, engine=engine)
    context = openmm.Context(system, integrator, platform())
    context.setPositions(positions)
    for temperature in (300, 20000, 100, 50000):
        context.setVelocitiesToTemperature(temperature, 1)
        looks(integrator)
    saved = context.getState(positions=True, velocities=True)
    context.setVelocitiesToTemperature(300, 1)
    looks(integrator)
    context.setState(saved)
    looks(integrator)
    bath = SIERLangevinIntegrator(300, 20, 0.002, engine=engine)
    context = openmm.Context(system, bath, platform())
    context.setPositions(positions)
    # From 0 K to that of the bath, simulated annealing from 10,000 K on, and a bath that cools slowly.
    for temperature in (300, 10000, 3000, 300):
        bath.setTemperature(temperature)
        looks(bath)
    bath.setTemperature(20000)
    looks(bath)
    bath.setFriction(0.1)
    bath.setTemperature(300)
    looks(bath)
    assert bath.computeTemperatures().in_kelvin().total > runaway.HOTTEST


@pytest.mark.thorough
@pytest.mark.filterwarnings("error")
def test_overlaps_that_are_minimized_first_and_few_atoms_draw_no_warning(box):
    _, system, (positions, _) = box
    overlapping = positions.copy()
    overlapping[:3] += positions[3] - positions[0] + 0.02
    integrator = SIERIntegrator(0.001, "SIER2")
    context = context_at(system, integrator, (overlapping, 0 * positions))
    openmm.LocalEnergyMinimizer.minimize(context, maxIterations=100)
    context.setVelocitiesToTemperature(300, 1)
    looks(integrator, 1)
    coulomb = openmm.NonbondedForce()
    for charge in (1, -1):
        coulomb.addParticle(charge, 0.2, 0.5)
    ions = assembled(2 * [23.0], coulomb)
    integrator = SIERIntegrator(0.002)
    context = context_at(ions, integrator, (np.array([[0, 0, 0], [0.8, 0, 0]]), np.zeros((2, 3))))
    # They fall onto each other.
    hottest = 0.0
    for _ in range(8):
        integrator.step(runaway.INTERVAL // 4)
        hottest = max(hottest, integrator.computeTemperatures().in_kelvin().total)
    assert hottest > runaway.HOTTEST
    assert context.getStepCount() == 8 * (runaway.INTERVAL // 4)


@pytest.mark.parametrize(
    ("velocity", "complaint"),
    [(1e3, "have raised the temperature to"), (np.nan, "have made velocities that are not finite")],
)
def test_the_watch_looks_after_a_few_steps_and_knows_what_is_no_number(velocity, complaint):
    """The first dozen steps show the worst runaways; here the steps themselves set the velocities."""
    system, positions = gas()
    integrator = SIERIntegrator(0.002)
    context = openmm.Context(system, integrator, platform())
    context.setPositions(positions)
    context.setVelocitiesToTemperature(300, 1)

    watch = integrator.impl.session.watch
    watch.begin(context)
    openmm.Context.setVelocities(context, np.full((100, 3), velocity))
    with pytest.raises(runaway.RunawayError, match=f"2 fs {complaint}"):
        watch.look(context, 0.002)


def test_copies_have_a_watch_of_their_own(box):
    _, system, point = box
    integrator = SIERIntegrator(0.002)
    original = context_at(system, integrator, point)
    clone = copy.deepcopy(integrator)
    context = context_at(system, clone, point, steps=1)
    assert clone.impl.session.watch is not integrator.impl.session.watch
    assert context.getStepCount() - original.getStepCount() == 1
