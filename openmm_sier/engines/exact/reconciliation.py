"""The bodies' state found from what a Context holds: after a restart, and after changes from outside."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodyState, NotFiniteError, RigidBodies, RigidityError
from openmm_sier.dynamics.constraints import ConstraintError
from openmm_sier.engines.exact import packing
from openmm_sier.engines.exact.atoms import Atoms
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.engines.variables import STATE_VARIABLES
from openmm_sier.system import checks

#: Points further than this from their constraints, in nm, are refused, since they are not the molecule that was meant.
FARTHEST = 0.05


class Reconciliation:
    """Finds the phase point of bodies in a Context.

    When it takes over positions, it also updates the copy of them in `Atoms`. When forces may have changed, it
    invalidates them.
    """

    def __init__(self, bodies: RigidBodies, atoms: Atoms, invalidate_forces: Callable[[], None]):
        self._bodies, self._atoms, self._invalidate_forces = bodies, atoms, invalidate_forces
        self._told_of_misfit = False

    def recall(self, integrator: openmm.CustomIntegrator, now: Snapshot, moved: bool) -> BodyState | None:
        """The state stored in the integrator's variables, if it reproduces the atoms to the last bit.

        It does so after a checkpoint or a State with integrator parameters was loaded. If velocities were set after
        that, the stored centres and attitudes are still used.

        Args:
            integrator: the one that has the variables.
            now: what the Context holds.
            moved: whether its positions differ from those before.

        Returns:
            The state; None if the atoms are elsewhere.
        """
        bodies = self._bodies
        # One after the other: OpenMM gives lists of objects, which take much memory.
        values = np.stack([np.array(integrator.getPerDofVariableByName(name)) for name in STATE_VARIABLES])
        if not values.any() or not np.isfinite(values).all():
            return None
        state = packing.unpack(bodies, values)
        positions = bodies.place(state.q, state.A, now.positions.copy())
        velocities = bodies.move(state, now.velocities.copy())
        reproduced = np.array_equal(positions, now.positions)
        if not reproduced or not (moved or np.array_equal(velocities, now.velocities)):
            return None
        self._invalidate_forces()
        self._atoms.take_positions(now)
        if np.array_equal(velocities, now.velocities):
            return state
        p, L = self._momenta(now.velocities, state.q, state.A)
        return replace(state, p=p, L=L)

    def reconcile(self, old: BodyState | None, before: Snapshot | None, now: Snapshot) -> BodyState:
        """The state after the Context changed from one snapshot to another.

        Args:
            old: the state at the earlier snapshot.
            before: the earlier snapshot; None if there is none.
            now: what the Context holds.

        Raises:
            RigidityError: the positions do not form the bodies. Nothing has been changed then.
        """
        self.notice_environment(before, now)
        if old is None or before is None:
            q, A = self.fit(now)
            self._atoms.take_positions(now)
            p, L = self._momenta(now.velocities, q, A)
            return BodyState(q, p, A, L)
        q, A = old.q, old.A
        if not now.same_positions(before):
            q, A = self.fit(now, old)
            self._atoms.take_positions(now)
        if now.same_velocities(before) and np.array_equal(A, old.A):
            return replace(old, q=q, p=self._bodies.constraints.project(q, old.p), A=A)
        p, L = self._momenta(now.velocities, q, A)
        return replace(old, q=q, p=p, A=A, L=L)

    def fit(self, now: Snapshot, previous: BodyState | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Bodies at the positions of a snapshot, (q, A); warns once of those that are moved onto their constraints.

        Raises:
            RigidityError: the positions do not form the bodies, or are far off the constraints between them.
        """
        q, A, misfit = self._bodies.fit_with_misfit(now.positions, previous)
        q, misfit = self._onto_constraints(q, misfit)
        if not self._told_of_misfit:
            self._told_of_misfit = checks.tell_of_misfit(self._bodies, misfit)
        return q, A

    def _onto_constraints(self, q: np.ndarray, misfit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        constraints = self._bodies.constraints
        if not len(constraints.pairs):
            return q, misfit
        try:
            satisfied = constraints.satisfied(q)
            constraints.rank(satisfied)
        except ConstraintError as error:
            raise RigidityError(f"the positions do not satisfy the constraints: {error}") from None
        moved = np.linalg.norm(satisfied - q, axis=0)
        if not moved.max() <= FARTHEST:
            worst = int(np.where(np.isfinite(moved), moved, np.inf).argmax())
            raise RigidityError(
                f"{self._bodies.describe(worst)} is {moved[worst]:.4f} nm from where its constraints want it, at most "
                f"{FARTHEST} nm can be mended. Is the molecule whole (not cut by the periodic boundary)? "
                "context.applyConstraints(1e-6) may mend it"
            )
        return satisfied, np.maximum(misfit, moved)

    def notice_environment(self, before: Snapshot | None, now: Snapshot) -> None:
        """Invalidate forces if the box or parameters have changed."""
        if not now.same_environment(before):
            self._invalidate_forces()

    def _momenta(self, velocities: np.ndarray, q: np.ndarray, A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        try:
            p, L = self._bodies.momenta(velocities, A)
        except NotFiniteError as error:
            raise openmm.OpenMMException(
                f"The velocities of {self._bodies.describe(error.body)} in the Context are not finite"
            ) from None
        return self._bodies.constraints.project(q, p), L
