"""The atoms of one Context, where bodies are placed and whose forces are read."""

from __future__ import annotations

import weakref

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import RigidBodies
from openmm_sier.engines.snapshot import Snapshot, read_vectors

#: Value of `Atoms._placed` if the positions are not those of placed bodies.
NOWHERE = (None, None)


class Atoms:
    """Positions, velocities and forces of a Context, as bodies write and read them.

    Attributes:
        positions, velocities: as they were last written, (N, 3), nm and nm/ps; those of atoms in no body are stored
            here.
    """

    def __init__(self, context: openmm.Context):
        # The Context owns its integrator and so all this: a strong reference back would keep both alive.
        self._context_ref = weakref.ref(context)
        system = context.getSystem()
        n = system.getNumParticles()
        self._has_virtual_sites = any(system.isVirtualSite(i) for i in range(n))
        self.positions, self.velocities, self._forces = np.zeros((3, n, 3))
        self._placed: tuple = NOWHERE

    @property
    def context(self) -> openmm.Context:
        """The Context.

        Raises:
            openmm.OpenMMException: it does not exist any more.
        """
        context = self._context_ref()
        if context is None:
            raise openmm.OpenMMException("The Context of this integrator no longer exists")
        return context

    def place(self, bodies: RigidBodies, q: np.ndarray, A: np.ndarray) -> None:
        """Set the positions of the Context to those of bodies at (q, A), unless they are there already.

        Raises:
            NotFiniteError: a position is not finite; the Context keeps its positions.
        """
        if self._placed[0] is q and self._placed[1] is A:
            return
        context = self.context
        context.setPositions(bodies.place(q, A, self.positions))
        if self._has_virtual_sites:
            context.computeVirtualSites()
        self._placed = (q, A)

    def forces(self, groups: int) -> np.ndarray:
        """Forces of some groups at the present positions, (N, 3), kJ/mol/nm; overwritten by the next call."""
        found = self.context.getState(forces=True, groups=groups)
        return read_vectors(found, openmm.State.Forces, self._forces)

    def take_positions(self, now: Snapshot) -> None:
        """Take over positions that were changed in the Context."""
        self.positions[:] = now.positions
        self.forget_place()

    def forget_place(self) -> None:
        """Make the next `place` write positions to the Context, whatever is there."""
        self._placed = NOWHERE

    def rewind(self, mark: openmm.State) -> None:
        """Undo the changes of an incomplete step to the box and to atoms of no body.

        Args:
            mark: State with the positions before the step.
        """
        self.context.setPeriodicBoxVectors(*mark.getPeriodicBoxVectors())
        # A barostat also moves atoms of no body.
        self.positions[:] = mark.getPositions(asNumpy=True)._value

    def box(self) -> np.ndarray:
        """Periodic box vectors as rows, nm."""
        return self.context.getState().getPeriodicBoxVectors(asNumpy=True)._value
