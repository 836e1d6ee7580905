"""Kernels: what Numba compiles does what Python does, and how often it is called."""

import os

import numpy as np
import pytest

from openmm_sier.dynamics import kernels, operators
from tests.support.steps import every_kind
from tests.support.subprocesses import run_python

#: Steps of bodies of every kind, one of which spins too fast for the series, with a bath, and of constrained points.
#: Prints the arrays at the end as text.
STEPS = """
import numpy as np
from openmm_sier.dynamics import operators
from openmm_sier.dynamics.constrained import constrained_operators
from openmm_sier.dynamics.tally import Tally
from openmm_sier.dynamics.schemes import SIER4G
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck
from tests.support.flexible import cage, many, rotor
from tests.support.steps import constant_torques, every_kind, with_a_fast_body

bodies, state, forces = every_kind(np.random.default_rng(1), each=2)
state = with_a_fast_body(bodies, state)
state = operators.stepper(SIER4G, operators.body_operators(bodies, constant_torques(bodies, forces)), 0.004)(state)
state = OrnsteinUhlenbeck(300.0, 3.0, 7.0).operator(bodies, Tally(5))(state, 0.05)
atoms = np.zeros_like(forces)
arrays = [state.q, state.p, state.A, state.L, bodies.move(state, atoms)]

points = many(rotor(3), cage())
forces = lambda q, A: (points.forces(q), 0 * q)
move = constrained_operators(points.bodies, forces, points.constraints())
state = operators.stepper(SIER4G, move, 0.001)(points.start(np.random.default_rng(1)))
arrays += [state.q, state.p]
for array in arrays:
    print(*(repr(float(x)) for x in array.ravel()))
"""


@pytest.mark.thorough
def test_python_executes_what_numba_compiles():
    results = []
    for disabled in ("1", "0"):
        text = run_python(STEPS, environment=os.environ | {"NUMBA_DISABLE_JIT": disabled})
        results.append([np.array(line.split(), dtype=float) for line in text.splitlines()])
    assert len(results[0]) == 7
    for one, other in zip(*results, strict=True):
        assert np.abs(one).max() > 0
        # Sums of products are contracted to fused operations, or not: rounding of some 300 terms of order one, for the
        # fast body in some stages and angles up to 30, and times the condition of the cage.
        assert np.abs(one - other).max() < 1e-12 * np.abs(one).max()


def test_calls_of_a_step_do_not_grow_with_the_kinds_of_bodies(rng, monkeypatch):
    """With few bodies calls take most of the time."""
    bodies, state, forces = every_kind(rng)
    calls = []
    for module, name in [(kernels.atoms, "place"), (kernels.atoms, "collect"), (kernels.bodies, "drift")]:
        kernel = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *given, kernel=kernel, name=name: calls.append(name) or kernel(*given))
    flow = operators.drift(bodies)
    assert len(bodies.species) > 3
    bodies.place(state.q, state.A, np.zeros((bodies.n_particles, 3)))
    bodies.forces_and_torques(forces, state.A)
    flow(state, 0.001)
    assert calls == ["place", "collect", "drift"]
