"""The native engine: OpenMM executes the scheme, which is written out as the integrator's program, on any platform."""

from collections.abc import Collection
from functools import cached_property
from typing import Any

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.tally import Tally
from openmm_sier.engines.actions import Actions
from openmm_sier.engines.native import refusals
from openmm_sier.engines.native.atom_cache import AtomCache
from openmm_sier.engines.native.atom_verbs import AtomVerbs
from openmm_sier.engines.native.constrained_start import are_satisfied, satisfy_constraints
from openmm_sier.engines.native.installation import set_bath
from openmm_sier.engines.native.reported_bodies import ReportedBodies
from openmm_sier.engines.program import Program
from openmm_sier.engines.records import Changes, Clock, TrajectoryError, says_nan
from openmm_sier.engines.snapshot import Environment, Snapshot, time_of
from openmm_sier.engines.variables import PART
from openmm_sier.stability.step_check import StepCheck
from openmm_sier.system import tables
from openmm_sier.system.arguments import groups_of

#: Relative tolerance of constraints. OpenMM's default of 1e-5 leaves velocities wrong by 1e-5 of a bond for each
#: substep, a larger energy error than that of the schemes.
TOLERANCE = 1e-9

#: Positions in single precision cannot be constrained better.
SINGLE_TOLERANCE = 1e-6

#: Steps of one native step each in one call of OpenMM, after which signals are looked at.
AT_ONCE = 10


class NativeEngine(AtomVerbs):
    """An engine that is the program of the integrator.

    The Context has the state after each call, but for velocities that wait in `AtomCache` for `publish`. An error in
    mid-step leaves it where it happened, as with OpenMM's integrators. The massive atoms move; rigid bodies are only
    reported to users.
    """

    name = "native"

    def __init__(
        self, context: openmm.Context, method: IntegrationMethod, tally: Tally, bodies: BodySet | None, program: Program
    ) -> None:
        """Keep the program that is written for the method; see `make_engine` for all arguments.

        Raises:
            openmm.OpenMMException: the integrator needs what only the exact engine has, such as bodies that are not
                rigid by constraints, or the System has a Force that does not work with divided steps.
        """
        super().__init__(context, method, tally)
        system, integrator = context.getSystem(), context.getIntegrator()
        self._program = program
        self._refuse_system(system, bodies)
        self.accept(method, self._groups)
        self._constraints = tables.constraints(system)
        self._has_sites = tables.virtual_sites(system).size > 0
        self.moving = refusals.points(system)
        self._reported = ReportedBodies(system, bodies, self.moving)
        self.step_check = StepCheck(system, self.moving, self._reported.species, program.inner_fraction)
        #: The step size of OpenMM's own clock.
        self._step_of_clock = openmm.CustomIntegrator.getStepSize(integrator).value_in_unit(unit.picosecond)
        self._potential = None
        self._has_force = False
        self._follows_bath = False
        self._atoms = AtomCache(context, is_single=self.precision == "single")
        self._checks_positions = refusals.needs_finite_positions(system, context.getPlatform())
        if self.precision == "single":
            integrator.setConstraintTolerance(max(SINGLE_TOLERANCE, integrator.getConstraintTolerance()))

    def _refuse_system(self, system: openmm.System, bodies: BodySet | None) -> None:
        """Refuse a System that the engine cannot move, see `refusals.refuse_system`."""
        refusals.refuse_system(system, bodies)

    @property
    def clock(self) -> Clock:
        return Clock(time_of(self._context), self._context.getStepCount())

    @clock.setter
    def clock(self, clock: Clock) -> None:
        openmm.Context.setTime(self._context, clock.time)
        openmm.Context.setStepCount(self._context, clock.steps)

    @cached_property
    def actions(self) -> Actions:
        return Actions(self._context, self)

    # --- changes by users ---

    def accept(self, method: IntegrationMethod, groups: int | None = None) -> None:
        refusals.refuse_method(method, self._program)
        if groups is not None:
            system = self._context.getSystem()
            refusals.refuse_fast_forces(system, groups_of(method.fast_groups), groups)
            refusals.refuse_other_slow_groups(self._program, system, groups, method.fast_groups)

    def synchronize(self) -> None:
        changes = self.changes
        self._set_bath()
        if Changes.ATOMS in changes:
            self._atoms.forget()
            self._follows_bath = False
        if Changes.BOX in changes:
            self._atoms.forget()
            # OpenMM takes the forces of the last step for valid if only the box was changed. To set velocities, though
            # they are the same, makes it compute them.
            openmm.Context.setVelocities(self._context, self._atoms.velocities)
            self._has_force = False
        if Changes.FORCES in changes:
            # OpenMM itself considers no force valid after that.
            self._potential = None
        if changes & (Changes.ATOMS | Changes.HISTORY):
            self._check_start()
        self.forget_history()
        if self._potential is not None:
            state = openmm.Context.getState(self._context, parameters=True)
            if Environment.of(state) != self._potential.environment:
                self._potential = None
        self.changes = Changes.SETTINGS

    def _check_start(self) -> None:
        """Check atoms that were moved, and satisfy constraints."""
        self._potential = None
        self._velocities_changed()
        self._atoms.publish()
        now = Snapshot.of(self._context)
        now.refuse_what_is_not_finite()
        self.refuse_cut_molecules(now)
        if len(self._constraints.pairs):
            self.solver_test.refuse(lambda: now.positions)
            satisfy_constraints(self._context, self._constraints, self._integrator.getConstraintTolerance())
        if self._has_sites:
            # OpenMM places them at the end of a step, and the first needs forces before that.
            self._context.computeVirtualSites()
        self._atoms.forget()

    def _set_bath(self) -> None:
        set_bath(self._integrator, self.method.bath)

    def select_groups(self) -> None:
        """Make the Context again: OpenMM fixes the groups when it reads the program."""
        self._context.reinitialize(preserveState=True)

    # --- steps ---

    def propagate(self, steps: int, signals: Collection[Any] = (), wants_energy: bool = False) -> int:
        if self.method.step == 0:
            # Steps of zero length are only counted: the program would divide by zero.
            time, count = self.clock
            self.clock = Clock(time, count + steps)
            return steps
        if not steps:
            return 0
        if not self._has_force:
            self.evaluations += int(self.method.scheme.reuses_force)
            self._has_force = True
        self._potential = None
        self._atoms.forget()
        # Where positions are looked at, or a step is divided into native ones, steps are made one by one.
        at_once = 1 if self._checks_positions or len(self._program.parts) > 1 else AT_ONCE
        made = 0
        try:
            while made < steps:
                number = min(steps - made, at_once)
                self._advance(number)
                made += number
                if signals:
                    break
        finally:
            if not self._program.ends_constrained:
                openmm.Context.applyVelocityConstraints(self._context, self._integrator.getConstraintTolerance())
        # An end whose energy is asked for may become a sample, and OpenMM's solvers do not say where they stop.
        if wants_energy and not are_satisfied(self._constraints, self.positions()):
            raise TrajectoryError("OpenMM could not satisfy the constraints at the end of a trajectory")
        return made

    def _advance(self, steps: int) -> None:
        """Make steps by native ones, of which OpenMM counts as many as a step has parts."""
        context, integrator, parts = self._context, self._integrator, len(self._program.parts) or 1
        # OpenMM's own clock takes the step that the Context was created with, on the CPU and Reference platforms.
        is_clock_right = parts == 1 and self.method.step == self._step_of_clock
        time, count = 0.0 if is_clock_right else time_of(context), context.getStepCount()
        native_steps = steps * parts
        in_a_call = 1 if self._checks_positions else native_steps
        made = steps
        try:
            for _ in range(0, native_steps, in_a_call):
                openmm.CustomIntegrator.step(integrator, in_a_call)
                if self._checks_positions:
                    self._refuse_lost_atoms(count + 1)
        except openmm.OpenMMException as error:
            # It leaves the clock at the last completed step, as OpenMM does.
            made = (context.getStepCount() - count) // parts
            # The next native step is the first part of a step.
            integrator.setGlobalVariableByName(PART, 0.0)
            if says_nan(error) and not isinstance(error, TrajectoryError):
                raise TrajectoryError(str(error)) from error
            raise
        finally:
            if not is_clock_right:
                self.clock = Clock(time + made * self.method.step, count + made)
            self._follows_bath = self._follows_bath or made > 0
            self.evaluations += made * self.method.scheme.force_evaluations

    def _refuse_lost_atoms(self, step: int) -> None:
        """Raise a TrajectoryError that names the step if positions or velocities are not finite."""
        now = Snapshot.of(self._context)
        if not (np.isfinite(now.positions).all() and np.isfinite(now.velocities).all()):
            raise TrajectoryError(
                f"A position or velocity is not finite in step {step}. Is the step size too long, or do atoms overlap?"
            )

    def publish(self) -> None:
        """Write velocities that an ensemble changed; all else the Context has at any time."""
        if self._atoms.is_unwritten:
            self._atoms.publish()

    def recover(self) -> None:
        self._atoms.publish()
