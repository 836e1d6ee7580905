"""The native engine: OpenMM executes the scheme, which is written out as the integrator's program, on any platform."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import BodySet, BodyState
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.thermostat import Thermostat
from openmm_sier.engines import neighbour_list
from openmm_sier.engines.beginnings import refuse_what_is_not_finite
from openmm_sier.engines.interrupts import act_on_pending
from openmm_sier.engines.native import refusals
from openmm_sier.engines.native.installation import guard, set_bath
from openmm_sier.engines.native.known_atoms import KnownAtoms
from openmm_sier.engines.native.settling import are_satisfied, satisfy_constraints
from openmm_sier.engines.native.told_bodies import ToldBodies
from openmm_sier.engines.native.writing import needs_finite_positions, refuse_other_slow_groups
from openmm_sier.engines.program import V0, WORK
from openmm_sier.engines.protocol import Clock, Engine, Memory, Task, TrajectoryError
from openmm_sier.engines.snapshot import Environment, Snapshot, time_of
from openmm_sier.engines.variables import PART
from openmm_sier.stability.step_check import StepCheck
from openmm_sier.system import tables
from openmm_sier.system.arguments import Bodies, groups_of
from openmm_sier.system.temperature import Temperatures

#: Relative tolerance of constraints. OpenMM's default of 1e-5 leaves velocities wrong by 1e-5 of a bond for each
#: substep, a larger energy error than that of the schemes.
TOLERANCE = 1e-9

#: Positions in single precision cannot be constrained better.
SINGLE_TOLERANCE = 1e-6

#: Steps of one native step each in one call of OpenMM, after which signals are looked at.
AT_ONCE = 10


class Potential(NamedTuple):
    """A potential energy, kJ/mol, and the box and the parameters of the Context at which it was computed."""

    energy: float
    environment: Environment


class NativeEngine(Engine):
    """An engine that is the program of the integrator.

    The Context has the state after each flow. An error in mid-step leaves it where it happened, as with OpenMM's
    integrators. What moves are the massive atoms; rigid bodies are only what users are told of.
    """

    name = "native"

    def __init__(self, task: Task) -> None:
        """
        Raises:
            openmm.OpenMMException: the integrator needs what only the exact engine has, such as bodies that are not
                rigid by constraints, or the System has a Force that does not work with divided steps.
        """
        super().__init__(task)
        context, bodies = task.context, task.bodies
        system, integrator = context.getSystem(), context.getIntegrator()
        self._program = task.program
        self._refuse_system(system, bodies)
        self._constraints = tables.constraints(system)
        self._has_sites = any(map(system.isVirtualSite, range(system.getNumParticles())))
        self.moving = refusals.points(system)
        # The atom of each point: those of none come first.
        owners = np.argsort(self.moving.owners, kind="stable")
        self._atoms = owners[self.moving.n_particles - self.moving.n :]
        self._told = ToldBodies(system, bodies, self.moving)
        fraction = task.program.inner_fraction
        self.check_step = StepCheck(system, self.moving, lambda wanted, _: wanted.step * fraction, self._told.species)
        self._step_at_first = openmm.CustomIntegrator.getStepSize(integrator).value_in_unit(unit.picosecond)
        self._potential: Potential | None = None
        self._is_box_new = False
        self._is_fresh = True
        #: Whether OpenMM still has the forces of the end of the last step.
        self._has_force = False
        #: Whether velocities are those that the last step left.
        self._follows_bath = False
        self.evaluations = 0
        platform = context.getPlatform()
        precision = "Precision" in platform.getPropertyNames() and platform.getPropertyValue(context, "Precision")
        self._known = KnownAtoms(context, is_single=precision == "single")
        self._checks_positions = needs_finite_positions(system, platform)
        if precision == "single":
            integrator.setConstraintTolerance(max(SINGLE_TOLERANCE, integrator.getConstraintTolerance()))

    def _refuse_system(self, system: openmm.System, bodies: Bodies) -> None:
        """Refuse what only the exact engine can do.

        Raises:
            openmm.OpenMMException: the message says what that is, and the remedy.
        """
        refusals.refuse(self.flow, bodies, self._program, system)
        # Other integration groups come with another engine, since OpenMM fixes them when it reads the program.
        refusals.refuse_fast_forces(system, groups_of(self.flow.fast_groups), self._groups)
        refuse_other_slow_groups(self._program, system, self._groups, self.flow.fast_groups)

    @property
    def bodies(self) -> BodySet:
        """Return the rigid and point bodies of the System.

        Raises:
            RigidityError: the System has constraints that do not form rigid bodies.
        """
        return self._told.bodies(self.positions)

    @property
    def clock(self) -> Clock:
        return Clock(time_of(self._context), self._context.getStepCount())

    @clock.setter
    def clock(self, clock: Clock) -> None:
        openmm.Context.setTime(self._context, clock.time)
        openmm.Context.setStepCount(self._context, clock.steps)

    # --- one call of the integrator's step ---

    def take_over(self) -> None:
        self._set_bath()
        # A program that does less than what was asked for runs here, since this engine does the rest.
        guard(self._integrator, False)
        if self._potential is not None:
            state = openmm.Context.getState(self._context, parameters=True)
            if Environment.of(state) != self._potential.environment:
                self._potential = None
        if self._is_box_new:
            # OpenMM takes the forces of the last step for valid if only the box was changed. To set velocities, though
            # they are the same, makes it compute them.
            velocities = openmm.Context.getState(self._context, velocities=True).getVelocities(asNumpy=True)
            openmm.Context.setVelocities(self._context, velocities)
            self._is_box_new = self._has_force = False

    def _set_bath(self) -> None:
        set_bath(self._integrator, self.flow.bath)

    def follow(self, steps: int, wants_energy: bool = False) -> None:
        if self.flow.step == 0:
            # Steps of zero length are only counted: the program would divide by zero.
            time, count = self.clock
            self.clock = Clock(time, count + steps)
            return
        if not steps:
            return
        self._settle()
        if not self._has_force:
            self.evaluations += int(self.flow.scheme.reuses_force)
            self._has_force = True
        self._potential = None
        self._known.forget()
        advance = self._divided_step if len(self._program.parts) > 1 else self._whole_steps
        try:
            while steps:
                steps -= advance(steps)
                act_on_pending()
        finally:
            if not self._program.ends_constrained:
                openmm.Context.applyVelocityConstraints(self._context, self._integrator.getConstraintTolerance())
        # An end whose energy is asked for may become a sample, and OpenMM's solvers do not say where they stop.
        if wants_energy and not are_satisfied(self._constraints, self.positions()):
            raise TrajectoryError("OpenMM could not satisfy the constraints at the end of a trajectory")

    def _whole_steps(self, steps: int) -> int:
        """Make some steps of one native step each, and return their number."""
        count = 1 if self._checks_positions else min(steps, AT_ONCE)
        start = self.clock
        try:
            self._native_steps(count)
        finally:
            made = self._context.getStepCount() - start.steps
            self._completed(made)
            # On the CPU and Reference platforms OpenMM's own clock takes the step that the Context was created with.
            if self.flow.step != self._step_at_first:
                self.clock = Clock(start.time + made * self.flow.step, start.steps + made)
        return count

    def _divided_step(self, _: int) -> int:
        """Make one step, which OpenMM counts as several native ones, and return 1."""
        clock, parts = self.clock, len(self._program.parts)
        try:
            self._native_steps(parts)
        finally:
            # An error in the middle of a step leaves the clock at the last completed one, as OpenMM does.
            made = int(self._context.getStepCount() == clock.steps + parts)
            self.clock = Clock(clock.time + made * self.flow.step, clock.steps + made)
            self._completed(made)
        return 1

    def _native_steps(self, number: int) -> None:
        """Make native steps; where positions are looked at after each, they belong to one step."""
        at_once = 1 if self._checks_positions else number
        step = self._context.getStepCount() + 1
        try:
            for _ in range(0, number, at_once):
                openmm.CustomIntegrator.step(self._integrator, at_once)
                if self._checks_positions:
                    self._refuse_lost_atoms(step)
        except openmm.OpenMMException as error:
            # What follows begins with the first part of a step.
            self._integrator.setGlobalVariableByName(PART, 0.0)
            if "nan" in str(error).lower() and not isinstance(error, TrajectoryError):
                raise TrajectoryError(str(error)) from error
            raise

    def _refuse_lost_atoms(self, step: int) -> None:
        """Raise a TrajectoryError that names the step if positions or velocities are not finite."""
        now = Snapshot.of(self._context)
        if not (np.isfinite(now.positions).all() and np.isfinite(now.velocities).all()):
            raise TrajectoryError(
                f"A position or velocity is not finite in step {step}. Is the step size too long, or do atoms overlap?"
            )

    def _completed(self, steps: int) -> None:
        self._follows_bath = self._follows_bath or steps > 0
        self.evaluations += steps * self.flow.scheme.force_evaluations

    def publish(self) -> None:
        """Write velocities that an ensemble changed; all else the Context has at any time."""
        self._known.publish()

    def _settle(self) -> None:
        """Make the next steps depend on nothing but the Context, after a change from outside."""
        if not self._is_fresh:
            return
        self._known.publish()
        now = Snapshot.of(self._context)
        refuse_what_is_not_finite(now)
        self.refuse_cut_molecules(now)
        if neighbour_list.is_remembered(self._context):
            neighbour_list.forget(self._context)
        if len(self._constraints.pairs):
            self.trial.refuse(self.positions)
            satisfy_constraints(self._context, self._constraints, self._integrator.getConstraintTolerance())
        if self._has_sites:
            # OpenMM places them at the end of a step, and the first needs forces before that.
            self._context.computeVirtualSites()
        self._known.forget()
        self._is_fresh = False

    # --- the phase point, of massive atoms ---

    @property
    def point(self) -> BodyState:
        positions, velocities = self._known.both
        q, v = positions[self._atoms].T, velocities[self._atoms].T
        A = np.broadcast_to(np.eye(3)[:, :, None], (3, 3, self.moving.n))
        return BodyState(q, self.moving.masses * v, A, np.zeros_like(q))

    def change(self, operation: Callable[[BodyState], BodyState]) -> None:
        old = self.point
        new = operation(old)
        if new.q is not old.q:
            positions = self._known.positions.copy()
            positions[self._atoms] = new.q.T
            self._known.write_positions(positions)
            self._context.computeVirtualSites()
            self.atoms_moved()
        if new.p is not old.p:
            velocities = self._known.velocities.copy()
            velocities[self._atoms] = (new.p / self.moving.masses).T
            self._write_velocities(velocities)

    def _write_velocities(self, velocities: np.ndarray) -> None:
        self._known.write_velocities(velocities)
        self._velocities_changed()

    def _velocities_changed(self) -> None:
        # OpenMM considers no force valid after that.
        self._has_force = False

    def positions(self) -> np.ndarray:
        return self._known.positions

    def kinetic_energy(self) -> float:
        return self._known.kinetic_energy()

    def centre_velocity(self) -> np.ndarray:
        return self._known.centre_velocity()

    def shift_velocities(self, velocity: np.ndarray) -> None:
        self.ledger.heat += self.moving.energy_of_shift(self.centre_velocity(), velocity)
        self._known.scale(1.0, velocity)
        self._velocities_changed()

    def _scale_velocities(self, factor: float, shift: np.ndarray) -> None:
        self._known.scale(factor, shift)
        self._velocities_changed()

    def draw_momenta(self, bath: Thermostat, time: float) -> None:
        """Draw velocities anew, keeping a part of the old ones; constraints leave the new ones canonical."""
        self._settle()
        before, kept = self.kinetic_energy(), math.exp(-bath.friction * time)
        self._known.refresh_velocities(kept, GAS_CONSTANT * bath.temperature, self.ledger.noise())
        if len(self._constraints.pairs):
            self._known.constrain_velocities(self._integrator.getConstraintTolerance())
        self._velocities_changed()
        self.ledger.heat += self.kinetic_energy() - before
        self.ledger.draws += 1

    def potential_energy(self) -> float:
        self._settle()
        if self._potential is None:
            state = openmm.Context.getState(self._context, energy=True, parameters=True, groups=self._groups)
            energy = state.getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
            self._potential = Potential(energy, Environment.of(state))
        return self._potential.energy

    # --- there and back, with the atoms as OpenMM has them ---

    def remember(self) -> Memory:
        return Memory(self._known.both, self.clock, self._box(), self.ledger.mark(), self._potential)

    def go_back(self, memory: Memory, reverse: bool = False) -> None:
        positions, velocities = memory.point
        if memory.box != self._box():
            self._set_box(memory.box)
        self._known.write_positions(positions)
        self._write_velocities(-velocities if reverse else velocities)
        self._follows_bath = False
        self.clock = memory.clock
        self._potential = memory.more
        self.ledger.go_back(memory.mark)

    def _box(self) -> Any:
        return self._known.box

    def _set_box(self, box: Any) -> None:
        self._known.forget()
        super()._set_box(box)

    # --- what users ask ---

    def heat(self) -> float:
        """See `Engine.heat`; NaN where the program does not count it."""
        if not self._program.counts_heat:
            return math.nan
        counted = super().heat()
        if WORK in self._program.vectors:
            counted += float(np.sum(self._integrator.getPerDofVariableByName(WORK)))
        return counted

    @property
    def momentum_lag(self) -> float:
        # The program has its bath also where there is no friction.
        return self._program.momentum_lag

    def state(self) -> BodyState:
        return self._told.state(Snapshot.of(self._context))

    def temperatures(self, conserved: bool) -> Temperatures:
        """Return temperatures in K, see `system.temperature`; without rigid bodies only the total is known.

        Flexible molecules have those just after a bath in the middle of the last step, as with `ExactEngine`.
        """
        now, thermal = Snapshot.of(self._context), self._velocities_after_bath()
        return self._told.temperatures(now, lambda: self.point, thermal, conserved)

    def _velocities_after_bath(self) -> np.ndarray | None:
        """Return velocities of all particles just after a bath in the middle of the last step, nm/ps, if it had one."""
        if self._follows_bath and self.flow.scheme.bath_divides_drift and self.flow.fast_groups:
            return np.array(self._integrator.getPerDofVariableByName(V0))
        return None

    def degrees_of_freedom(self, conserved: bool) -> float:
        return self._told.degrees_of_freedom(self.positions, conserved)

    # --- changes by users, and what a restart needs ---

    def start_anew(self) -> None:
        self._is_fresh = True
        self._potential = None
        self._velocities_changed()

    def atoms_moved(self) -> None:
        super().atoms_moved()
        self.start_anew()
        self._known.forget()
        self._follows_bath = False

    def forces_changed(self) -> None:
        super().forces_changed()
        # OpenMM itself considers no force valid after that.
        self._potential = None

    def box_changed(self) -> None:
        super().box_changed()
        self._known.forget()
        self._is_box_new = True

    def groups_changed(self) -> None:
        """Make the Context anew: OpenMM fixes the groups when it reads the program."""
        self._context.reinitialize(preserveState=True)
