"""The exact engine: the Context holds the atoms, the engine the bodies, which it rotates exactly.

A call of `step` takes over the atoms (`reading`) if a user has set them, moves the bodies (`motion`) by forces that the
Context computes (`forces`), and publishes the atoms again. Per-atom variables of the integrator carry the
bodies in checkpoints (`packing`).
"""

from collections.abc import Collection
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet, BodyState, NotFiniteError
from openmm_sier.dynamics.constraints import ConstraintError
from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.operators import OperatorCall, always, calls
from openmm_sier.dynamics.plan import Energy, UpdateContext
from openmm_sier.dynamics.tally import Mark, Tally
from openmm_sier.engines.exact.actions import BodyActions
from openmm_sier.engines.exact.forces import BodyForces, step_error
from openmm_sier.engines.exact.motion import MotionOperators
from openmm_sier.engines.exact.packing import StoredPoint
from openmm_sier.engines.exact.point_verbs import PointVerbs
from openmm_sier.engines.exact.reading import AtomChange, AtomReader, with_velocities
from openmm_sier.engines.exact.updates import SystemUpdates
from openmm_sier.engines.records import Changes, Clock
from openmm_sier.engines.snapshot import Snapshot, holds_doubles
from openmm_sier.stability.step_check import StepCheck
from openmm_sier.system import checks, tables
from openmm_sier.system.find_bodies import bodies_of


class ExactEngine(PointVerbs):
    """An engine as a Python layer over the Context.

    It takes over changes of the Context and makes the steps; `PointVerbs` has what ensembles and users ask.
    """

    name = "exact"
    repeats_noise = True

    def __init__(self, context: openmm.Context, method: IntegrationMethod, tally: Tally, bodies: BodySet | None):
        """Find the bodies; see `make_engine` for all arguments.

        Raises:
            RigidityError, openmm.OpenMMException: the System is refused, as the message says.
        """
        super().__init__(context, method, tally)
        system = context.getSystem()
        self.moving = bodies_of(system, bodies)
        checks.refuse_deforming_barostats(system, context.getMolecules, self.moving)
        checks.refuse_hits_on_atoms(system, self.moving)
        self.accept(method)
        self.step_check = StepCheck(system, self.moving)
        self.updates = SystemUpdates(context)
        self.forces = BodyForces(context, self.moving)
        self.motion = self._new_motion()
        self._stored = StoredPoint(context, self.moving)
        self._masses = tables.masses(system)
        self._hides_kinetic_energy = self.moving.has_other_moments
        self._reader = AtomReader(self.moving, self.forces, keeps_numbers=holds_doubles(context))
        self._published: tuple[BodyState, Clock] | None = None
        #: The operators of a step, and of one of whose end the energy is wanted; none after a change.
        self._calls: list[OperatorCall] = []
        self._calls_with_energy: list[OperatorCall] = []
        #: Whether Forces of the System act before each step.
        self._acts_between_steps = False

    @property
    def bodies(self) -> BodySet:
        return self.moving

    @property
    def evaluations(self) -> int:  # type: ignore[override]
        return self.forces.evaluations

    @cached_property
    def actions(self) -> BodyActions:
        return BodyActions(self._context, self, self.forces)

    # --- changes by users ---

    def accept(self, method: IntegrationMethod, groups: int | None = None) -> None:
        """Accept any method whose frictions, if they are those of types, fit the types of the bodies."""
        if method.bath is None:
            return
        try:
            method.bath.frictions(self.moving)
        except ValueError as error:
            raise openmm.OpenMMException(str(error)) from None

    def select_groups(self) -> None:
        self.changes |= Changes.FORCES | Changes.FAST

    def synchronize(self) -> None:
        """Find the phase point and the clock of a Context in which a user may have changed anything.

        The result depends only on the contents of the Context, so that a restart from a checkpoint is bit-identical.

        Raises:
            RigidityError: the positions do not form the bodies. Nothing has been changed then.
        """
        now = Snapshot.of(self._context)
        last = self.point if self._has_point else None
        change = self._reader.change(now, last, is_set=Changes.ATOMS in self.changes)
        if change is not AtomChange.NONE:
            point = self._read_point(now, last, change)
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
        if self.forget_history():
            self._forget_forces()
        self._calls = []
        # What is left is the check of the step. Set last, so that an interrupted synchronization is repeated.
        self.changes = Changes.SETTINGS

    def _read_point(self, now: Snapshot, last: BodyState | None, change: AtomChange) -> BodyState:
        """Return the phase point of the atoms of a Context.

        Raises:
            RigidityError: the positions do not form the bodies.
        """
        if change is AtomChange.POSITIONS:
            self.refuse_cut_molecules(now)
        is_loaded = Changes.VARIABLES in self.changes
        # After a checkpoint is made, what it holds counts as in a restart from it.
        is_stored = is_loaded or not self._stored.is_outdated
        stored = self._stored.latest(last, is_loaded)
        point = self._reader.point(now, stored, last, change, fits_stored=is_stored)
        if point is not stored:
            self._stored.is_outdated = True
        # Atoms of no body act on the bodies too, and may have been moved.
        return replace(point) if change is AtomChange.POSITIONS else point

    @tables.read_once()
    def _new_motion(self) -> MotionOperators:
        fast_groups, rotation = self._groups & self.method.fast_groups, self.method.rotation
        fast = [i for i, group in enumerate(self._force_groups.values()) if fast_groups >> group & 1]
        return MotionOperators(self._context, self.moving, self.forces.compute, rotation, fast, self.tally)

    # --- steps ---

    def propagate(self, steps: int, signals: Collection[Any] = (), wants_energy: bool = False) -> int:
        if not self._calls:
            self._make_calls()
        for remaining in range(steps, 0, -1):
            made = self._calls_with_energy if wants_energy and remaining == 1 else self._calls
            if self._acts_between_steps:
                with self.transaction():
                    self._complete(made)
            else:
                # Velocities and clock of the Context are written only when the steps are over.
                self._complete(made)
            if signals:
                return steps - remaining + 1
        return steps

    def _make_calls(self) -> None:
        """Make the operators of a step by the plan of the method."""
        method, motion, updates = self.method, self.motion, self.updates
        self._acts_between_steps = method.updates_context and updates.acts
        has_updates = method.updates_context and (updates.acts or bool(updates.removers))
        plan = motion.plan(method, self.inner_step(method), has_updates)
        table = {
            **motion.table(method),
            UpdateContext: always(self._updated),
            Energy: always(self.forces.with_energy),
        }
        self._calls = calls(plan.operations, table, method.step)
        self._calls_with_energy = calls(plan.with_energy().operations, table, method.step)

    def _complete(self, made: list[OperatorCall]) -> None:
        """Make one step by the calls of its operators. After an error the engine is at the step before."""
        method, (time, steps), tally = self.method, self.clock, self.tally
        mark, start = Mark(tally.heat, tally.draws), self.point
        point, thermal = start, None
        self.forces.step = steps + 1
        try:
            for operator, times, is_bath in made:
                point = operator(point, *times)
                if is_bath:
                    thermal = point
            self.point = point
            self.clock = Clock(time + method.step, steps + 1)
        except BaseException as error:
            self.point = start
            self.clock = Clock(time, steps)
            tally.restore(mark)
            if isinstance(error, NotFiniteError | ConstraintError):
                raise step_error(error, steps + 1) from error
            raise
        self._last = (point, thermal) if thermal is not None and method.scheme.bath_divides_drift else None

    def publish(self) -> None:
        """Write the phase point and the clock to the Context."""
        point, clock, context, forces = self.point, self.clock, self._context, self.forces
        if self._published == (point, clock) and forces.is_at(point.q, point.A):
            return
        forces.place(point.q, point.A)
        openmm.Context.setVelocities(context, self.moving.move(point, forces.velocities))
        openmm.Context.setTime(context, clock.time)
        openmm.Context.setStepCount(context, clock.steps)
        self._stored.is_outdated = True
        self._published = point, clock
        if self._hides_kinetic_energy:
            self._report_hidden_kinetic_energy()

    def recover(self) -> None:
        if not self._has_point:
            return
        # Write everything, whatever the Context has.
        self._published = None
        self._forget_forces()
        self.forces.forget_place()
        self.publish()

    def store(self) -> None:
        """Write the phase point to the per-atom variables."""
        if self._stored.is_outdated and Changes.VARIABLES not in self.changes:
            self._stored.write(self.point)

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
