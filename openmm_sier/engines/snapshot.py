"""The contents of a Context at one moment, so that changes from outside can be recognized later."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import openmm
from openmm import unit

from openmm_sier.engines import own_methods


def box_of(state: openmm.State) -> Sequence[openmm.Vec3]:
    """Return the periodic box vectors of a State, nm."""
    return state.getPeriodicBoxVectors().value_in_unit(unit.nanometer)


class Snapshot:
    """Positions, velocities, clock, box and parameters of a Context.

    Attributes:
        positions, velocities: (N, 3), nm and nm/ps.
        box: periodic box vectors, nm.
        time: ps.
        steps: the step count.
    """

    def __init__(self, context: openmm.Context) -> None:
        state = own_methods.get_state(context, positions=True, velocities=True, parameters=True)
        # Two arrays, since one of twice the size seldom fits where that of an older snapshot was.
        self.positions, self.velocities = (np.empty((state._getNumParticles(), 3)) for _ in range(2))
        # Like getPositions(asNumpy=True), but without its overhead for names and units.
        state._getVectorAsNumpy(openmm.State.Positions, self.positions)
        state._getVectorAsNumpy(openmm.State.Velocities, self.velocities)
        self.time = state.getTime().value_in_unit(unit.picosecond)
        self.steps = state.getStepCount()
        self.box = box_of(state)
        self._parameters = dict(state.getParameters())

    def same_positions(self, other: Snapshot | None) -> bool:
        return other is not None and np.array_equal(self.positions, other.positions)

    def same_velocities(self, other: Snapshot | None) -> bool:
        return other is not None and np.array_equal(self.velocities, other.velocities)

    def same_environment(self, other: Snapshot | None) -> bool:
        """Whether box and parameters are the same. Changes of a Force itself leave no trace here."""
        return other is not None and (self.box, self._parameters) == (other.box, other._parameters)
