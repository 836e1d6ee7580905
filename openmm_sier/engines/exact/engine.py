"""The exact engine: the Context holds the atoms, the engine the bodies, which it rotates exactly.

A call of `step` takes over the atoms (`reading`) if a user has set them, moves the bodies (`motion`) by forces that the
Context computes (`forces`), and publishes the atoms again. Per-atom variables of the integrator carry the bodies in
checkpoints (`packing`).
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import openmm

from openmm_sier.dynamics import operators
from openmm_sier.dynamics.barostat import MoleculeCentres
from openmm_sier.dynamics.bodies import BodySet, BodyState, NotFiniteError
from openmm_sier.dynamics.constraints import ConstraintError
from openmm_sier.dynamics.flow import Flow
from openmm_sier.dynamics.stages import KICK
from openmm_sier.engines import interrupts, neighbour_list
from openmm_sier.engines.exact.actions import BodyActions
from openmm_sier.engines.exact.forces import BodyForces, blown_up
from openmm_sier.engines.exact.motion import Motion
from openmm_sier.engines.exact.moving_bodies import MovingBodies
from openmm_sier.engines.exact.packing import sites_of_atoms
from openmm_sier.engines.exact.reading import Fitting, agreeing, stored_point, with_velocities
from openmm_sier.engines.exact.updates import SystemUpdates
from openmm_sier.engines.protocol import Clock, Engine, Memory, Task, TrajectoryError
from openmm_sier.engines.snapshot import Environment, Snapshot, holds_doubles
from openmm_sier.engines.variables import SITES, STATE_VARIABLES
from openmm_sier.stability.step_check import StepCheck
from openmm_sier.system import checks
from openmm_sier.system.find_bodies import BodyPlan, known_or_planned
from openmm_sier.system.temperature import Temperatures, temperatures


class ExactEngine(Engine):
    """An engine as a Python layer over the Context.

    Bodies that constraints keep rigid are known when the Context is created. Bodies that are only named get the
    geometry that they have at the first positions.
    """

    name = "exact"
    repeats_noise = True

    def __init__(self, task: Task):
        """
        Raises:
            RigidityError, openmm.OpenMMException: the System is refused, as the message says.
        """
        super().__init__(task)
        context = task.context
        self.updates = SystemUpdates(context)
        self._fitting = Fitting()
        self._remembers_list = neighbour_list.is_remembered(context)
        self._starts_anew = False
        self._moves_volume = False
        #: Whether positions that are set come back as they are, bit for bit, and nothing else changes with them.
        self._keeps_numbers = holds_doubles(context)
        self._point: BodyState | None = None
        #: Whether a user may have set positions or velocities since they were read.
        self._are_atoms_set = True
        #: Box and parameters for which forces were computed.
        self._environment: Environment | None = None
        self._published: tuple[BodyState, Clock] | None = None
        #: Whether the variables of the integrator hold an older phase point than the last one.
        self._is_unstored = False
        self._stepper: operators.Stepper | None = None
        #: The end of the last step, and what the bath within it made.
        self._last: tuple[BodyState, BodyState] | None = None
        self._evaluations_before = 0
        found = known_or_planned(context.getSystem(), task.bodies)
        self._plan = found if isinstance(found, BodyPlan) else None
        self._parts = None if isinstance(found, BodyPlan) else MovingBodies(context, found, task.flow, self.ledger)

    # --- the bodies ---

    @property
    def _made(self) -> MovingBodies:
        """Return the bodies and what is made for them, which named bodies need positions for."""
        if self._parts is None:
            self._settle(Snapshot.of(self._context))
        return self._parts  # type: ignore[return-value]

    def _settle(self, now: Snapshot) -> None:
        """Give named bodies the geometry that the Context carries or, the first time, that of its positions.

        Raises:
            RigidityError, openmm.OpenMMException: the positions do not form the bodies, or what they form is refused.
        """
        if self._plan is None:
            return
        sites = np.array(self._integrator.getPerDofVariableByName(SITES))
        if self._parts is not None and np.array_equal(sites_of_atoms(self._parts.bodies), sites):
            return
        made = MovingBodies(self._context, self._plan.bodies(now.positions, sites, now.box), self.flow, self.ledger)
        if self._moves_volume:
            checks.refuse_constant_pressure(self._context.getSystem(), made.bodies)
        self._evaluations_before = self.evaluations
        self._parts = made
        self._integrator.setPerDofVariableByName(SITES, sites_of_atoms(made.bodies))

    @property
    def moving(self) -> BodySet:  # type: ignore[override]
        return self._made.bodies

    @property
    def are_bodies_held(self) -> bool:
        """Tell whether the constraints of the System hold all bodies."""
        return self._made.are_held

    @property
    def check_step(self) -> StepCheck:
        return self._made.check_step

    @property
    def molecule_centres(self) -> MoleculeCentres:
        return self._made.molecule_centres

    @property
    def forces(self) -> BodyForces:
        """Return forces and torques on the bodies, computed by the Context, and energies."""
        return self._made.forces

    @property
    def motion(self) -> Motion:
        """Return the operators that move the bodies."""
        return self._made.motion

    @property
    def evaluations(self) -> int:  # type: ignore[override]
        return self._evaluations_before + (0 if self._parts is None else self._parts.forces.evaluations)

    @cached_property
    def actions(self) -> BodyActions:
        return BodyActions(self._context, self)

    # --- the phase point ---

    @property
    def point(self) -> BodyState:
        if self._point is None:
            raise openmm.OpenMMException("The Context has no positions yet")
        return self._point

    def change(self, operation: Callable[[BodyState], BodyState]) -> None:
        self._point = operation(self.point)

    def state(self) -> BodyState:
        if not self.is_current:
            self.take_over()
        return self.point

    def potential_energy(self) -> float:
        if self._starts_anew:
            self._forget_past()
        return self.forces.energy(self.point)

    def temperatures(self, conserved: bool) -> Temperatures:
        """Return temperatures in K, see `system.temperature`.

        They are those just after the bath if it was in the middle of the last step. There momenta have the distribution
        of the bath, whatever the step; later, kicks and inner steps make those of fast bonds too hot or too cold.
        """
        state = self.state()
        if self._last is not None and self._last[0] is state:
            state = self._last[1]
        return temperatures(self.bodies, state, conserved)

    # --- one call of the integrator's step ---

    def take_over(self) -> None:
        """Find the phase point and the clock of a Context in which a user may have changed anything.

        What is found depends on nothing but what the Context holds, so that a restart from a checkpoint is
        bit-identical.

        Raises:
            RigidityError: the positions do not form the bodies. Nothing has been changed then.
        """
        now, point, are_set = Snapshot.of(self._context), self._point, self._are_atoms_set
        # A minimizer leaves the atoms where it placed other bodies than those of the phase point.
        is_placed = point is not None and self.forces.is_at(point.q, point.A)
        moved = point is None or (are_set and not (is_placed and self._has(now.positions, self.forces.positions)))
        if moved:
            self.start_anew()
            self.refuse_cut_molecules(now)
            self._settle(now)
        is_other = moved or (are_set and not self._has(now.velocities, self.forces.velocities))
        if is_other:
            point = self._found(now, moved)
        self._point = point
        self.clock = Clock(now.time, now.steps)
        # What tells of a change comes after the change, so that an interrupted one is made again.
        if moved:
            self.forces.take_positions(now)
        if is_other:
            self.forces.velocities[:] = now.velocities
        self._take_environment(now)
        self.forces.select(self._groups, self.flow.fast_groups)
        self._are_atoms_set = False

    def _has(self, vectors: np.ndarray, written: np.ndarray) -> bool:
        """Tell whether vectors of the Context are, bit for bit, those that were written to it last."""
        return self._keeps_numbers and np.array_equal(vectors, written)

    def _found(self, now: Snapshot, moved: bool) -> BodyState:
        """Return the phase point of bodies that moved, or whose velocities were changed."""
        bodies, point = self.moving, self._point
        stored = point if self._is_unstored else stored_point(self._context, self._made.packing)
        agreed = None if stored is None else agreeing(bodies, stored, now, moved)
        if agreed is not None:
            return agreed
        if point is None or moved:
            q, A = self._fitting(bodies, now)
            point = BodyState(q, np.zeros_like(q), A, np.zeros_like(q))
        return with_velocities(bodies, point, now)

    def _take_environment(self, now: Snapshot) -> None:
        """Take over box and parameters of a Context where they differ."""
        if now.environment != self._environment:
            self._made.forget_forces()
            self._environment = now.environment

    def begin(self, flow: Flow) -> None:
        super().begin(flow)
        self._stepper = self._new_stepper()

    def _new_stepper(self) -> operators.Stepper:
        """Return what makes a step of the flow."""
        return self._made.motion.stepper(self.flow, self.inner_step(self.flow))

    def follow(self, steps: int, wants_energy: bool = False) -> None:
        flow = self.flow
        if self._stepper is None:
            self._stepper = self._new_stepper()
        if steps and self._starts_anew:
            self._forget_past()
        ends_with_kick = flow.scheme.stages[-1].operator == KICK
        for remaining in range(steps, 0, -1):
            if wants_energy and remaining == 1 and ends_with_kick:
                # The last force of the step is that at its end.
                forces = self.forces
                forces.take_energy(with_evaluation=forces.evaluations + flow.scheme.force_evaluations)
            if flow.updates_context and self.updates.act:
                with self.transaction():
                    self._complete(self._updated())
            else:
                # Velocities and clock of the Context are written only when the steps are over.
                self._complete(self.point)
            interrupts.act_on_pending()

    def remember(self) -> Memory:
        memory = super().remember()
        # OpenMM's barostats also move atoms of no body.
        return memory._replace(more=self.forces.positions.copy()) if self.updates.act else memory

    def go_back(self, memory: Memory, reverse: bool = False) -> None:
        if memory.more is not None:
            self.forces.positions[:] = memory.more
            self.forces.forget_place()
        super().go_back(memory, reverse)

    def _complete(self, point: BodyState) -> None:
        """Make one step from a phase point. After an error the engine is at the step before."""
        flow, (time, steps), mark = self.flow, self.clock, self.ledger.mark()
        self.forces.step = steps + 1
        try:
            if flow.updates_context and self.updates.stops_centre(steps):
                point = self._stopped(point)
            assert self._stepper is not None
            point = self._stepper(point)
            self._point, self.clock = point, Clock(time + flow.step, steps + 1)
        except BaseException as error:
            self.ledger.go_back(mark)
            if isinstance(error, NotFiniteError):
                raise blown_up(error, steps + 1) from None
            if isinstance(error, ConstraintError):
                raise TrajectoryError(
                    f"Step {steps + 1} failed: {error}. Is the step size too long, or a force too stiff for it? The "
                    "Context is left at the last completed step."
                ) from error
            raise
        thermal = self._made.motion.after_bath if flow.scheme.bath_divides_drift else None
        self._last = None if thermal is None else (point, thermal)

    def _stopped(self, point: BodyState) -> BodyState:
        """Return a phase point without the motion of the centre of mass, whose energy is counted as heat."""
        velocity = self.moving.centre_velocity(point.p)
        self.ledger.heat += self.moving.energy_of_shift(velocity, -velocity)
        return self.moving.shifted(point, -velocity)

    def _updated(self) -> BodyState:
        """Let barostats and thermostats of the System act, and return the phase point after that.

        Raises:
            RigidityError: the positions do not form the bodies any more.
        """
        return self._with_new_box() if self.updates.are_of_barostats else self._with_new_atoms()

    def _with_new_atoms(self) -> BodyState:
        self.publish()
        before = Snapshot.of(self._context)
        self.updates.let_act(self.flow.step)
        # A CustomIntegrator's own clock advances by the step size that it had when its Context was created.
        openmm.Context.setTime(self._context, self.clock.time + self.flow.step)
        bodies, point, now = self.moving, self.point, Snapshot.of(self._context)
        moved = not np.array_equal(now.positions, before.positions)
        q, A = self._fitting(bodies, now, point) if moved else (point.q, point.A)
        found = replace(point, q=q, p=bodies.constraints.project(q, point.p), A=A)
        if not (np.array_equal(now.velocities, before.velocities) and np.array_equal(A, point.A)):
            found = with_velocities(bodies, found, now)
        if moved:
            self.forces.take_positions(now)
        self._take_environment(now)
        return found

    def _with_new_box(self) -> BodyState:
        """Let barostats act. Most often they change nothing, and then nothing is read back."""
        bodies, point = self.moving, self.point
        self.forces.place(point.q, point.A)
        before = self._box()
        self.updates.let_act(self.flow.step)
        if self._box() == before:
            return point
        now = Snapshot.of(self._context)
        q, A = self._fitting(bodies, now, point)
        self.forces.take_positions(now)
        self._made.forget_forces()
        self._environment = now.environment
        return replace(point, q=q, p=bodies.constraints.project(q, point.p), A=A)

    def publish(self) -> None:
        """Write the phase point and the clock to the Context."""
        point, clock, context, forces = self.point, self.clock, self._context, self.forces
        if self._published is not None and forces.is_at(point.q, point.A):
            published, when = self._published
            if published is point and when == clock:
                return
        forces.place(point.q, point.A)
        openmm.Context.setVelocities(context, self.moving.move(point, forces.velocities))
        openmm.Context.setTime(context, clock.time)
        openmm.Context.setStepCount(context, clock.steps)
        self._is_unstored = True
        self._published = point, clock

    def store(self) -> None:
        """Write the phase point to the per-atom variables."""
        if not self._is_unstored:
            return
        integrator = self._integrator
        for name, values in zip(STATE_VARIABLES, self._made.packing.pack(self.point), strict=True):
            integrator.setPerDofVariableByName(name, values)
        self._is_unstored = False

    def variables_loaded(self) -> None:
        self._is_unstored = False

    def recover(self) -> None:
        if self._point is None or self._parts is None:
            return
        # Write everything, whatever the Context has.
        self._published = None
        self._parts.forget_forces()
        self._parts.forces.forget_place()
        self.publish()

    # --- between flows ---

    def _set_box(self, box: Any) -> None:
        super()._set_box(box)
        if self._environment is not None:
            self._environment = self._environment._replace(box=self._box())
        self._made.motion.follow(self._context)

    def prepare_for_volume_moves(self) -> None:
        self._moves_volume = True
        if self._parts is not None:
            super().prepare_for_volume_moves()

    def refuse_long_step(self, flow: Flow) -> None:
        if self._parts is not None:
            super().refuse_long_step(flow)

    # --- changes by users, and what a restart needs ---

    def atoms_moved(self) -> None:
        super().atoms_moved()
        self._are_atoms_set = True

    def forces_changed(self) -> None:
        super().forces_changed()
        self._stepper = None
        if self._parts is not None:
            self._parts.forces_changed()

    def start_anew(self) -> None:
        """Make the next forces depend on nothing but the Context's state, see `neighbour_list`."""
        self._starts_anew = self._remembers_list

    def _forget_past(self) -> None:
        """Do what `start_anew` asked for."""
        neighbour_list.forget(self._context)
        self._made.forget_forces()
        self._starts_anew = False
