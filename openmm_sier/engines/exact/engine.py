"""The exact engine: the Context holds the atoms, the engine the bodies, which it rotates exactly.

A call of `step` takes over the atoms (`context_reader`) if a user has set them, moves the bodies (`motion`) by forces
that the Context computes (`forces`), and publishes the atoms again. Per-atom variables of the integrator carry the
bodies in checkpoints (`packing`).
"""

from collections.abc import Collection
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
from openmm_sier.engines import neighbour_list, trajectories
from openmm_sier.engines.exact.actions import BodyActions
from openmm_sier.engines.exact.context_reader import ContextReader
from openmm_sier.engines.exact.forces import BodyForces, step_error
from openmm_sier.engines.exact.packing import StoredPoint
from openmm_sier.engines.exact.reading import AtomReader
from openmm_sier.engines.exact.updates import SystemUpdates
from openmm_sier.engines.records import Changes, Clock
from openmm_sier.engines.snapshot import holds_doubles
from openmm_sier.engines.trials import Outcome, Trial
from openmm_sier.engines.variables import HIDDEN_KINETIC
from openmm_sier.stability.step_check import StepCheck
from openmm_sier.system import checks, tables
from openmm_sier.system.find_bodies import bodies_of


class ExactEngine(ContextReader):
    """An engine as a Python layer over the Context.

    It makes the steps. `ContextReader` takes over changes of the Context, and `PointVerbs` has the questions and moves
    of ensembles and users.
    """

    name = "exact"
    repeats_noise = True
    _has_point = False

    def __init__(self, context: openmm.Context, method: IntegrationMethod, tally: Tally, bodies: BodySet | None):
        """
        Args:
            context: openmm.Context, which has the integrator.
            method: the scheme that will be executed.
            tally: of the integrator.
            bodies: the rigid bodies; None: those that the constraints form.

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
        self._reader = AtomReader(self.moving)
        self._remembers_list = neighbour_list.is_remembered(context)
        self._keeps_numbers = holds_doubles(context)
        self._environment = None
        self._published: tuple[BodyState, Clock] | None = None
        #: The operators of a step, and of one of whose end the energy is wanted; none after a change.
        self._calls: list[OperatorCall] = []
        self._calls_with_energy: list[OperatorCall] = []
        #: Whether Forces of the System act before each step.
        self._acts_between_steps = False
        self._last = None

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

    def make_trial(self, trial: Trial) -> Outcome:
        return trajectories.make_trial(self, trial)

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

    def _report_hidden_kinetic_energy(self) -> None:
        """Write the kinetic energy that OpenMM does not find in velocities of atoms, see `HIDDEN_KINETIC`."""
        of_atoms = 0.5 * float(np.einsum("i,ix,ix->", self._masses, self.forces.velocities, self.forces.velocities))
        hidden = self.kinetic_energy() - of_atoms
        share = hidden / (3 * np.count_nonzero(self._masses))
        self._integrator.setPerDofVariableByName(HIDDEN_KINETIC, np.full((len(self._masses), 3), share))

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
