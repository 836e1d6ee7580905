"""Runs of schemes on the model cluster, and the order of their errors."""

import numpy as np

from openmm_sier.dynamics.operators import body_operators, stepper
from tests.support.phase_space import distance


def run(cluster, scheme, state, h, steps):
    step = stepper(scheme, body_operators(cluster.bodies, cluster.forces), h)
    for _ in range(steps):
        state = step(state)
    return state


def slope(cluster, scheme, start, steps=(16, 32, 64), time=0.032):
    exact = cluster.exact_flow(start, time)
    errors = [distance(run(cluster, scheme, start, time / n, n), exact) for n in steps]
    return np.polyfit(np.log(1 / np.array(steps)), np.log(errors), 1)[0]
