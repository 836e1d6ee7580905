"""Samples of runs, and what ends one."""

import numpy as np
import openmm
import pytest

from openmm_sier import RigidBodies
from studies import frame
from tests.support.flexible_systems import started
from tests.support.systems import assembled
from tests.support.waters import periodic_system, plain_context

TEMPERATURE = 300.0


def test_torn_molecules_end_one_run_and_not_the_comparison():
    """Verlet with SETTLE at a step that is much too long, on Reference, where positions become NaN without an error.

    Of free molecules: at such positions OpenMM's mesh of the Reference platform is written to outside of its memory.
    """
    topology, positions, system = periodic_system()
    while system.getNumForces():
        system.removeForce(0)
    context = started(system, openmm.VerletIntegrator(0.03), positions, 2000, seed=1)
    observe = frame.OfBodies(context, RigidBodies.from_system(system, topology))
    with pytest.raises(frame.Unstable):
        frame.sampled(context, observe, duration=30.0, time=6.0, interval=150.0)


def test_a_run_that_is_too_hot_ends():
    context = plain_context(assembled([1.0]), np.zeros((1, 3)))
    with pytest.raises(frame.Unstable, match="4000 K after 20 steps"):
        frame.sampled(context, lambda _: {"temperature": 4000.0}, duration=1.0, time=0.1, interval=20.0)
