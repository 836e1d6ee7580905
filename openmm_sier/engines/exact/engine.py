"""The exact engine: the Context holds the atoms, the engine the bodies, which it rotates exactly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics import operators
from openmm_sier.dynamics.bodies import BodyState, RigidBodies
from openmm_sier.dynamics.constraints import ConstraintError
from openmm_sier.dynamics.operators import CachedForces
from openmm_sier.dynamics.thermostat import Thermostat
from openmm_sier.engines import neighbour_list
from openmm_sier.engines.exact import packing
from openmm_sier.engines.exact.forces import BodyForces
from openmm_sier.engines.exact.minimization import constraints_hold, minimize_bodies
from openmm_sier.engines.exact.motion import Motion, inner_step
from openmm_sier.engines.exact.reconciliation import Reconciliation
from openmm_sier.engines.interrupts import act_on_pending
from openmm_sier.engines.protocol import Clock, Engine, Flow, TrajectoryError
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.engines.temperature import Temperatures, temperatures
from openmm_sier.engines.variables import DRAWS, HEAT, PART, SITES, STATE_VARIABLES
from openmm_sier.system import checks
from openmm_sier.system.arguments import Bodies
from openmm_sier.system.find_bodies import BodyPlan, known_or_planned
from openmm_sier.system.vibrations import Vibrations


class _Memory(NamedTuple):
    """What `remember` gives: a completed step, with the box."""

    state: BodyState
    clock: Clock
    box: Any


class ExactEngine(Engine):
    """An engine as a Python layer over the Context.

    After `publish` the Context agrees with the engine's state. `_last_written` is a snapshot of the Context from then:
    one that later differs from it was changed from outside.

    Attributes:
        forces: forces and torques on the bodies, computed by the Context, and energies.
    """

    name = "exact"
    repeats_noise = True

    def __init__(self, integrator: openmm.CustomIntegrator, context: openmm.Context, flow: Flow, bodies: Bodies):
        """
        Args:
            integrator: holds the variables in which the state travels.
            context: openmm.Context.
            flow: what will be followed.
            bodies: as users give them, see `find_bodies.known_or_planned`.

        Raises:
            RigidityError, openmm.OpenMMException: the System or the step is refused, as the message says.
        """
        super().__init__(integrator, context, flow)
        system = context.getSystem()
        found = known_or_planned(system, bodies)
        forces = system.getForces()
        acting = [force for force in forces if not checks.is_passive(force)]
        self._is_updated = bool(acting)
        self._only_barostats_act = all(isinstance(force, checks.BAROSTATS) for force in acting)
        self._sweeps = [force.getFrequency() for force in forces if isinstance(force, openmm.CMMotionRemover)]
        self._remembers_list = neighbour_list.is_remembered(context)
        self._starts_anew = False
        self._last_written: Snapshot | None = None
        self._state: BodyState | None = None
        self._published: BodyState | None = None
        self._moves_volume = False
        self.clock = self._last_clock = Clock(0.0, 0)
        self.forces = BodyForces(context)
        self._in_kicks = CachedForces(self.forces.in_kicks)
        self._bodies: RigidBodies | None = None
        self._motion: Motion
        self._reconciliation: Reconciliation
        self._plan: Any = found if isinstance(found, BodyPlan) else None
        if not isinstance(found, BodyPlan):
            self._settle(found)

    @property
    def evaluations(self) -> int:  # type: ignore[override]
        return self.forces.evaluations

    @property
    def bodies(self) -> RigidBodies:
        return self._bodies or self._settle_by(Snapshot(self._context).positions)

    @property
    def callers(self) -> tuple[Any, ...]:
        return (self.forces, self._motion.solute) if self._bodies and self._motion.solute else (self.forces,)

    @property
    def _reached(self) -> BodyState:
        """The bodies at the last completed step."""
        if self._state is None:
            raise openmm.OpenMMException("The Context has no positions yet")
        return self._state

    @property
    def draws(self) -> int:
        return self._reached.draws

    @draws.setter
    def draws(self, number: int) -> None:
        self._state = replace(self._reached, draws=number)

    # --- bodies ---

    def _settle_by(self, positions: np.ndarray) -> RigidBodies:
        """Bodies with the geometry that the Context's state carries or, the first time, with that of the positions."""
        sites = np.array(self._integrator.getPerDofVariableByName(SITES))
        if self._bodies is not None and np.array_equal(packing.sites(self._bodies), sites):
            return self._bodies
        bodies = self._settle(self._plan.bodies(positions, sites))
        self._integrator.setPerDofVariableByName(SITES, packing.sites(bodies))
        return bodies

    def _settle(self, bodies: RigidBodies) -> RigidBodies:
        system = self._context.getSystem()
        self._vibrations = Vibrations(system, bodies)
        self._check_step()
        checks.refuse_constrained_lines(system, bodies)
        checks.refuse_deforming_barostats(system, self._context.getMolecules(), bodies)
        if self._moves_volume:
            checks.refuse_constant_pressure(system, bodies)
        self._motion = self._new_motion(bodies)
        self.forces.act_on(bodies)
        self._reconciliation = Reconciliation(bodies)
        self._bodies = bodies
        self._forget_movers()
        return bodies

    def _new_motion(self, bodies: RigidBodies) -> Motion:
        fast = self._integrator.getIntegrationForceGroups() & self._flow.fast_groups
        return Motion(self._context, bodies, self._in_kicks, self._flow.rotation, fast)

    def _inner_step(self) -> float:
        return inner_step(self._flow.scheme, self._flow.step, self._flow.substeps)

    # --- one call of the integrator's step ---

    def begin(self, flow: Flow) -> None:
        self._flow = flow
        self._adopt()
        self._check_motion()

    def follow(self, steps: int) -> None:
        flow = self._flow
        step = operators.stepper(flow.scheme, self._motion.operators(flow), flow.step)
        if steps:
            self._forget_past()
        for _ in range(steps):
            if flow.updates_context and self._is_updated:
                self._step_after_update(step)
            else:
                # The Context is written to only by `publish`.
                self._complete(self._reached, step)
            act_on_pending()

    def publish(self) -> None:
        """Write the bodies' state to the Context and to the variables that travel in checkpoints."""
        state, integrator, context = self._reached, self._integrator, self._context
        if state is self._published and self.forces.is_at(state.q, state.A) and self._last_clock == self.clock:
            return
        self.forces.place(state.q, state.A)
        context.setVelocities(self.bodies.move(state, self.forces.velocities))
        for name, values in zip(STATE_VARIABLES, packing.pack(self.bodies, state), strict=True):
            integrator.setPerDofVariableByName(name, values)
        integrator.setGlobalVariableByName(HEAT, state.heat)
        integrator.setGlobalVariableByName(DRAWS, state.draws)
        context.setTime(self.clock.time)
        context.setStepCount(self.clock.steps)
        self._last_written, self._published, self._last_clock = Snapshot(context), state, self.clock

    def recover(self) -> None:
        if self._state is None:
            return
        self._published = None
        self._forget_forces()
        self.forces.forget_place()
        self.publish()

    def _step_after_update(self, step: operators.Stepper) -> None:
        """Make one step, after the System's barostats and thermostats have acted."""
        update = self._update_box if self._only_barostats_act else self._update_all
        before, mark = self._state, self._context.getState(positions=True)
        try:
            self._complete(update(), step)
        except BaseException:
            if self._state is before:
                self._context.setPeriodicBoxVectors(*mark.getPeriodicBoxVectors())
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

    def _update_all(self) -> BodyState:
        self.publish()
        before = self._last_written
        self._let_openmm_act()
        # A CustomIntegrator's own clock advances by the step size that it had when its Context was created.
        self._context.setTime(self.clock.time + self._flow.step)
        self._last_written = now = Snapshot(self._context)
        state = self._reconciliation.reconcile(self._reached, before, now)
        self._take(now, before, moved=not now.same_positions(before))
        return state

    def _update_box(self) -> BodyState:
        """Let barostats act. Most often they change nothing, and then nothing is read back."""
        state = self._reached
        self.forces.place(state.q, state.A)
        before = self._box()
        self._let_openmm_act()
        if self._box() == before:
            return state
        now = Snapshot(self._context)
        q, A = self._reconciliation.fit(now, state)
        self.forces.take_positions(now)
        self._forget_forces()
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

    def start_anew(self) -> None:
        self._starts_anew = self._remembers_list

    def _forget_past(self) -> None:
        """After a restart point, let forces and energies depend on nothing but the Context's state."""
        if self._starts_anew:
            neighbour_list.forget(self._context)
            self._forget_forces()
            self._starts_anew = False

    # --- forces ---

    def potential_energy(self) -> float:
        self._forget_past()
        return self.forces.energy(self._reached)

    def _forget_forces(self) -> None:
        """Compute forces anew next time: positions, box or parameters were changed."""
        self._in_kicks.invalidate()
        self.forces.forget_energies()
        self._motion.follow(self._context)

    def forces_changed(self) -> None:
        if self._bodies is not None:
            self._motion = self._new_motion(self._bodies)
            self._forget_forces()

    groups_changed = forces_changed

    # --- between flows ---

    def kinetic_energy(self) -> float:
        return sum(self.bodies.kinetic_energies(self._reached))

    def positions(self) -> np.ndarray:
        state = self._reached
        return self.bodies.place(state.q, state.A, self.forces.positions.copy())

    def draw_momenta(self, bath: Thermostat, time: float) -> None:
        self._state = self._motion.bath(bath)(self._reached, time)

    def remember(self) -> _Memory:
        return _Memory(self._reached, self.clock, self._box())

    def go_back(self, memory: _Memory, reverse: bool = False) -> None:
        state, self.clock = memory.state, memory.clock
        if memory.box != self._box():
            self._set_box(memory.box)
        self._state = replace(state, p=-state.p, L=-state.L) if reverse else state

    def _box(self) -> Any:
        """Periodic box vectors, nm."""
        return self._context.getState().getPeriodicBoxVectors().value_in_unit(unit.nanometer)

    def _set_box(self, box: Any) -> None:
        self._context.setPeriodicBoxVectors(*box)
        self._motion.follow(self._context)

    def centre_velocity(self) -> np.ndarray:
        return self.bodies.centre_velocity(self._reached.p)

    def shift_velocities(self, velocity: np.ndarray) -> None:
        self._state = self.bodies.shifted(self._reached, velocity)

    def scale_velocities(self, factor: float) -> None:
        state, gained = self._reached, (factor**2 - 1) * self.kinetic_energy()
        self._state = replace(state, p=factor * state.p, L=factor * state.L, heat=state.heat + gained)

    def prepare_for_volume_moves(self) -> None:
        self._moves_volume = True
        if self._bodies is not None:
            super().prepare_for_volume_moves()

    def scale(self, factor: float) -> None:
        state = self._reached
        self._set_box([factor * edge for edge in self._box()])
        self._state = replace(state, q=state.q + (factor - 1) * self._centres(state.q))

    # --- what users ask ---

    def heat(self) -> float:
        return self.state().heat

    def add_heat(self, energy: float) -> None:
        self._state = replace(self._reached, heat=self._reached.heat + energy)

    def state(self) -> BodyState:
        self._adopt()
        return self._reached

    def temperatures(self) -> Temperatures:
        return temperatures(self.bodies, self.state(), self.conserves_momentum())

    def minimize(self, by_openmm: Callable[[], None], tolerance: Any, iterations: int, reporter: Any) -> None:
        if constraints_hold(self._context.getSystem(), self.bodies):
            by_openmm()
        else:
            minimize_bodies(self._context, self, tolerance, iterations, reporter)

    # --- agreement with the Context ---

    def _adopt(self) -> None:
        """Take over what was changed in the Context from outside.

        The state found depends on nothing but what the Context holds, so that a restart from a checkpoint
        is bit-identical.

        Raises:
            RigidityError: the positions do not form the bodies. Nothing has been changed then.
        """
        now, known, integrator = Snapshot(self._context), self._state, self._integrator
        if known is None and not now.positions.any():
            # No positions were set, or all particles are at the origin. OpenMM raises an error in the first case only.
            self._context.getState(energy=True, groups=0)
        moved = known is None or not now.same_positions(self._last_written)
        if moved:
            self.start_anew()
        if moved and self._plan is not None:
            self._settle_by(now.positions)
        state = known
        if state is None or moved or not now.same_velocities(self._last_written):
            # One after the other: OpenMM gives lists of objects, which take much memory.
            values = np.stack([np.array(integrator.getPerDofVariableByName(name)) for name in STATE_VARIABLES])
            before = None if moved else self._last_written
            state = self._reconciliation.recall(values, now, moved)
            state = state or self._reconciliation.reconcile(known, before, now)
        self._take(now, self._last_written, moved)
        if state is not known:
            self.forces.velocities[:] = now.velocities
        self.forces.select(integrator.getIntegrationForceGroups(), self._flow.fast_groups)
        heat, draws = map(integrator.getGlobalVariableByName, (HEAT, DRAWS))
        if (heat, draws) != (state.heat, state.draws):
            state = replace(state, heat=heat, draws=int(draws))
        self._state = state
        self.clock = self._last_clock = Clock(now.time, now.steps)
        self._last_written = now

    def _take(self, now: Snapshot, before: Snapshot | None, moved: bool) -> None:
        """Take over positions, box and parameters of a snapshot where they differ from those of an earlier one."""
        if moved:
            self.forces.take_positions(now)
        if not now.same_environment(before):
            self._forget_forces()
