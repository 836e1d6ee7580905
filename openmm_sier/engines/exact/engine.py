"""Runs one integrator in one Context: the Context holds the atoms, the engine the bodies."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import openmm

from openmm_sier.dynamics import operators
from openmm_sier.dynamics.bodies import BodyState, NotFiniteError, RigidBodies
from openmm_sier.dynamics.constraints import ConstraintError
from openmm_sier.dynamics.schemes import WITHIN_DRIFTS
from openmm_sier.engines import neighbour_list, stored_state
from openmm_sier.engines.exact.actors import Actors, VolumeMoves, act
from openmm_sier.engines.exact.atoms import Atoms, PotentialEnergies
from openmm_sier.engines.exact.motion import Motion, inner_step
from openmm_sier.engines.exact.reconciliation import Reconciliation
from openmm_sier.engines.host import Host
from openmm_sier.engines.interrupts import whatever_interrupts
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.engines.stored_state import SITES, STATE_VARIABLES
from openmm_sier.engines.temperature import MomentumConservation, Temperatures, temperatures
from openmm_sier.system import checks
from openmm_sier.system.stiffness import stiffest_force
from openmm_sier.system.vibrations import Vibrations


class BlownUp(openmm.OpenMMException):
    """A force or a position is not finite."""


class _Point(NamedTuple):
    """A completed step: the bodies, the time in ps and the step count."""

    state: BodyState
    time: float
    steps: int


class Engine:
    """Binding of a `SIERIntegrator` to a Context in which this package moves the bodies.

    Between two calls of `run` the Context agrees with `state`. `_echo` is a snapshot taken at the end of a call: a
    Context that later differs from it was changed from outside.

    Attributes:
        forces: forces and torques on the bodies, computed by the Context.
    """

    #: The value of `SIERIntegrator.engine`.
    name = "exact"

    def __init__(self, integrator: Host, context: openmm.Context):
        # The Context owns its integrator, so that a strong reference back would keep both alive.
        self._integrator_ref = weakref.ref(integrator)
        self._atoms = Atoms(context)
        system = context.getSystem()
        plan = integrator._plan_bodies(system)
        self._actors = Actors(system)
        self._remembers_list = neighbour_list.is_remembered(context)
        self._starts_anew = False
        self._groups: int
        self._echo: Snapshot | None = None
        self._point: _Point | None = None
        self._energies = PotentialEnergies(self._atoms)
        self.forces = operators.CachedForces(_weakly(self._compute_forces))
        self._bodies: RigidBodies | None = None
        self._momentum: MomentumConservation | None = None
        self._volume_moves: VolumeMoves | None = None
        self._motion: Motion
        self._vibrations: Vibrations
        self._reconciliation: Reconciliation
        # Bodies that need no positions are made now. The plan is dropped, since it takes more memory than they do.
        self._plan: Any = plan if plan.needs_positions else None
        if self._plan is None:
            self._settle(plan.bodies(None))

    @property
    def _context(self) -> openmm.Context:
        return self._atoms.context

    @property
    def _integrator(self) -> Host:
        integrator = self._integrator_ref()
        if integrator is None:
            raise openmm.OpenMMException("The integrator of this Context no longer exists")
        return integrator

    @property
    def bodies(self) -> RigidBodies:
        """The bodies of the Context's System."""
        return self._bodies or self._settle_by(Snapshot(self._context).positions)

    @property
    def state(self) -> BodyState:
        """The bodies' phase point at the last completed step."""
        return self._reached().state

    @property
    def steps(self) -> int:
        """Number of the last completed step."""
        return self._reached().steps

    def _reached(self) -> _Point:
        if self._point is None:
            raise openmm.OpenMMException("The Context has no positions yet")
        return self._point

    def _settle_by(self, positions: np.ndarray) -> RigidBodies:
        """Bodies with the geometry that the Context's state carries or, the first time, with that of the positions."""
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
        checks.refuse_constrained_lines(context.getSystem(), bodies)
        checks.refuse_deforming_barostats(context.getSystem(), context.getMolecules(), bodies)
        if integrator._piston is not None:
            self._volume_moves = VolumeMoves(integrator._piston, bodies, self._atoms)
        self._motion, self._bodies = Motion(context, bodies, self.forces, integrator), bodies
        self._reconciliation = Reconciliation(bodies, self._atoms, _weakly(self._forget_forces))
        self._vibrations = vibrations
        return bodies

    def _check_step(self, vibrations: Vibrations) -> None:
        integrator = self._integrator
        h, groups = integrator.getStepSize()._value, integrator.getIntegrationForceGroups()
        vibrations.check(integrator.scheme, h, groups & ~integrator._fast_groups)
        inner = inner_step(integrator.scheme, h, integrator._substeps)
        vibrations.check_nested(WITHIN_DRIFTS, inner, h, groups & integrator._fast_groups)

    # --- stepping ---

    def run(self, count: int) -> None:
        """Advance by `count` steps; an error or interrupt leaves the Context at the last completed one."""
        self.adopt()
        self._check_step(self._vibrations)
        integrator = self._integrator
        h = integrator.getStepSize()._value
        scheme = integrator._active_scheme()
        step = integrator._stepper(self, scheme, self._motion.operators(scheme, h, integrator._substeps), h)
        alone = not self._actors.are_present and self._volume_moves is None
        try:
            if count and self._starts_anew:
                self._forget_past()
            for _ in range(count):
                if alone or not (self._actors.are_present or self._moves_volume_now()):
                    # The Context is updated only after the last step.
                    self._complete(self.state, step, h)
                else:
                    self._step_with_actors(step, h)
            self._publish()
        except BaseException:
            # An interrupt of `_publish` is caught here too, so that none leaves the Context between two steps.
            self.restore()
            raise

    def start_anew(self) -> None:
        """Make the next step depend on nothing but what the Context holds, so that a restart repeats it bit for bit."""
        self._starts_anew = self._remembers_list

    def _forget_past(self) -> None:
        neighbour_list.forget(self._context)
        self._forget_forces()
        self._starts_anew = False

    def _step_with_actors(self, step: operators.Stepper, h: float) -> None:
        """Make one step, after the System's barostats and thermostats and the integrator's own piston have acted."""
        before = self._reached()
        mark = self._context.getState(positions=True)
        try:
            self._complete(self._acted_on(h), step, h)
        except BaseException:
            if self._point is before:
                whatever_interrupts(lambda: self._atoms.rewind(mark))
            raise

    def _complete(self, state: BodyState, step: operators.Stepper, h: float) -> None:
        _, time, steps = self._reached()
        try:
            state = step(self._actors.swept(self.bodies, state, steps))
        except ConstraintError as error:
            raise openmm.OpenMMException(
                f"In step {steps + 1} {error}. Is the step size too long{self._stiffest_force_on(error.bodies)}? The "
                "Context is left at the last completed step."
            ) from error
        # All in one assignment, so that an interrupt finds the clock and the bodies in agreement.
        self._point = _Point(state, time + h, steps + 1)

    def _stiffest_force_on(self, bodies: np.ndarray) -> str:
        """What a message says of the stiffest force on some bodies at the last completed step."""
        state, atoms = self.state, [int(i) for body in bodies.tolist() for i in self.bodies.atoms_of(body)]
        positions = self.bodies.place(state.q, state.A, self._atoms.positions.copy())
        found = stiffest_force(self._context, positions, atoms)
        return "" if found is None else f", or a force too stiff for it ({found})"

    def _acted_on(self, h: float) -> BodyState:
        state = self.state
        if self._actors.are_present:
            state = self._update_box() if self._actors.are_barostats else self._update_all(h)
        if self._volume_moves is None or not self._moves_volume_now():
            return state
        try:
            return self._volume_moves.apply(state, self._reached().steps, self._groups)
        except NotFiniteError as error:
            raise self._blown_up("position of", error) from None

    def _moves_volume_now(self) -> bool:
        if self._volume_moves is None:
            return False
        state, _, steps = self._reached()
        return self._integrator._moves_volume(state, steps)

    def _update_all(self, h: float) -> BodyState:
        self._publish()
        before = self._echo
        act(self._integrator)
        # A CustomIntegrator's own clock advances by the step size that it had when its Context was created.
        self._context.setTime(self._reached().time + h)
        self._echo = Snapshot(self._context)
        return self._reconciliation.reconcile(self.state, before, self._echo)

    def _update_box(self) -> BodyState:
        """Let barostats act. Most often they change nothing, and then nothing is read back."""
        state = self.state
        self._place(state.q, state.A)
        before = self._atoms.box()
        act(self._integrator)
        if np.array_equal(self._atoms.box(), before):
            return state
        now = Snapshot(self._context)
        q, A = self._reconciliation.fit(now, state)
        self._atoms.take_positions(now)
        self._forget_forces()
        return replace(state, q=q, p=self.bodies.constraints.project(q, state.p), A=A)

    def restore(self) -> None:
        """Write the last completed step to the Context, even if Ctrl-C is pressed meanwhile."""
        whatever_interrupts(self._recover)

    def _recover(self) -> None:
        self._forget_forces()
        self._atoms.forget_place()
        self._publish()

    # --- forces ---

    def _compute_forces(self, q: np.ndarray, A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Forces and torques on bodies in kicks."""
        return self._forces_of(self._groups & ~self._integrator._fast_groups, q, A)

    def all_forces(self, q: np.ndarray, A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Forces and torques on bodies at (q, A), each (3, n), including fast forces."""
        self.forces.evaluations += 1
        return self._forces_of(self._groups, q, A)

    def _forces_of(self, groups: int, q: np.ndarray, A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self._place(q, A)
        try:
            return self.bodies.forces_and_torques(self._atoms.forces(groups), A)
        except NotFiniteError as error:
            raise self._blown_up("force on", error) from None

    def potential_energy(self, state: BodyState) -> float:
        """Potential energy of the bodies at the positions of a state, in kJ/mol, from all forces that move them."""
        try:
            return self._energies(self.bodies, state.q, state.A, self._groups)
        except NotFiniteError as error:
            raise self._blown_up("position of", error) from None

    def _forget_forces(self) -> None:
        """Compute forces anew next time: positions, box or parameters were changed."""
        self._energies.forget()
        self.forces.invalidate()
        if self._motion.fast is not None:
            self._motion.fast.follow(self._context)

    def renew_forces(self) -> None:
        """Respond to a change of the potential."""
        self._integrator._potential_changed()
        self._energies.forget()
        self.forces.invalidate()
        if self._bodies is not None:
            self._motion = Motion(self._context, self._bodies, self.forces, self._integrator)

    def _place(self, q: np.ndarray, A: np.ndarray) -> None:
        try:
            self._atoms.place(self.bodies, q, A)
        except NotFiniteError as error:
            raise self._blown_up("position of", error) from None

    def _blown_up(self, what: str, error: NotFiniteError) -> BlownUp:
        step = self._context.getStepCount() if self._point is None else self._point.steps + 1
        return BlownUp(
            f"The {what} {self.bodies.describe(error.body)} is not finite in step {step}. Is the step size "
            "too long, or do atoms overlap? The Context is left at the last completed step."
        )

    def set_groups(self) -> None:
        """Respond to a change of the force groups that move the bodies."""
        self.renew_forces()

    def notice(self) -> None:
        """Do nothing: `adopt` itself detects positions and velocities that were set from outside."""

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
        """Temperatures in K, see `openmm_sier.engines.temperature`."""
        self.adopt()
        return temperatures(self.bodies, self.state, self.conserves_momentum())

    # --- agreement with the Context ---

    def adopt(self) -> None:
        """Take over what was changed in the Context from outside.

        The state found depends on nothing but what the Context holds, so that a restart from a checkpoint
        is bit-identical.

        Raises:
            RigidityError: the positions do not form the bodies. Nothing has been changed then.
        """
        now = Snapshot(self._context)
        if self._point is None and not now.positions.any():
            # No positions were set, or all particles are at the origin. OpenMM raises an error in the first case only.
            self._context.getState(energy=True, groups=0)
        moved = self._point is None or not now.same_positions(self._echo)
        if moved:
            self.start_anew()
        if moved and self._plan is not None:
            self._settle_by(now.positions)
        known, integrator = None if self._point is None else self._point.state, self._integrator
        recalled = None
        if disturbed := moved or not now.same_velocities(self._echo):
            recalled = self._reconciliation.recall(integrator, now, moved)
        if recalled is None and self._echo is not None and not now.same_environment(self._echo):
            integrator._potential_changed()
        if recalled is not None:
            state, disturbed = recalled
        elif disturbed:
            state = self._reconciliation.reconcile(known, None if moved else self._echo, now)
        else:
            state = self.state
            self._reconciliation.notice_environment(self._echo, now)
        self._atoms.velocities[:] = now.velocities
        self._groups = integrator.getIntegrationForceGroups()
        state = integrator._read_record(state, known, disturbed)
        self._point, self._echo = _Point(state, now.time, now.steps), now

    def _publish(self) -> None:
        """Write the bodies' state to the Context and to the variables that travel in checkpoints."""
        (state, time, steps), integrator, context = self._reached(), self._integrator, self._context
        self._place(state.q, state.A)
        context.setVelocities(self.bodies.move(state, self._atoms.velocities))
        for name, values in zip(STATE_VARIABLES, stored_state.pack(self.bodies, state), strict=True):
            integrator.setPerDofVariableByName(name, values)
        integrator._write_record(state)
        context.setTime(time)
        context.setStepCount(steps)
        self._echo = Snapshot(context)


def _weakly(method: Callable[..., Any]) -> Callable[..., Any]:
    """A method that does not keep its object alive.

    The engine owns a Context for fast forces, and so must not be left to the garbage collector, which may delete that
    Context's System before the Context.
    """
    reference = weakref.WeakMethod(method)

    def call(*arguments: Any) -> Any:
        found = reference()
        assert found is not None
        return found(*arguments)

    return call
