"""The native engine: OpenMM executes the scheme, which is written out as the integrator's program, on any platform."""

import math
import weakref
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import BodyState, RigidBodies, RigidityError
from openmm_sier.dynamics.flow import Flow
from openmm_sier.dynamics.noise import generator
from openmm_sier.dynamics.thermostat import Thermostat
from openmm_sier.engines import neighbour_list, own_methods
from openmm_sier.engines.beginnings import refuse_what_is_not_finite
from openmm_sier.engines.interrupts import act_on_pending
from openmm_sier.engines.native import refusals
from openmm_sier.engines.native.installation import EXACT_ONLY, set_variables
from openmm_sier.engines.native.known_atoms import KnownAtoms
from openmm_sier.engines.native.program import V0, WORK, Program
from openmm_sier.engines.native.settling import satisfy_constraints
from openmm_sier.engines.native.writing import refuse_other_slow_groups
from openmm_sier.engines.protocol import Clock, Engine, Movers, TrajectoryError
from openmm_sier.engines.snapshot import Snapshot, box_of
from openmm_sier.engines.variables import DRAWS, HEAT, PART, Record
from openmm_sier.stability.step_check import StepCheck
from openmm_sier.system import tables
from openmm_sier.system.arguments import Bodies, groups_of
from openmm_sier.system.find_bodies import BodyPlan, known_or_planned
from openmm_sier.system.temperature import Temperatures, temperature, temperatures, thermal_energies

#: Relative tolerance of constraints. OpenMM's default of 1e-5 leaves velocities wrong by 1e-5 of a bond for each
#: substep, a larger energy error than that of the schemes.
TOLERANCE = 1e-9

#: Positions in single precision cannot be constrained better.
SINGLE_TOLERANCE = 1e-6

#: Steps of one native step each in one call of OpenMM, after which signals are looked at.
AT_ONCE = 10

#: Box, nm, and parameters of a Context, on which the potential energy depends.
Environment = tuple[Any, dict[str, float]]


class Memory(NamedTuple):
    """What `remember` gives.

    Attributes:
        positions, velocities: (N, 3), nm and nm/ps.
        box: periodic box vectors, nm.
        clock: time and step count.
        potential: potential energy, kJ/mol; None if it is not known.
        heat, draws: so far.
    """

    positions: np.ndarray
    velocities: np.ndarray
    box: Any
    clock: Clock
    potential: float | None
    heat: float
    draws: int


class NativeEngine(Engine):
    """An engine that is the program of the integrator.

    The Context has the state at any time. An error in mid-step leaves it where it happened, as with OpenMM's
    integrators.
    """

    name = "native"
    repeats_noise = False

    def __init__(self, context: openmm.Context, flow: Flow, bodies: Bodies, program: Program) -> None:
        """The integrator has the program; see `Engine` for the rest.

        Bodies, as users give them, have to be rigid by constraints.

        Raises:
            openmm.OpenMMException: the integrator needs what only the exact engine has, or the System has a Force that
                does not work with divided steps.
        """
        super().__init__(context, flow)
        system, integrator = context.getSystem(), context.getIntegrator()
        self._program, self._variables = program, Record(integrator)
        refusals.refuse(flow, bodies, program, system)
        refusals.refuse_unsolved(self._trial.unsolved())
        # Other integration groups come with another engine, since OpenMM fixes them when it reads the program.
        refusals.refuse_fast_forces(system, groups_of(flow.fast_groups), integrator.getIntegrationForceGroups())
        refuse_other_slow_groups(program, system, integrator.getIntegrationForceGroups(), flow.fast_groups)
        self._constraints = tables.constraints(system)
        self._has_sites = any(map(system.isVirtualSite, range(system.getNumParticles())))
        points, itself = refusals.points(system), weakref.proxy(context)
        self.movers = Movers(points, lambda: itself.getMolecules())
        # The atom of each point: those of none come first.
        self._atoms = np.argsort(points.owners, kind="stable")[points.n_particles - points.n :]
        try:
            self._found: Any = known_or_planned(system, bodies)
        except RigidityError as error:
            self._found = error
        rigid = () if isinstance(self._found, RigidityError) else self._found.species
        self._check_step = StepCheck(system, points, lambda following, _: self.inner_step(following), rigid)
        self._step_at_first = openmm.CustomIntegrator.getStepSize(integrator).value_in_unit(unit.picosecond)
        self._potential: float | None = None
        self._environment: Any = None
        self._is_box_new = False
        self._is_guarded = bool(self._variables[EXACT_ONLY])
        self._is_fresh = True
        #: Whether OpenMM still has the forces of the end of the last step.
        self._has_force = False
        #: Whether velocities are those that the last step left.
        self._follows_bath = False
        self.evaluations = 0
        platform = context.getPlatform()
        precision = "Precision" in platform.getPropertyNames() and platform.getPropertyValue(context, "Precision")
        self._known = KnownAtoms(context, is_single=precision == "single")
        if precision == "single":
            integrator.setConstraintTolerance(max(SINGLE_TOLERANCE, integrator.getConstraintTolerance()))

    @cached_property
    def bodies(self) -> RigidBodies:
        """The rigid and point bodies of the System.

        Raises:
            RigidityError: the System has constraints that do not form rigid bodies.
        """
        if isinstance(self._found, RigidityError):
            raise self._found
        return self._found.bodies(self.positions()) if isinstance(self._found, BodyPlan) else self._found

    @property
    def clock(self) -> Clock:
        return Clock(self._context.getTime().value_in_unit(unit.picosecond), self._context.getStepCount())

    @clock.setter
    def clock(self, clock: Clock) -> None:
        self._context.setTime(clock.time)
        self._context.setStepCount(clock.steps)

    def heat(self) -> float:
        """See `Engine.heat`; NaN where the program does not count it."""
        if not self._program.counts_heat:
            return math.nan
        if WORK not in self._program.vectors:
            return self._variables[HEAT]
        return self._variables[HEAT] + float(np.sum(self._integrator.getPerDofVariableByName(WORK)))

    @property
    def draws(self) -> int:
        return int(self._variables[DRAWS])

    @draws.setter
    def draws(self, number: int) -> None:
        self._variables[DRAWS] = number

    # --- one call of the integrator's step ---

    def _begin(self, flow: Flow) -> None:
        self._flow = flow
        self._check_step(flow, self._integrator.getIntegrationForceGroups(), self._context)
        set_variables(self._integrator, flow.bath, is_guarded=False)
        if self._potential is not None and self._environment_now() != self._environment:
            self._potential = None
        if self._is_box_new:
            # OpenMM takes the forces of the last step for valid if only the box was changed. To set velocities, though
            # they are the same, makes it compute them.
            velocities = own_methods.get_state(self._context, velocities=True).getVelocities(asNumpy=True)
            own_methods.set_velocities(self._context, velocities)
            self._is_box_new = self._has_force = False
        self._known.keep()

    def _environment_now(self) -> Environment:
        return _environment_of(own_methods.get_state(self._context, parameters=True))

    def follow(self, steps: int, wants_energy: bool = False) -> None:
        if self._flow.step == 0:
            # Steps of zero length are only counted: the program would divide by zero.
            time, count = self.clock
            self.clock = Clock(time, count + steps)
            return
        if not steps:
            return
        self._settle()
        if not self._has_force:
            self.evaluations += int(self._flow.scheme.reuses_force)
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
                own_methods.constrain_velocities(self._context, self._integrator.getConstraintTolerance())

    def _whole_steps(self, steps: int) -> int:
        """Make some steps of one native step each, and return their number."""
        count, start = min(steps, AT_ONCE), self.clock
        try:
            self._native_steps(count)
        finally:
            made = self._context.getStepCount() - start.steps
            self._completed(made)
            # On the CPU and Reference platforms OpenMM's own clock takes the step that the Context was created with.
            if self._flow.step != self._step_at_first:
                self.clock = Clock(start.time + made * self._flow.step, start.steps + made)
        return count

    def _divided_step(self, _: int) -> int:
        """Make one step, which OpenMM counts as several native ones, and return 1."""
        clock, parts = self.clock, len(self._program.parts)
        try:
            self._native_steps(parts)
        finally:
            # Even after an error the clock must agree with the positions.
            if self._context.getStepCount() == clock.steps + parts:
                self.clock = Clock(clock.time + self._flow.step, clock.steps + 1)
                self._completed(1)
        return 1

    def _native_steps(self, number: int) -> None:
        try:
            openmm.CustomIntegrator.step(self._integrator, number)
        except openmm.OpenMMException as error:
            # What follows begins with the first part of a step.
            self._variables[PART] = 0.0
            if "nan" in str(error).lower():
                raise TrajectoryError(str(error)) from error
            raise

    def _completed(self, steps: int) -> None:
        self._follows_bath = self._follows_bath or steps > 0
        self.evaluations += steps * self._flow.scheme.force_evaluations

    def check_step(self, flow: Flow) -> None:
        self._check_step(flow, self._integrator.getIntegrationForceGroups())

    def _publish(self) -> None:
        """Close the program to anyone else; the Context has the state at any time."""
        self._known.release()
        if self._is_guarded:
            self._variables[EXACT_ONLY] = 1.0

    def start_anew(self) -> None:
        self._is_fresh, self._has_force, self._potential = True, False, None

    def atoms_moved(self) -> None:
        self.start_anew()
        self._known.forget()
        self._follows_bath = False

    def _settle(self) -> None:
        """After news from outside, make what follows depend on nothing but what the Context holds."""
        if not self._is_fresh:
            return
        refuse_what_is_not_finite(Snapshot(self._context))
        if neighbour_list.is_remembered(self._context):
            neighbour_list.forget(self._context)
        if len(self._constraints.pairs):
            refusals.refuse_unsolved(self._trial.unsolved(self.positions))
            satisfy_constraints(self._context, self._constraints, self._integrator.getConstraintTolerance())
        if self._has_sites:
            # OpenMM places them at the end of a step, and the first needs forces before that.
            self._context.computeVirtualSites()
        self._known.forget()
        self._is_fresh = False

    def _let_openmm_solve(self, by_openmm: Callable[[], None]) -> None:
        refusals.refuse_unsolved(self._trial.unsolved(self.positions))
        by_openmm()

    def forces_changed(self) -> None:
        # OpenMM itself considers no force valid after that.
        self._potential = None

    def box_changed(self) -> None:
        self._is_box_new = True

    def groups_changed(self) -> None:
        """OpenMM fixes the groups when it reads the program."""
        self._context.reinitialize(preserveState=True)

    # --- between flows ---

    def potential_energy(self) -> float:
        self._settle()
        if self._potential is None:
            groups = self._integrator.getIntegrationForceGroups()
            state = own_methods.get_state(self._context, energy=True, parameters=True, groups=groups)
            self._potential = state.getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
            self._environment = _environment_of(state)
        return self._potential

    @property
    def point(self) -> BodyState:
        points, (positions, velocities) = self.movers.bodies, self._known.both
        q, v = positions[self._atoms].T, velocities[self._atoms].T
        A = np.broadcast_to(np.eye(3)[:, :, None], (3, 3, points.n))
        return BodyState(q, points.masses * v, A, np.zeros_like(q), self._variables[HEAT], self.draws)

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
            velocities[self._atoms] = (new.p / self.movers.bodies.masses).T
            self._write_velocities(velocities)
        self._variables[HEAT], self.draws = new.heat, new.draws

    def _write_velocities(self, velocities: np.ndarray) -> None:
        self._known.write_velocities(velocities)
        # OpenMM considers no force valid after that.
        self._has_force = False

    def add_heat(self, energy: float) -> None:
        self._variables[HEAT] += energy

    def kinetic_energy(self) -> float:
        return self._known.kinetic_energy()

    def centre_velocity(self) -> np.ndarray:
        return self._known.centre_velocity()

    def shift_velocities(self, velocity: np.ndarray) -> None:
        gained = self.movers.bodies.mass * float((self.centre_velocity() + 0.5 * velocity) @ velocity)
        self._known.shift(velocity)
        self._has_force = False
        self.add_heat(gained)

    def positions(self) -> np.ndarray:
        return self._known.positions

    def draw_momenta(self, bath: Thermostat, time: float) -> None:
        """Draw velocities anew, keeping a part of the old ones; constraints leave the new ones canonical."""
        self._settle()
        known, before = self._known, self.kinetic_energy()
        old = known.velocities
        # OpenMM replaces a zero by a seed of its own choice.
        seed = int(generator(bath.seed, self.draws).integers(1, 2**31 - 1))
        known.forget_velocities()
        own_methods.draw_velocities(self._context, bath.temperature, seed)
        self._has_force = False
        kept = math.exp(-bath.friction * time)
        if kept:
            known.write_velocities(kept * old + math.sqrt(1 - kept**2) * known.velocities)
        self.add_heat(self.kinetic_energy() - before)
        self.draws += 1

    def remember(self) -> Memory:
        positions, velocities = self._known.both
        heat = self._variables[HEAT]
        return Memory(positions, velocities, self._known.box, self.clock, self._potential, heat, self.draws)

    def go_back(self, memory: Memory, reverse: bool = False) -> None:
        if memory.box != self._box():
            self._set_box(memory.box)
        self._known.write_positions(memory.positions)
        self._write_velocities(-memory.velocities if reverse else memory.velocities)
        self._follows_bath = False
        self.clock, self._potential = memory.clock, memory.potential
        self._variables[HEAT], self.draws = memory.heat, memory.draws

    def _box(self) -> Any:
        return self._known.box

    def _set_box(self, box: Any) -> None:
        self._known.forget()
        super()._set_box(box)

    # --- what users ask ---

    def inner_step(self, flow: Flow) -> float:
        return flow.step * self._program.inner_fraction

    @property
    def momentum_lag(self) -> float:
        # The program has its bath also where there is no friction.
        return self._integrator.scheme.momentum_lag

    def state(self) -> BodyState:
        bodies, now = self.bodies, Snapshot(self._context)
        q, A = bodies.fit(now.positions)
        p, L = bodies.momenta(now.velocities, A)
        return BodyState(q, p, A, L, self.heat())

    def temperatures(self, conserved: bool) -> Temperatures:
        """Temperatures in K, see `system.temperature`; without rigid bodies only the total is known.

        Flexible molecules have those just after a bath in the middle of the last step, as with `ExactEngine`.
        """
        thermal = self._velocities_after_bath()
        if not isinstance(self._found, RigidityError):
            bodies, state = self.bodies, self.state()
            if thermal is not None:
                p, _ = bodies.momenta(thermal, state.A)
                # Where heat is not counted, the bath leaves noise along the constraints.
                p = bodies.constraints.project(state.q, p)
                state = replace(state, p=np.where(bodies.flexible, p, state.p))
            return temperatures(bodies, state, conserved)
        bodies, state = self.movers.bodies, self.point
        if thermal is not None:
            state = replace(state, p=bodies.masses * thermal[self._atoms].T)
        kinetic = sum(thermal_energies(bodies, state, conserved))
        return Temperatures(temperature(kinetic, self.degrees_of_freedom(conserved)), math.nan, math.nan)

    def _velocities_after_bath(self) -> np.ndarray | None:
        """Return velocities of all particles just after a bath in the middle of the last step, nm/ps, if it had one."""
        if self._follows_bath and self._flow.scheme.bath_divides_drift and self._flow.fast_groups:
            return np.array(self._integrator.getPerDofVariableByName(V0))
        return None

    def degrees_of_freedom(self, conserved: bool) -> float:
        if not isinstance(self._found, RigidityError):
            return super().degrees_of_freedom(conserved)
        return self.movers.bodies.dof - len(self._constraints.pairs) - (3 if conserved else 0)


def _environment_of(state: openmm.State) -> Environment:
    return box_of(state), dict(state.getParameters())
