"""What the exact engine takes over from its Context: changes by users, and by Forces that act between steps."""

from abc import abstractmethod
from dataclasses import replace

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodyState
from openmm_sier.dynamics.operators import OperatorCall
from openmm_sier.engines import neighbour_list
from openmm_sier.engines.exact.motion import MotionOperators
from openmm_sier.engines.exact.packing import StoredPoint
from openmm_sier.engines.exact.point_verbs import PointVerbs
from openmm_sier.engines.exact.reading import AtomChange, AtomReader, with_velocities
from openmm_sier.engines.records import Changes, Clock
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.system import tables


class ContextReader(PointVerbs):
    """An engine that reads its phase point from the atoms of a Context."""

    _reader: AtomReader
    _stored: StoredPoint
    _has_point: bool
    #: Whether positions that are set come back as they are, bit for bit, and nothing else changes with them.
    _keeps_numbers: bool
    #: Whether forces depend on the history of a neighbour list.
    _remembers_list: bool
    #: The operators of a step; none after a change.
    _calls: list[OperatorCall]
    #: Whether velocities of atoms carry less than the kinetic energy, see `HIDDEN_KINETIC`.
    _hides_kinetic_energy: bool

    @abstractmethod
    def _report_hidden_kinetic_energy(self) -> None:
        """Write the kinetic energy that OpenMM does not find in velocities of atoms."""

    # --- changes by users ---

    def synchronize(self) -> None:
        """Find the phase point and the clock of a Context in which a user may have changed anything.

        The result depends only on the contents of the Context, so that a restart from a checkpoint is bit-identical.

        Raises:
            RigidityError: the positions do not form the bodies. Nothing has been changed then.
        """
        now = Snapshot.of(self._context)
        change = self._atom_change(now)
        if change is not AtomChange.NONE:
            point = self._read_point(now, change)
        if Changes.FAST in self.changes:
            self.motion = self._new_motion()
        if change is not AtomChange.NONE:
            self.point = point
            self._has_point = True
            self.forces.velocities[:] = now.velocities
            if self._hides_kinetic_energy:
                self._report_hidden_kinetic_energy()
        if Changes.FORCES in self.changes:
            self._forget_forces()
        self.clock = Clock(now.time, now.steps)
        if change is AtomChange.POSITIONS:
            self.forces.take_positions(now)
        self._take_environment(now)
        self.forces.select(self._groups, self.method.fast_groups)
        if self._remembers_list and (change is AtomChange.POSITIONS or Changes.HISTORY in self.changes):
            neighbour_list.forget(self._context)
            self._forget_forces()
        self._calls = []
        # What is left is the check of the step. Set last, so that an interrupted synchronization is repeated.
        self.changes = Changes.SETTINGS

    def _fast_forces(self) -> list[int]:
        """Return the indices of the Forces in fast groups."""
        fast = self._groups & self.method.fast_groups
        return [i for i, group in enumerate(self._force_groups.values()) if fast >> group & 1]

    def _atom_change(self, now: Snapshot) -> AtomChange:
        """Return how the atoms of the Context differ from those of the phase point."""
        if not self._has_point:
            return AtomChange.POSITIONS
        if Changes.ATOMS not in self.changes:
            return AtomChange.NONE
        # A minimizer leaves the atoms where it placed other bodies than those of the phase point.
        is_placed = self.forces.is_at(self.point.q, self.point.A)
        if not (is_placed and self._has(now.positions, self.forces.positions)):
            return AtomChange.POSITIONS
        if not self._has(now.velocities, self.forces.velocities):
            return AtomChange.VELOCITIES
        return AtomChange.NONE

    def _has(self, vectors: np.ndarray, written: np.ndarray) -> bool:
        """Return whether vectors of the Context are, bit for bit, those that were written to it last."""
        return self._keeps_numbers and np.array_equal(vectors, written)

    def _read_point(self, now: Snapshot, change: AtomChange) -> BodyState:
        """Return the phase point of the atoms of a Context.

        Raises:
            RigidityError: the positions do not form the bodies.
        """
        if change is AtomChange.POSITIONS:
            self.refuse_cut_molecules(now)
        last = self.point if self._has_point else None
        stored = self._stored.latest(last, is_loaded=Changes.VARIABLES in self.changes)
        point = self._reader.point(now, stored, last, change)
        if point is not stored:
            self._stored.is_outdated = True
        # Atoms of no body act on the bodies too, and may have been moved.
        return replace(point) if change is AtomChange.POSITIONS else point

    def _take_environment(self, now: Snapshot) -> None:
        """Take over box and parameters of a Context where they differ."""
        if now.environment != self._environment:
            self._forget_forces()
            self._environment = now.environment

    def _forget_forces(self) -> None:
        """Compute forces again next time: positions, box or parameters were changed."""
        if self._has_point:
            self.point = replace(self.point)
        self.motion.follow(self._context)

    @tables.read_once()
    def _new_motion(self) -> MotionOperators:
        fast, rotation = self._fast_forces(), self.method.rotation
        return MotionOperators(self._context, self.moving, self.forces.compute, rotation, fast, self.tally)

    # --- Forces that act between steps ---

    def _updated(self, point: BodyState) -> BodyState:
        """Let the Forces that act between steps do so, and return the phase point after that.

        Raises:
            RigidityError: the positions do not form the bodies any more.
        """
        if self.updates.acts:
            point = self._with_new_box() if self.updates.are_of_barostats else self._with_new_atoms()
        # A CMMotionRemover acts after each number of steps that its frequency divides.
        if 0 in map(self.clock.steps.__mod__, self.updates.removers):
            point, energy = self.moving.stopped(point)
            self.tally.heat -= energy
        return point

    def _with_new_atoms(self) -> BodyState:
        self.publish()
        before = Snapshot.of(self._context)
        self.updates.let_act(self.method.step)
        # A CustomIntegrator's own clock advances by the step size that it had when its Context was created.
        openmm.Context.setTime(self._context, self.clock.time + self.method.step)
        bodies, point, now = self.moving, self.point, Snapshot.of(self._context)
        moved = not np.array_equal(now.positions, before.positions)
        q, A = self._reader.fit(now, point) if moved else (point.q, point.A)
        updated = BodyState(q, bodies.constraints.project(q, point.p), A, point.L, None if moved else point.cache)
        if not (np.array_equal(now.velocities, before.velocities) and np.array_equal(A, point.A)):
            updated = with_velocities(bodies, updated, now)
        if moved:
            self.forces.take_positions(now)
        if now.environment != self._environment:
            self._take_environment(now)
            updated = replace(updated)
        return updated

    def _with_new_box(self) -> BodyState:
        """Let barostats act. Most often they change nothing, and then nothing is read back."""
        bodies, point = self.moving, self.point
        self.forces.place(point.q, point.A)
        before = self._box()
        self.updates.let_act(self.method.step)
        if self._box() == before:
            return point
        now = Snapshot.of(self._context)
        q, A = self._reader.fit(now, point)
        self.forces.take_positions(now)
        self._forget_forces()
        self._environment = now.environment
        return BodyState(q, bodies.constraints.project(q, point.p), A, point.L)
