"""The exact engine: the Context holds the atoms, the engine the bodies, which it rotates exactly.

`moving_bodies` has the bodies and what is made for them, `agreement` keeps them and the Context alike, and the engine
makes the steps.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics import operators
from openmm_sier.dynamics.bodies import BodyState
from openmm_sier.dynamics.constraints import ConstraintError
from openmm_sier.dynamics.flow import Flow
from openmm_sier.dynamics.stages import KICK
from openmm_sier.dynamics.thermostat import Thermostat
from openmm_sier.engines import interrupts, own_methods
from openmm_sier.engines.exact import in_place_of_openmm
from openmm_sier.engines.exact.agreement import Agreement
from openmm_sier.engines.exact.minimization import constraints_hold, minimize_bodies
from openmm_sier.engines.exact.moving_bodies import MovingBodies
from openmm_sier.engines.protocol import Clock, Engine, Movers, TrajectoryError
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.engines.variables import PART
from openmm_sier.system import checks
from openmm_sier.system.arguments import Bodies
from openmm_sier.system.find_bodies import known_or_planned
from openmm_sier.system.temperature import Temperatures, temperatures

#: What `remember` gives: a completed step, the clock and the box.
Memory = tuple[BodyState, Clock, Any]


class ExactEngine(Engine):
    """An engine as a Python layer over the Context.

    Attributes:
        forces: forces and torques on the bodies, computed by the Context, and energies.
    """

    name = "exact"
    repeats_noise = True

    def __init__(self, context: openmm.Context, flow: Flow, bodies: Bodies):
        """
        Args:
            context: openmm.Context; the variables of its integrator carry the state in checkpoints.
            flow: what will be followed.
            bodies: as users give them, see `find_bodies.known_or_planned`.

        Raises:
            RigidityError, openmm.OpenMMException: the System is refused, as the message says.
        """
        super().__init__(context, flow)
        system = context.getSystem()
        forces = system.getForces()
        acting = [force for force in forces if not checks.is_passive(force)]
        self._is_updated = bool(acting)
        self._only_barostats_act = all(isinstance(force, checks.BAROSTATS) for force in acting)
        self._sweeps = [force.getFrequency() for force in forces if isinstance(force, openmm.CMMotionRemover)]
        self._state: BodyState | None = None
        #: The end of the last step, and what the bath within it made.
        self._last: tuple[BodyState, BodyState] | None = None
        self.clock = Clock(0.0, 0)
        self._moving = MovingBodies(context, known_or_planned(system, bodies), flow)
        self._agreement = Agreement(context, self._moving)
        self.forces = self._moving.forces

    @property
    def evaluations(self) -> int:  # type: ignore[override]
        return self.forces.evaluations

    @property
    def movers(self) -> Movers:  # type: ignore[override]
        if not self._moving.is_settled:
            self._moving.settle_by(Snapshot(self._context).positions)
        return self._moving.movers

    @property
    def point(self) -> BodyState:
        if self._state is None:
            raise openmm.OpenMMException("The Context has no positions yet")
        return self._state

    def change(self, operation: Callable[[BodyState], BodyState]) -> None:
        self._state = operation(self.point)

    # --- one call of the integrator's step ---

    def _begin(self, flow: Flow) -> None:
        self._flow = flow
        self.state()
        self._moving.check_step(flow, self._integrator.getIntegrationForceGroups(), self._context)

    def follow(self, steps: int, wants_energy: bool = False) -> None:
        flow = self._flow
        moves = self._moving.motion.operators(flow, self.inner_step(flow))
        step = operators.stepper(flow.scheme, moves, flow.step)
        if steps:
            self._moving.forget_past()
        for remaining in range(steps, 0, -1):
            if wants_energy and remaining == 1 and flow.scheme.stages[-1].operator == KICK:
                # The last force of the step is that at its end.
                self.forces.take_energy(with_evaluation=self.evaluations + flow.scheme.force_evaluations)
            if flow.updates_context and self._is_updated:
                self._step_after_update(step)
            else:
                # The Context is written to only when the steps are over.
                self._complete(self.point, step)
            interrupts.act_on_pending()

    def _publish(self) -> None:
        self._agreement.publish(self.point, self.clock)

    def _recover(self) -> None:
        if self._state is not None:
            self._agreement.doubt()
            self._publish()

    def _step_after_update(self, step: operators.Stepper) -> None:
        """Make one step, after the System's barostats and thermostats have acted."""
        update = self._update_box if self._only_barostats_act else self._update_all
        before, mark = self._state, own_methods.get_state(self._context, positions=True)
        try:
            self._complete(update(), step)
        except BaseException:
            if self._state is before:
                own_methods.set_box(self._context, *mark.getPeriodicBoxVectors())
                # A barostat also moves atoms of no body.
                self.forces.positions[:] = mark.getPositions(asNumpy=True).value_in_unit(unit.nanometer)
            raise

    def _complete(self, state: BodyState, step: operators.Stepper) -> None:
        time, steps = self.clock
        self.forces.step = steps + 1
        if self._sweeps and self._flow.updates_context and any(steps % frequency == 0 for frequency in self._sweeps):
            state = self.bodies.shifted(state, -self.bodies.centre_velocity(state.p))
        try:
            state = step(state)
        except ConstraintError as error:
            raise TrajectoryError(
                f"In step {steps + 1} {error}. Is the step size too long, or a force too stiff for it? The Context is "
                "left at the last completed step."
            ) from error
        # In one assignment, so that an error finds the clock and the bodies in agreement.
        self._state, self.clock = state, Clock(time + self._flow.step, steps + 1)
        thermal = self._moving.motion.after_bath if self._flow.scheme.bath_divides_drift else None
        self._last = None if thermal is None else (state, thermal)

    def _update_all(self) -> BodyState:
        self._publish()
        self._let_openmm_act()
        # A CustomIntegrator's own clock advances by the step size that it had when its Context was created.
        self._context.setTime(self.clock.time + self._flow.step)
        return self._agreement.updated(self.point)

    def _update_box(self) -> BodyState:
        """Let barostats act. Most often they change nothing, and then nothing is read back."""
        state = self.point
        self.forces.place(state.q, state.A)
        before = self._box()
        self._let_openmm_act()
        if self._box() == before:
            return state
        now = Snapshot(self._context)
        q, A = self._agreement.fit(now, state)
        self.forces.take_positions(now)
        self._moving.forget_forces()
        return replace(state, q=q, p=self.bodies.constraints.project(q, state.p), A=A)

    def _let_openmm_act(self) -> None:
        """Let the System's barostats and thermostats act, as in a step of this length, and do nothing else."""
        plain, integrator = openmm.CustomIntegrator, self._integrator
        native_step = plain.getStepSize(integrator)
        try:
            integrator.setGlobalVariableByName(PART, -1)
            plain.setStepSize(integrator, self._flow.step)
            plain.step(integrator, 1)
        finally:
            plain.setStepSize(integrator, native_step)
            integrator.setGlobalVariableByName(PART, 0)

    def check_step(self, flow: Flow) -> None:
        if self._moving.is_settled:
            self._moving.check_step(flow, self._integrator.getIntegrationForceGroups())

    # --- between flows ---

    def potential_energy(self) -> float:
        self._moving.forget_past()
        return self.forces.energy(self.point)

    def positions(self) -> np.ndarray:
        state = self.point
        return self.bodies.place(state.q, state.A, self.forces.positions.copy())

    def draw_momenta(self, bath: Thermostat, time: float) -> None:
        self._state = self._moving.motion.bath(bath)(self.point, time)

    def remember(self) -> Memory:
        return self.point, self.clock, self._box()

    def go_back(self, memory: Memory, reverse: bool = False) -> None:
        state, self.clock, box = memory
        if box != self._box():
            self._set_box(box)
        self._state = replace(state, p=-state.p, L=-state.L) if reverse else state

    def _set_box(self, box: Any) -> None:
        super()._set_box(box)
        self._moving.motion.follow(self._context)

    def prepare_for_volume_moves(self) -> None:
        self._moving.moves_volume = True
        if self._moving.is_settled:
            super().prepare_for_volume_moves()

    # --- what users ask ---

    def inner_step(self, flow: Flow) -> float:
        return self._moving.check_step.inner_step(flow, self._integrator.getIntegrationForceGroups())

    def state(self) -> BodyState:
        self._state, self.clock = self._agreement.adopt(Snapshot(self._context), self._state, self._flow)
        return self._state

    def temperatures(self, conserved: bool) -> Temperatures:
        """Temperatures in K, see `system.temperature`.

        They are those just after the bath if it was in the middle of the last step. There momenta have the distribution
        of the bath, whatever the step; later, kicks and inner steps make those of fast bonds too hot or too cold.
        """
        state = self.state()
        if self._last is not None and self._last[0] is state:
            state = self._last[1]
        return temperatures(self.bodies, state, conserved)

    # --- what OpenMM does in the Context, and cannot do for all constraints ---

    def _is_unsolved(self) -> bool:
        """Return whether OpenMM's solvers cannot satisfy the constraints."""
        return self._trial.unsolved(lambda: Snapshot(self._context).positions) is not None

    def draw_velocities(self, by_openmm: Callable[[], None], temperature: Any, seed: int | None) -> None:
        if self._is_unsolved():
            state = self.state()
            in_place_of_openmm.draw_velocities(self._context, self.bodies, state, temperature, seed)
        else:
            by_openmm()

    def satisfy_positions(self, by_openmm: Callable[[], None]) -> None:
        if self._is_unsolved():
            state = self.state()
            in_place_of_openmm.write_positions(self._context, self.bodies, state)
        else:
            by_openmm()

    def satisfy_velocities(self, by_openmm: Callable[[], None]) -> None:
        if self._is_unsolved():
            state = self.state()
            in_place_of_openmm.write_velocities(self._context, self.bodies, state)
        else:
            by_openmm()

    def minimize(self, by_openmm: Callable[[], None], tolerance: Any, iterations: int, reporter: Any) -> None:
        if constraints_hold(self._context.getSystem(), self.bodies) and not self._is_unsolved():
            super().minimize(by_openmm, tolerance, iterations, reporter)
            return
        with interrupts.deferred():
            start, forces = self.state(), self.forces.of_all_groups
            with self._recovering():
                minimize_bodies(self._context, self.bodies, forces, start, tolerance, iterations, reporter)

    # --- news from outside ---

    def forces_changed(self) -> None:
        self._moving.forces_changed()

    def start_anew(self) -> None:
        self._moving.start_anew()
