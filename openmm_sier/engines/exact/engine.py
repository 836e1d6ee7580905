"""The exact engine: the Context holds the atoms, the engine the bodies, which it rotates exactly.

A call of `step` takes over the atoms (`reading`), moves the bodies (`motion`) by forces that the Context computes
(`forces`), and publishes the atoms again. Per-atom variables of the integrator carry the bodies in checkpoints
(`packing`).
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import openmm
from openmm import unit

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
from openmm_sier.engines.exact.reading import Fitting, stored_point, with_velocities
from openmm_sier.engines.exact.updates import SystemUpdates
from openmm_sier.engines.protocol import Clock, Engine, Task, TrajectoryError
from openmm_sier.engines.snapshot import Snapshot, holds_doubles
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
        self._is_box_new = False
        self._point: BodyState | None = None
        #: The Context as it was when it held the phase point: one that differs was changed from outside.
        self._agreed: Snapshot | None = None
        self._published: tuple[BodyState, Clock] | None = None
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
        self.take_over()
        return self.point

    def potential_energy(self) -> float:
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
        """Find the phase point and the clock of a Context in which anything may have been changed from outside.

        What is found depends on nothing but what the Context holds, so that a restart from a checkpoint is
        bit-identical.

        Raises:
            RigidityError: the positions do not form the bodies. Nothing has been changed then.
        """
        now, before, point = Snapshot.of(self._context), self._agreed, self._point
        moved = point is None or not now.same_positions(before)
        if moved:
            self.start_anew()
            self.refuse_cut_molecules(now)
            self._settle(now)
        if point is None or moved or not now.same_velocities(before):
            point = self._found(now, moved)
            self.forces.velocities[:] = now.velocities
        self._agree(now, moved)
        self.forces.select(self._groups, self.flow.fast_groups)
        self._point, self.clock = point, Clock(now.time, now.steps)

    def _found(self, now: Snapshot, moved: bool) -> BodyState:
        """Return the phase point of bodies that moved, or whose velocities were changed."""
        bodies, point = self.moving, self._point
        stored = stored_point(self._context, self._made.packing, now, moved)
        if stored is not None:
            return stored
        if point is None or moved:
            q, A = self._fitting(bodies, now)
            point = BodyState(q, np.zeros_like(q), A, np.zeros_like(q))
        return with_velocities(bodies, point, now)

    def _agree(self, now: Snapshot, moved: bool) -> None:
        """Take over positions, box and parameters of a Context where they differ."""
        if moved:
            self.forces.take_positions(now)
        if not now.same_environment(self._agreed):
            self._made.forget_forces()
        self._agreed = now

    def follow(self, steps: int, wants_energy: bool = False) -> None:
        flow = self.flow
        step = self._made.motion.stepper(flow, self.inner_step(flow))
        ends_with_kick = flow.scheme.stages[-1].operator == KICK
        if steps:
            self._forget_past()
        for remaining in range(steps, 0, -1):
            if wants_energy and remaining == 1 and ends_with_kick:
                # The last force of the step is that at its end.
                forces = self.forces
                forces.take_energy(with_evaluation=forces.evaluations + flow.scheme.force_evaluations)
            if flow.updates_context and self.updates.act:
                self._step_after_updates(step)
            else:
                # The Context is written to only when the steps are over.
                self._complete(self.point, step)
            interrupts.act_on_pending()

    def _step_after_updates(self, step: operators.Stepper) -> None:
        """Make one step, after the System's barostats and thermostats have acted."""
        start, before = self._point, openmm.Context.getState(self._context, positions=True)
        try:
            point = self._with_new_box() if self.updates.are_of_barostats else self._with_new_atoms()
            self._complete(point, step)
        except BaseException:
            # An error may come when the step is complete.
            if self._point is start:
                openmm.Context.setPeriodicBoxVectors(self._context, *before.getPeriodicBoxVectors())
                # A barostat also moves atoms of no body.
                self.forces.positions[:] = before.getPositions(asNumpy=True).value_in_unit(unit.nanometer)
            raise

    def _complete(self, point: BodyState, step: operators.Stepper) -> None:
        """Make one step from a phase point. After an error the engine is at the step before."""
        flow, (time, steps), mark = self.flow, self.clock, self.ledger.mark()
        self.forces.step = steps + 1
        try:
            if flow.updates_context and self.updates.stops_centre(steps):
                point = self._stopped(point)
            point = step(point)
            # In one line, so that an error finds the clock, the bodies and the ledger in agreement.
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

    def _with_new_atoms(self) -> BodyState:
        """Let barostats and thermostats act, and return the phase point after that.

        Raises:
            RigidityError: the positions do not form the bodies any more.
        """
        self.publish()
        self.updates.let_act(self.flow.step)
        # A CustomIntegrator's own clock advances by the step size that it had when its Context was created.
        self._context.setTime(self.clock.time + self.flow.step)
        bodies, point, now, before = self.moving, self.point, Snapshot.of(self._context), self._agreed
        moved = not now.same_positions(before)
        q, A = self._fitting(bodies, now, point) if moved else (point.q, point.A)
        found = replace(point, q=q, p=bodies.constraints.project(q, point.p), A=A)
        if not (now.same_velocities(before) and np.array_equal(A, point.A)):
            found = with_velocities(bodies, found, now)
        self._agree(now, moved)
        return found

    def _with_new_box(self) -> BodyState:
        """Let barostats act. Most often they change nothing, and then nothing is read back."""
        bodies, point = self.moving, self.point
        self.forces.place(point.q, point.A)
        before = self._box()
        self.updates.let_act(self.flow.step)
        if self._box() == before:
            return point
        self._is_box_new = True
        now = Snapshot.of(self._context)
        q, A = self._fitting(bodies, now, point)
        self.forces.take_positions(now)
        self._made.forget_forces()
        return replace(point, q=q, p=bodies.constraints.project(q, point.p), A=A)

    def publish(self) -> None:
        """Write the phase point and the clock to the Context, and to the variables that travel in checkpoints."""
        point, clock, context, forces = self.point, self.clock, self._context, self.forces
        if self._published is not None and forces.is_at(point.q, point.A):
            published, when = self._published
            if published is point and when == clock:
                return
        forces.place(point.q, point.A)
        openmm.Context.setVelocities(context, self.moving.move(point, forces.velocities))
        integrator = self._integrator
        for name, values in zip(STATE_VARIABLES, self._made.packing.pack(point), strict=True):
            integrator.setPerDofVariableByName(name, values)
        context.setTime(clock.time)
        context.setStepCount(clock.steps)
        self._published = point, clock
        if self._keeps_numbers and self._agreed is not None and not self._is_box_new:
            self._agreed = self._agreed.with_atoms(forces.positions, forces.velocities)
        else:
            self._agreed, self._is_box_new = Snapshot.of(context), False

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
        self._is_box_new = True
        self._made.motion.follow(self._context)

    def prepare_for_volume_moves(self) -> None:
        self._moves_volume = True
        if self._parts is not None:
            super().prepare_for_volume_moves()

    def refuse_long_step(self, flow: Flow) -> None:
        if self._parts is not None:
            super().refuse_long_step(flow)

    # --- news from outside ---

    def forces_changed(self) -> None:
        super().forces_changed()
        if self._parts is not None:
            self._parts.forces_changed()

    def start_anew(self) -> None:
        """Make the next forces depend on nothing but the Context's state, see `neighbour_list`."""
        self._starts_anew = self._remembers_list

    def _forget_past(self) -> None:
        """Do what `start_anew` asked for, if it did."""
        if self._starts_anew:
            neighbour_list.forget(self._context)
            self._made.forget_forces()
            self._starts_anew = False
