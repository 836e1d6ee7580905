"""The contents of a Context at one moment, so that changes from outside can be recognized later."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np
import openmm

from openmm_sier.system import own_methods


def box_of(state: openmm.State) -> Sequence[openmm.Vec3]:
    """Return the periodic box vectors of a State, nm."""
    # OpenMM gives nanometers and picoseconds. `value_in_unit` would copy the vectors deeply, which takes 10 us.
    return state.getPeriodicBoxVectors()._value


def time_of(timed: openmm.State | openmm.Context) -> float:
    """Return the time of a State or a Context, ps."""
    return timed.getTime()._value


def holds_doubles(context: openmm.Context) -> bool:
    """Return whether a Context gives back positions and velocities of all particles as they were set, bit for bit.

    GPU platforms may round them, and virtual sites are moved.
    """
    system = context.getSystem()
    has_sites = any(map(system.isVirtualSite, range(system.getNumParticles())))
    return context.getPlatform().getName() in ("CPU", "Reference") and not has_sites


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
        self.time = time_of(state)
        self.steps = state.getStepCount()
        self.box = box_of(state)
        self._parameters = dict(state.getParameters())

    def with_atoms(self, positions: np.ndarray, velocities: np.ndarray) -> Snapshot:
        """Return a snapshot in which atoms have other positions and velocities, and all else is the same."""
        other = copy.copy(self)
        other.positions, other.velocities = positions.copy(), velocities.copy()
        return other

    def same_positions(self, other: Snapshot | None) -> bool:
        return other is not None and np.array_equal(self.positions, other.positions)

    def same_velocities(self, other: Snapshot | None) -> bool:
        return other is not None and np.array_equal(self.velocities, other.velocities)

    def same_environment(self, other: Snapshot | None) -> bool:
        """Tell whether box and parameters are the same. Changes of a Force itself leave no trace here."""
        return other is not None and (self.box, self._parameters) == (other.box, other._parameters)
