"""Ways to stop and continue a run, and comparisons of the results."""

import numpy as np
import openmm
from openmm import app

from tests.support.waters import phase_point, platform


def simulation_of(topology, system, integrator, name="Reference", point=None):
    properties = {"Threads": "1", "DeterministicForces": "true"} if name == "CPU" else {}
    simulation = app.Simulation(topology, system, integrator, platform(name), properties)
    if point is not None:
        simulation.context.setPositions(point[0])
        simulation.context.setVelocities(point[1])
    return simulation


def everything(context):
    """Positions, velocities, box, time, step count and what bath, moves and trials count."""
    tally = context.getIntegrator().impl.tally
    return (
        *phase_point(context),
        *clock_and_box(context),
        tally.heat,
        tally.draws,
        tally.seed,
        *tally.counts.values(),
    )


def assert_same(one, two):
    for a, b in zip(one, two, strict=True):
        assert np.array_equal(a, b)


def assert_restart_is_the_same(system, context, other, steps):
    """A checkpoint continued by another integrator ends, bit for bit, where its own one does."""
    saved = context.createCheckpoint()
    context.getIntegrator().step(steps)
    again = openmm.Context(system, other, platform())
    again.loadCheckpoint(saved)
    other.step(steps)
    assert_same(everything(context), everything(again))


def after_ten_steps(simulation, way, path):
    """Make ten steps and write a file that a restart begins from; the name of the method that reads it.

    The way is Checkpoint or State, which are saved at the end, or the reporter that writes them in mid-call.
    """
    kind = way.removesuffix("Reporter")
    if way != kind:
        simulation.reporters.append(app.CheckpointReporter(str(path), 5, writeState=kind == "State"))
    simulation.step(10)
    simulation.reporters.clear()
    if way == kind:
        getattr(simulation, f"save{kind}")(str(path))
    return f"load{kind}"


def full_state(context):
    """The complete state from which a run continues."""
    return context.getState(positions=True, velocities=True, parameters=True, integratorParameters=True)


def clock_and_box(context):
    state = context.getState()
    box = np.array(state.getPeriodicBoxVectors(asNumpy=True)._value)
    return box, state.getTime()._value, state.getStepCount()
