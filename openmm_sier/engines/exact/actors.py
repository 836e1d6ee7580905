"""Forces of a System that act on bodies between two steps of a scheme."""

from __future__ import annotations

import openmm

from openmm_sier.system import checks


class Actors:
    """Forces of a System that change positions, velocities or the box.

    Attributes:
        are_present: whether there are any other than CMMotionRemovers.
        are_barostats: whether all of those are barostats, which leave velocities alone.
    """

    def __init__(self, system: openmm.System):
        forces = [system.getForce(i) for i in range(system.getNumForces())]
        acting = [force for force in forces if not checks.is_passive(force)]
        self.are_present = bool(acting)
        self.are_barostats = all(isinstance(force, checks.BAROSTATS) for force in acting)
        self._sweep_frequencies = [f.getFrequency() for f in forces if isinstance(f, openmm.CMMotionRemover)]

    def removes_momentum(self, steps: int) -> bool:
        """Whether a CMMotionRemover acts before the step that follows `steps` completed ones."""
        return any(steps % frequency == 0 for frequency in self._sweep_frequencies)
