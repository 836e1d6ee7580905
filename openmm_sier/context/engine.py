"""Runs one integrator in one Context: the Context holds the atoms, the engine the bodies."""

from __future__ import annotations

import weakref
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import openmm

from openmm_sier.context import checks, neighbour_list, stored_state
from openmm_sier.context.host import Host
from openmm_sier.context.native_program import PART
from openmm_sier.context.snapshot import Snapshot, read_vectors
from openmm_sier.context.temperature import MomentumConservation, Temperatures, temperatures
from openmm_sier.context.vibrations import Vibrations
from openmm_sier.dynamics import operators
from openmm_sier.dynamics.barostat import VolumeMove
from openmm_sier.dynamics.bodies import BodyState, NotFiniteError, RigidBodies

#: Per-atom and global variables of the CustomIntegrator in which the bodies' state travels.
STATE_VARIABLES = tuple(f"sier_state{i}" for i in range(stored_state.VARIABLES))
SITES = "sier_sites"
HEAT, DRAWS, SEED = "sier_heat", "sier_draws", "sier_seed"


class _Point(NamedTuple):
    """A completed step: the bodies, the time in ps and the step count."""

    state: BodyState
    time: float
    steps: int


class Engine:
    """Binding of a `SIERIntegrator` to a Context in which this package moves the bodies.

    Between two calls of `run` the Context agrees with `state`, and `_echo` is what it gave back then: whatever differs
    later was changed from outside.

    Attributes:
        forces: forces and torques on them, computed by the Context.
    """

    #: What `SIERIntegrator.engine` says.
    name = "exact"

    def __init__(self, integrator: Host, context):
        # The Context owns its integrator, so that a strong reference back would keep both alive.
        self._context_ref = weakref.ref(context)
        self._integrator_ref = weakref.ref(integrator)
        system = context.getSystem()
        n = system.getNumParticles()
        plan = integrator._plan_bodies(system)
        forces = [system.getForce(i) for i in range(system.getNumForces())]
        self._sweep_frequencies = [f.getFrequency() for f in forces if isinstance(f, openmm.CMMotionRemover)]
        acting = [force for force in forces if not checks.is_passive(force)]
        self._has_actors = bool(acting)
        self._barostats_alone = all(isinstance(force, checks.BAROSTATS) for force in acting)
        self._has_virtual_sites = any(system.isVirtualSite(i) for i in range(n))
        self._positions, self._velocities, self._atom_forces = np.zeros((3, n, 3))
        self._placed: tuple = (None, None)
        self._remembers_list = neighbour_list.is_remembered(context)
        self._starts_anew = False
        self._groups: int
        self._echo: Snapshot | None = None
        self._point: _Point | None = None
        self.forces = operators.CachedForces(self._compute_forces)
        self.operators: dict[str, operators.Operator] = {}
        self._bodies: RigidBodies | None = None
        self._momentum: MomentumConservation | None = None
        self._move_volume: VolumeMove
        self._vibrations: Vibrations
        self._told_of_misfit = False
        # Where positions tell nothing of the bodies they are settled now, and the plan takes more memory than they do.
        self._plan: Any = plan if plan.needs_positions else None
        if self._plan is None:
            self._settle(plan.bodies(None))

    @property
    def _context(self):
        context = self._context_ref()
        if context is None:
            raise openmm.OpenMMException("The Context of this integrator no longer exists")
        return context

    @property
    def _integrator(self) -> Host:
        integrator = self._integrator_ref()
        if integrator is None:
            raise openmm.OpenMMException("The integrator of this Context no longer exists")
        return integrator

    @property
    def bodies(self) -> RigidBodies:
        """The rigid bodies of the Context's System."""
        return self._bodies or self._settle_by(Snapshot(self._context).positions)

    @property
    def state(self) -> BodyState:
        """The bodies' phase point at the last completed step."""
        return self._reached().state

    def _reached(self) -> _Point:
        if self._point is None:
            raise openmm.OpenMMException("The Context has no positions yet")
        return self._point

    def _settle_by(self, positions) -> RigidBodies:
        """Bodies of the geometry that travels with the Context's state; the first time positions tell it."""
        sites = np.array(self._integrator.getPerDofVariableByName(SITES))
        if self._bodies is not None and np.array_equal(stored_state.sites(self._bodies), sites):
            return self._bodies
        bodies = self._settle(self._plan.bodies(positions, sites))
        self._integrator.setPerDofVariableByName(SITES, stored_state.sites(bodies))
        return bodies

    def _settle(self, bodies: RigidBodies) -> RigidBodies:
        integrator, context = self._integrator, self._context
        vibrations = Vibrations(context.getSystem(), bodies)
        self._check_step(vibrations)
        molecules = context.getMolecules()
        checks.refuse_deforming_barostats(context.getSystem(), molecules, bodies)
        if integrator._piston is not None:
            checks.refuse_constant_pressure(context.getSystem(), bodies)
            self._move_volume = integrator._piston.operator(bodies, molecules)
        found = operators.body_operators(bodies, self.forces, integrator.rotation)
        self.operators, self._bodies = found | integrator._extra_operators(bodies), bodies
        self._vibrations = vibrations
        return bodies

    def _check_step(self, vibrations: Vibrations) -> None:
        integrator = self._integrator
        vibrations.check(integrator.scheme, integrator.getStepSize()._value, integrator.getIntegrationForceGroups())

    # --- stepping ---

    def run(self, count: int) -> None:
        """Advance by `count` steps; an error or interrupt leaves the Context at the last completed one."""
        self.adopt()
        self._check_step(self._vibrations)
        integrator = self._integrator
        h = integrator.getStepSize()._value
        step = operators.stepper(integrator._active_scheme(), self.operators, h)
        alone = not self._has_actors and integrator._piston is None
        try:
            if count and self._starts_anew:
                self._forget_past()
            for _ in range(count):
                if alone or not (self._has_actors or self._moves_volume_now()):
                    # The Context learns of the step when the last one is published.
                    self._complete(self.state, step, h)
                else:
                    self._step_with_actors(step, h)
            self._publish()
        except BaseException:
            # Also where `_publish` was cut short: there is no line that an interrupt could hit without coming here.
            self.restore()
            raise

    def start_anew(self) -> None:
        """Make the next step depend on nothing but what the Context holds, so that a restart repeats it to the bit."""
        self._starts_anew = self._remembers_list

    def _forget_past(self) -> None:
        neighbour_list.forget(self._context)
        self.forces.invalidate()
        self._starts_anew = False

    def _step_with_actors(self, step: operators.Stepper, h: float) -> None:
        """One step, after all that acts besides the scheme: barostats and thermostats of the System, our own piston."""
        before = self._reached()
        mark = self._context.getState(positions=True)
        try:
            self._complete(self._acted_on(h), step, h)
        except BaseException:
            if self._point is before:
                _whatever_interrupts(lambda: self._rewind(mark))
            raise

    def _complete(self, state: BodyState, step: operators.Stepper, h: float) -> None:
        _, time, steps = self._reached()
        if self._sweep_frequencies and any(steps % frequency == 0 for frequency in self._sweep_frequencies):
            state = self._without_drift(state)
        state = step(state)
        # All of it at once, so that an interrupt finds the clock and the bodies in agreement.
        self._point = _Point(state, time + h, steps + 1)

    def _acted_on(self, h: float) -> BodyState:
        state = self.state
        if self._has_actors:
            state = self._update_box() if self._barostats_alone else self._update_all(h)
        return self._with_volume_moved(state) if self._moves_volume_now() else state

    def _moves_volume_now(self) -> bool:
        piston = self._integrator._piston
        return piston is not None and (self._reached().steps + 1) % piston.interval == 0

    def _with_volume_moved(self, state: BodyState) -> BodyState:
        context, groups, box = self._context, self._groups, self._box()

        def energy(q, factor: float) -> float:
            context.setPeriodicBoxVectors(*(factor * box))
            self._place(q, state.A)
            try:
                return context.getState(energy=True, groups=groups).getPotentialEnergy()._value
            except openmm.OpenMMException as error:
                edges = " x ".join(f"{edge:.3f}" for edge in factor * np.diag(box))
                raise openmm.OpenMMException(
                    f"Step {self._reached().steps + 1} could not try a box of {edges} nm: {error}. A larger box or a "
                    "shorter cut-off would help. The Context is left at the last completed step."
                ) from error

        state, factor = self._move_volume(state, float(np.linalg.det(box)), energy)
        context.setPeriodicBoxVectors(*(factor * box))
        return state

    def _update_all(self, h: float) -> BodyState:
        self._publish()
        before = self._echo
        self._native_step()
        # A CustomIntegrator's own clock goes on at the step size that it had when its Context was created.
        self._context.setTime(self._reached().time + h)
        self._echo = Snapshot(self._context)
        return self._reconcile(before, self._echo)

    def _update_box(self) -> BodyState:
        """What barostats do; most often nothing, and then nothing has to be read back."""
        state = self.state
        self._place(state.q, state.A)
        before = self._box()
        self._native_step()
        if np.array_equal(self._box(), before):
            return state
        now = Snapshot(self._context)
        q, A = self._fit(now, state)
        self._take_positions(now)
        self.forces.invalidate()
        return replace(state, q=q, A=A)

    def _box(self) -> np.ndarray:
        return self._context.getState().getPeriodicBoxVectors(asNumpy=True)._value

    def _native_step(self) -> None:
        """Let OpenMM update the Context's state and do nothing else."""
        integrator, h = self._integrator, self._integrator.getStepSize()
        try:
            integrator.setGlobalVariableByName(PART, -1)
            # AndersenThermostat must know of the whole step.
            openmm.CustomIntegrator.setStepSize(integrator, h)
            openmm.CustomIntegrator.step(integrator, 1)
        finally:
            openmm.CustomIntegrator.setStepSize(integrator, h / integrator._native_steps)
            integrator.setGlobalVariableByName(PART, 0)

    def _without_drift(self, state: BodyState) -> BodyState:
        """What a CMMotionRemover does, for bodies."""
        velocity = state.p.sum(axis=1) / self.bodies.masses.sum()
        return replace(state, p=state.p - self.bodies.masses * velocity[:, None])

    def _rewind(self, mark) -> None:
        """Undo what actors changed in a step that was not completed."""
        self._context.setPeriodicBoxVectors(*mark.getPeriodicBoxVectors())
        # A barostat moves what belongs to no body too.
        self._positions[:] = mark.getPositions(asNumpy=True)._value

    def restore(self) -> None:
        """Write the last completed step to the Context, whatever was cut short and even if Ctrl-C comes meanwhile."""
        _whatever_interrupts(self._recover)

    def _recover(self) -> None:
        self.forces.invalidate()
        self._placed = (None, None)
        self._publish()

    # --- forces ---

    def _compute_forces(self, q, A):
        self._place(q, A)
        found = self._context.getState(forces=True, groups=self._groups)
        read_vectors(found, openmm.State.Forces, self._atom_forces)
        try:
            return self.bodies.forces_and_torques(self._atom_forces, A)
        except NotFiniteError as error:
            raise self._blown_up("force on", error) from None

    def _blown_up(self, what: str, error: NotFiniteError) -> openmm.OpenMMException:
        step = self._context.getStepCount() if self._point is None else self._point.steps + 1
        return openmm.OpenMMException(
            f"The {what} {self.bodies.describe(error.body)} is not finite in step {step}. Is the step size "
            "too long, or do atoms overlap? The Context is left at the last completed step."
        )

    def set_groups(self) -> None:
        """Other force groups move the bodies from now on."""
        self.forces.invalidate()

    def notice(self) -> None:
        """Positions or velocities were set from outside; `adopt` finds out by itself."""

    def heat(self) -> float:
        """Energy that the bath and moves of the volume have given, kJ/mol."""
        self.adopt()
        return self.state.heat

    def conserves_momentum(self) -> bool:
        """Whether the total momentum is conserved, see `MomentumConservation`."""
        if self._momentum is None:
            self._momentum = MomentumConservation.of_system(self._context.getSystem(), self.bodies)
        return self._momentum.holds(self._integrator)

    def temperatures(self) -> Temperatures:
        """In K, see `openmm_sier.context.temperature`."""
        self.adopt()
        return temperatures(self.bodies, self.state, self.conserves_momentum())

    # --- agreement with the Context ---

    def adopt(self) -> None:
        """Take over what was changed in the Context from outside.

        The state found depends on nothing but what the Context holds, so that a checkpoint of it leads on alike.

        Raises:
            RigidityError: the positions do not form the bodies. Nothing has been changed then.
        """
        now = Snapshot(self._context)
        if self._point is None and not now.positions.any():
            # All particles may be at the origin. OpenMM knows, and says so before it computes anything.
            self._context.getState(energy=True, groups=0)
        moved = self._point is None or not now.same_positions(self._echo)
        if moved:
            self.start_anew()
        if moved and self._plan is not None:
            self._settle_by(now.positions)
        if moved or not now.same_velocities(self._echo):
            state = self._recall(now, moved) or self._reconcile(None if moved else self._echo, now)
        else:
            state = self.state
            self._notice_environment(self._echo, now)
        self._velocities[:] = now.velocities
        integrator = self._integrator
        self._groups = integrator.getIntegrationForceGroups()
        heat, draws = integrator._counters(None if self._point is None else self._point.state)
        self._point, self._echo = _Point(replace(state, heat=heat, draws=draws), now.time, now.steps), now

    def _reconcile(self, before: Snapshot | None, now: Snapshot) -> BodyState:
        """The bodies' state after the Context changed from one snapshot to another."""
        old = None if self._point is None else self._point.state
        self._notice_environment(before, now)
        if old is None or before is None:
            q, A = self._fit(now)
            self._take_positions(now)
            p, L = self._momenta(now.velocities, A)
            return BodyState(q, p, A, L)
        q, A = old.q, old.A
        if not now.same_positions(before):
            q, A = self._fit(now, old)
            self._take_positions(now)
        if now.same_velocities(before) and np.array_equal(A, old.A):
            return replace(old, q=q, A=A)
        p, L = self._momenta(now.velocities, A)
        return replace(old, q=q, p=p, A=A, L=L)

    def _fit(self, now: Snapshot, previous: BodyState | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Bodies at the positions of a snapshot; those that do not quite have their shapes are said, once."""
        q, A, misfit = self.bodies.fit_with_misfit(now.positions, previous)
        if not self._told_of_misfit:
            self._told_of_misfit = checks.tell_of_misfit(self.bodies, misfit)
        return q, A

    def _notice_environment(self, before: Snapshot | None, now: Snapshot) -> None:
        if not now.same_environment(before):
            self.forces.invalidate()

    def _momenta(self, velocities, A):
        try:
            return self.bodies.momenta(velocities, A)
        except NotFiniteError as error:
            raise openmm.OpenMMException(
                f"The velocities of {self.bodies.describe(error.body)} in the Context are not finite"
            ) from None

    def _recall(self, now: Snapshot, moved: bool) -> BodyState | None:
        """The state stored in the integrator's variables, if it is that of the atoms to the last bit.

        It is after a checkpoint or a State with integrator parameters was loaded. Where velocities were set after that,
        centres and attitudes are still believed.
        """
        integrator, bodies = self._integrator, self.bodies
        # One after the other: OpenMM gives lists of objects, which take much memory.
        values = np.stack([np.array(integrator.getPerDofVariableByName(name)) for name in STATE_VARIABLES])
        if not values.any() or not np.isfinite(values).all():
            return None
        state = stored_state.unpack(bodies, values)
        positions = bodies.place(state.q, state.A, now.positions.copy())
        velocities = bodies.move(state, now.velocities.copy())
        reproduced = np.array_equal(positions, now.positions)
        if not reproduced or not (moved or np.array_equal(velocities, now.velocities)):
            return None
        self.forces.invalidate()
        self._take_positions(now)
        if not np.array_equal(velocities, now.velocities):
            p, L = self._momenta(now.velocities, state.A)
            state = replace(state, p=p, L=L)
        return state

    def _take_positions(self, now: Snapshot) -> None:
        self._positions[:] = now.positions
        self._placed = (None, None)

    def _place(self, q, A) -> None:
        if self._placed[0] is q and self._placed[1] is A:
            return
        context = self._context
        try:
            context.setPositions(self.bodies.place(q, A, self._positions))
        except NotFiniteError as error:
            raise self._blown_up("position of", error) from None
        if self._has_virtual_sites:
            context.computeVirtualSites()
        self._placed = (q, A)

    def _publish(self) -> None:
        """Write the bodies' state to the Context and to the variables that travel in checkpoints."""
        (state, time, steps), integrator, context = self._reached(), self._integrator, self._context
        self._place(state.q, state.A)
        context.setVelocities(self.bodies.move(state, self._velocities))
        for name, values in zip(STATE_VARIABLES, stored_state.pack(self.bodies, state), strict=True):
            integrator.setPerDofVariableByName(name, values)
        integrator.setGlobalVariableByName(HEAT, state.heat)
        integrator.setGlobalVariableByName(DRAWS, state.draws)
        context.setTime(time)
        context.setStepCount(steps)
        self._echo = Snapshot(context)


def _whatever_interrupts(action) -> None:
    """Do what must be done as a whole: a Ctrl-C in it takes effect after it."""
    try:
        action()
    except KeyboardInterrupt:
        action()
        raise
