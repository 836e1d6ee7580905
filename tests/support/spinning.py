"""Two atoms that a constraint joins, in steps so long that OpenMM's iterations often end far off it."""

import math

import numpy as np
import openmm

from openmm_sier.ensembles import metropolis
from tests.support.systems import assembled
from tests.support.waters import phase_point

LENGTH = 0.1

POSITIONS = np.array([[0.0, 0.0, 0.0], [LENGTH, 0.0, 0.0]])

#: ps. A thermal velocity of the hydrogen, 1.6 nm/ps, moves it by two thirds of the constraint.
STEP = 0.04


def system(box=None):
    """Return a hydrogen on a carbon without forces, in a periodic box with this edge in nm or without a box."""
    made = assembled([12.0, 1.0], constraints=[(0, 1, LENGTH)])
    if box is not None:
        made.setDefaultPeriodicBoxVectors(*np.eye(3) * box)
        force = openmm.CustomBondForce("0")
        force.setUsesPeriodicBoundaryConditions(True)
        made.addForce(force)
    return made


def broken(positions):
    """Return the error of the constrained distance, nm."""
    return abs(np.linalg.norm(positions[1] - positions[0]) - LENGTH)


def rejected(context, trials):
    """Return how many of some trials are rejected. Each of these leaves the start; samples satisfy the constraint."""
    integrator, count = context.getIntegrator(), 0
    integrator.impl.tally.counts[metropolis.CHECKED_STEP] = STEP
    for _ in range(trials):
        start, accepted = phase_point(context)[0], integrator.accepted
        integrator.step(1)
        # The length is in single precision on platforms for GPUs.
        assert broken(phase_point(context)[0]) < 1e-6
        if integrator.accepted == accepted:
            count += 1
            assert math.isinf(integrator.lastEnergyError)
            assert np.array_equal(phase_point(context)[0], start)
    return count
