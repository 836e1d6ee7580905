"""Runs of schemes on the model cluster, and the order that their errors show."""

from __future__ import annotations

import numpy as np

from openmm_sier.dynamics.operators import CachedForces, drift, gradient_kick, kick, stepper
from openmm_sier.dynamics.schemes import DRIFT, GRADIENT_KICK, KICK
from tests.support.phase_space import distance


def operators_of(cluster):
    forces = CachedForces(cluster.forces)
    return forces, {
        KICK: kick(forces),
        GRADIENT_KICK: gradient_kick(cluster.bodies, forces),
        DRIFT: drift(cluster.bodies),
    }


def run(cluster, scheme, state, h, steps):
    _, operators = operators_of(cluster)
    step = stepper(scheme, operators, h)
    for _ in range(steps):
        state = step(state)
    return state


def slope(cluster, scheme, start, steps=(16, 32, 64), time=0.032):
    exact = cluster.exact_flow(start, time)
    errors = [distance(run(cluster, scheme, start, time / n, n), exact) for n in steps]
    return np.polyfit(np.log(1 / np.array(steps)), np.log(errors), 1)[0]
