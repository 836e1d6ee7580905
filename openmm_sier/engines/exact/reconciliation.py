"""The bodies' state found from what a Context holds: after a restart, and after changes from outside."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodyState, NotFiniteError, RigidBodies, RigidityError
from openmm_sier.dynamics.constraints import ConstraintError
from openmm_sier.engines.exact import packing
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.system import checks

#: Points further than this from their constraints, in nm, are refused, since they are not the molecule that was meant.
FARTHEST = 0.05


class Reconciliation:
    """Finds the phase point of bodies in snapshots of a Context."""

    def __init__(self, bodies: RigidBodies):
        self._bodies = bodies
        self._told_of_misfit = False

    def recall(self, values: np.ndarray, now: Snapshot, moved: bool) -> BodyState | None:
        """A stored state, if it reproduces the atoms to the last bit.

        It does so after a checkpoint or a State with integrator parameters was loaded. If velocities were set after
        that, the stored centres and attitudes are still used.

        Args:
            values: of the variables that hold it, see `packing`.
            now: what the Context holds.
            moved: whether its positions differ from those before.

        Returns:
            The state; None if the atoms are elsewhere.
        """
        bodies = self._bodies
        if not values.any() or not np.isfinite(values).all():
            return None
        state = packing.unpack(bodies, values)
        if not np.array_equal(bodies.place(state.q, state.A, now.positions.copy()), now.positions):
            return None
        if np.array_equal(bodies.move(state, now.velocities.copy()), now.velocities):
            return state
        return self._with_velocities(state, now) if moved else None

    def reconcile(self, old: BodyState | None, before: Snapshot | None, now: Snapshot) -> BodyState:
        """The state after the Context changed from one snapshot to another.

        Args:
            old: the state at the earlier snapshot.
            before: the earlier snapshot; None if there is none.
            now: what the Context holds.

        Raises:
            RigidityError: the positions do not form the bodies.
        """
        if old is None or before is None:
            q, A = self.fit(now)
            return self._with_velocities(BodyState(q, np.zeros_like(q), A, np.zeros_like(q)), now)
        q, A = (old.q, old.A) if now.same_positions(before) else self.fit(now, old)
        if now.same_velocities(before) and np.array_equal(A, old.A):
            return replace(old, q=q, p=self._bodies.constraints.project(q, old.p), A=A)
        return self._with_velocities(replace(old, q=q, A=A), now)

    def fit(self, now: Snapshot, previous: BodyState | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Bodies at the positions of a snapshot, (q, A); warns once of those that are moved onto their constraints.

        Raises:
            RigidityError: the positions do not form the bodies, or are far off the constraints between them.
        """
        q, A, misfit = self._bodies.fit_with_misfit(now.positions, previous)
        if len(self._bodies.constraints.pairs):
            q, moved = self._onto_constraints(q)
            misfit = np.maximum(misfit, moved)
        if not self._told_of_misfit:
            self._told_of_misfit = checks.tell_of_misfit(self._bodies, misfit)
        return q, A

    def _onto_constraints(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points on their constraints, and the distance by which each was moved."""
        constraints = self._bodies.constraints
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
        return satisfied, moved

    def _with_velocities(self, state: BodyState, now: Snapshot) -> BodyState:
        """A state with the momenta that the atoms' velocities carry."""
        try:
            p, L = self._bodies.momenta(now.velocities, state.A)
        except NotFiniteError as error:
            raise openmm.OpenMMException(
                f"The velocities of {self._bodies.describe(error.body)} in the Context are not finite"
            ) from None
        return replace(state, p=self._bodies.constraints.project(state.q, p), L=L)
