"""The contents of a Context at one moment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import openmm
from openmm import unit

from openmm_sier.system import tables

#: Platforms whose forces are in memory that Python can read. Their virtual sites do not follow within a step.
HOST_PLATFORMS = ("CPU", "Reference")


def is_on_host(platform: openmm.Platform) -> bool:
    """Return whether Python can read the forces of a platform without a copy from a GPU."""
    return platform.getName() in HOST_PLATFORMS


def box_of(state: openmm.State) -> Sequence[openmm.Vec3]:
    """Return the periodic box vectors of a State, nm."""
    # OpenMM gives nanometers and picoseconds. `value_in_unit` would copy the vectors deeply, which takes 10 us.
    return state.getPeriodicBoxVectors()._value


def time_of(timed: openmm.State | openmm.Context) -> float:
    """Return the time of a State or a Context, ps."""
    return timed.getTime()._value


def potential_of(state: openmm.State) -> float:
    """Return the potential energy of a State, kJ/mol."""
    return state.getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)


def holds_doubles(context: openmm.Context) -> bool:
    """Return whether a Context gives back positions and velocities of all particles as they were set, bit for bit.

    GPU platforms may round them, and virtual sites are moved.
    """
    system = context.getSystem()
    return is_on_host(context.getPlatform()) and not tables.virtual_sites(system).size


def precision_of(context: openmm.Context) -> str | None:
    """Return the precision of a Context, "single", "mixed" or "double"; None on a platform without a choice."""
    platform = context.getPlatform()
    if "Precision" not in platform.getPropertyNames():
        return None
    return str(platform.getPropertyValue(context, "Precision"))


class Environment(NamedTuple):
    """Variables besides positions on which forces depend: periodic box vectors, nm, and parameters by name."""

    box: Sequence[openmm.Vec3]
    parameters: dict[str, float]

    @classmethod
    def of(cls, state: openmm.State) -> Environment:
        """Return those of a State with parameters."""
        return cls(box_of(state), dict(state.getParameters()))


class Snapshot(NamedTuple):
    """Positions, velocities, clock, box and parameters of a Context.

    Attributes:
        positions, velocities: (N, 3), nm and nm/ps.
        time: ps.
        steps: the step count.
        environment: box and parameters. Changes of a Force itself leave no trace here.
    """

    positions: np.ndarray
    velocities: np.ndarray
    time: float
    steps: int
    environment: Environment

    @property
    def box(self) -> Sequence[openmm.Vec3]:
        """Return the periodic box vectors, nm."""
        return self.environment.box

    @classmethod
    def of(cls, context: openmm.Context) -> Snapshot:
        """Return the snapshot of a Context as it is now.

        Raises:
            openmm.OpenMMException: its positions were never set.
        """
        state = openmm.Context.getState(context, positions=True, velocities=True, parameters=True)
        shape = state._getNumParticles(), 3
        # Two arrays, since one of twice the size seldom fits where that of an older snapshot was.
        positions, velocities = np.empty(shape), np.empty(shape)
        # Like getPositions(asNumpy=True), but without its overhead for names and units.
        state._getVectorAsNumpy(openmm.State.Positions, positions)
        state._getVectorAsNumpy(openmm.State.Velocities, velocities)
        if not positions[:1].any() and not positions.any():
            # No positions were set, or all particles are at the origin. OpenMM raises an error in the first case only.
            openmm.Context.getState(context, energy=True, groups=0)
        return cls(positions, velocities, time_of(state), state.getStepCount(), Environment.of(state))

    def refuse_what_is_not_finite(self) -> None:
        """Refuse positions or velocities that are infinite or NaN.

        Raises:
            openmm.OpenMMException: the message names the first such atom.
        """
        for name, vectors in (("position", self.positions), ("velocity", self.velocities)):
            is_finite = np.isfinite(vectors).all(axis=1)
            if not is_finite.all():
                atom = int(is_finite.argmin())
                raise openmm.OpenMMException(
                    f"The {name} of atom {atom} in the Context is {vectors[atom]}, and not finite"
                )
