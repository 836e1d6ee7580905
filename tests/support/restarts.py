"""Ways to stop a run and to continue it, and what has to agree then."""

from __future__ import annotations

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
    """Positions, velocities, box, time, step count and what the heat bath counts."""
    integrator = context.getIntegrator()
    counted = [integrator.getGlobalVariableByName(name) for name in ("sier_heat", "sier_draws")]
    return (*phase_point(context), *clock_and_box(context), *counted)


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


def by_checkpoint(simulation, path):
    simulation.step(10)
    simulation.saveCheckpoint(str(path))
    simulation.step(15)


def by_state(simulation, path):
    simulation.step(10)
    simulation.saveState(str(path))
    simulation.step(15)


def by_reporter(simulation, path):
    simulation.reporters.append(app.CheckpointReporter(str(path), 5))
    simulation.step(12)  # The last file is of step 10.
    simulation.reporters.clear()
    simulation.step(13)


def by_state_reporter(simulation, path):
    simulation.reporters.append(app.CheckpointReporter(str(path), 5, writeState=True))
    simulation.step(12)
    simulation.reporters.clear()
    simulation.step(13)


WAYS = [(by_checkpoint, "loadCheckpoint"), (by_state, "loadState")]


WAYS += [(by_reporter, "loadCheckpoint"), (by_state_reporter, "loadState")]


def clock_and_box(context):
    state = context.getState()
    box = np.array(state.getPeriodicBoxVectors(asNumpy=True)._value)
    return box, state.getTime()._value, state.getStepCount()
