"""The native engine: OpenMM executes the scheme, which is written out as the integrator's program, on any platform."""

import math
from collections.abc import Collection
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import BodySet, BodyState
from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.tally import Tally
from openmm_sier.engines import neighbour_list, trajectories
from openmm_sier.engines.actions import Actions
from openmm_sier.engines.native import refusals
from openmm_sier.engines.native.atom_cache import AtomCache
from openmm_sier.engines.native.constrained_start import are_satisfied, satisfy_constraints
from openmm_sier.engines.native.installation import set_bath
from openmm_sier.engines.native.reported_bodies import ReportedBodies
from openmm_sier.engines.native.writing import needs_finite_positions, refuse_other_slow_groups
from openmm_sier.engines.program import V0, WORK, Program
from openmm_sier.engines.protocol import Changes, Clock, Engine, RollbackState, TrajectoryError
from openmm_sier.engines.snapshot import Environment, Snapshot, time_of
from openmm_sier.engines.start_checks import refuse_what_is_not_finite
from openmm_sier.engines.trials import Outcome, Trial
from openmm_sier.engines.variables import PART, per_atom_values
from openmm_sier.stability.step_check import StepCheck
from openmm_sier.system import tables
from openmm_sier.system.arguments import groups_of
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

    The Context has the state after each call, but for velocities that wait in `AtomCache` for `publish`. An error in
    mid-step leaves it where it happened, as with OpenMM's integrators. The massive atoms move; rigid bodies are only
    reported to users.
    """

    name = "native"

    def __init__(
        self, context: openmm.Context, method: IntegrationMethod, tally: Tally, bodies: BodySet | None, program: Program
    ) -> None:
        """
        Args:
            context: openmm.Context, which has the integrator.
            method: the scheme that will be executed.
            tally: of the integrator.
            bodies: the rigid bodies; None: those that the constraints form.
            program: what OpenMM executes, which is written for the method.

        Raises:
            openmm.OpenMMException: the integrator needs what only the exact engine has, such as bodies that are not
                rigid by constraints, or the System has a Force that does not work with divided steps.
        """
        super().__init__(context, method, tally)
        system, integrator = context.getSystem(), context.getIntegrator()
        self._program = program
        refusals.refuse_system(system, bodies)
        self.accept(method, self._groups)
        self._constraints = tables.constraints(system)
        self._has_sites = tables.virtual_sites(system).size > 0
        self.moving = refusals.points(system)
        self._reported = ReportedBodies(system, bodies, self.moving)
        self.step_check = StepCheck(system, self.moving, self._reported.species, program.inner_fraction)
        #: The step size of OpenMM's own clock.
        self._step_of_clock = openmm.CustomIntegrator.getStepSize(integrator).value_in_unit(unit.picosecond)
        self._potential: Potential | None = None
        #: Whether OpenMM still has the forces of the end of the last step.
        self._has_force = False
        #: Whether velocities are those that the last step left.
        self._follows_bath = False
        self._atoms = AtomCache(context, is_single=self.precision == "single")
        self._remembers_list = neighbour_list.is_remembered(context)
        self._checks_positions = needs_finite_positions(system, context.getPlatform())
        if self.precision == "single":
            integrator.setConstraintTolerance(max(SINGLE_TOLERANCE, integrator.getConstraintTolerance()))

    @property
    def clock(self) -> Clock:
        return Clock(time_of(self._context), self._context.getStepCount())

    @clock.setter
    def clock(self, clock: Clock) -> None:
        openmm.Context.setTime(self._context, clock.time)
        openmm.Context.setStepCount(self._context, clock.steps)

    @cached_property
    def actions(self) -> Actions:
        return Actions(self._context, self.solver_test)

    # --- changes by users ---

    def accept(self, method: IntegrationMethod, groups: int | None = None) -> None:
        refusals.refuse_method(method, self._program)
        if groups is not None:
            system = self._context.getSystem()
            refusals.refuse_fast_forces(system, groups_of(method.fast_groups), groups)
            refuse_other_slow_groups(self._program, system, groups, method.fast_groups)

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
        if self._potential is not None:
            state = openmm.Context.getState(self._context, parameters=True)
            if Environment.of(state) != self._potential.environment:
                self._potential = None
        self.changes = Changes.SETTINGS

    def _check_start(self) -> None:
        """Check atoms that were moved, and let the next steps depend only on the contents of the Context."""
        self._potential = None
        self._velocities_changed()
        self._atoms.publish()
        now = Snapshot.of(self._context)
        refuse_what_is_not_finite(now)
        self.refuse_cut_molecules(now)
        if self._remembers_list:
            neighbour_list.forget(self._context)
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
        try:
            for _ in range(0, native_steps, in_a_call):
                openmm.CustomIntegrator.step(integrator, in_a_call)
                if self._checks_positions:
                    self._refuse_lost_atoms(count + 1)
        except openmm.OpenMMException as error:
            # The next native step is the first part of a step.
            integrator.setGlobalVariableByName(PART, 0.0)
            if "nan" in str(error).lower() and not isinstance(error, TrajectoryError):
                raise TrajectoryError(str(error)) from error
            raise
        finally:
            # An error in the middle of a step leaves the clock at the last completed one, as OpenMM does.
            made = (context.getStepCount() - count) // parts
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

    def make_trial(self, trial: Trial) -> Outcome:
        return trajectories.make_trial(self, trial)

    def publish(self) -> None:
        """Write velocities that an ensemble changed; all else the Context has at any time."""
        if self._atoms.is_unwritten:
            self._atoms.publish()

    def recover(self) -> None:
        self._atoms.publish()

    def store(self) -> None:
        """Do nothing: the phase point is in the Context."""

    # --- the phase point: the atoms as OpenMM has them ---

    def save(self) -> RollbackState:
        atoms, tally = self._atoms, self.tally
        return RollbackState(atoms.both, self.clock, atoms.box, tally.mark(), dict(tally.counts), self._potential)

    def restore(self, saved: RollbackState, reverse: bool = False) -> None:
        positions, velocities = saved.point
        if saved.box != self._atoms.box:
            self._atoms.write_box(saved.box)
        self._atoms.write_positions(positions)
        self._write_velocities(-velocities if reverse else velocities)
        self._follows_bath = False
        self.clock = saved.clock
        self._potential = saved.more
        self.tally.restore(saved.mark)

    def _write_velocities(self, velocities: np.ndarray) -> None:
        self._atoms.write_velocities(velocities)
        self._velocities_changed()

    def _velocities_changed(self) -> None:
        # OpenMM considers no force valid after that.
        self._has_force = False

    # --- moves of ensembles ---

    def positions(self) -> np.ndarray:
        return self._atoms.positions

    def potential_energy(self) -> float:
        if self.changes:
            self.synchronize()
        if self._potential is None:
            state = openmm.Context.getState(self._context, energy=True, parameters=True, groups=self._groups)
            energy = state.getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
            self._potential = Potential(energy, Environment.of(state))
        return self._potential.energy

    def kinetic_energy(self) -> float:
        return self._atoms.kinetic_energy()

    def centre_velocity(self) -> np.ndarray:
        return self._atoms.centre_velocity()

    def transform_velocities(self, factor: float, shift: np.ndarray) -> None:
        self._atoms.scale(factor, shift)
        self._velocities_changed()

    def draw_momenta(self, thermal: float, share: float) -> None:
        """Draw velocities, of which the old ones stay a share; constraints leave the new ones canonical."""
        before = self.kinetic_energy()
        self._atoms.refresh_velocities(share, thermal, self.tally.noise())
        if len(self._constraints.pairs):
            self._atoms.constrain_velocities(self._integrator.getConstraintTolerance())
        self._velocities_changed()
        self.tally.heat += self.kinetic_energy() - before
        self.tally.draws += 1

    def scale(self, factor: float) -> None:
        atoms, owners = self._atoms, self.moving.owners
        atoms.write_box([factor * edge for edge in atoms.box])
        positions = atoms.positions.copy()
        massive = owners >= 0
        points = np.empty((3, self.moving.n))
        points[:, owners[massive]] = positions[massive].T
        shifts = (factor - 1) * self.molecule_centres(points)
        positions[massive] += shifts[:, owners[massive]].T
        atoms.write_positions(positions)
        self._check_start()

    # --- questions of users ---

    @property
    def bodies(self) -> BodySet:
        """Return the rigid and point bodies of the System.

        Raises:
            RigidityError: the System has constraints that do not form rigid bodies.
        """
        return self._reported.bodies

    @property
    def momentum_lag(self) -> float:
        # The program has its bath also where there is no friction.
        return self._program.momentum_lag

    def state(self) -> BodyState:
        return self._reported.state(Snapshot.of(self._context))

    def temperatures(self, conserved: bool) -> Temperatures:
        """See `Engine.temperatures`; only those of flexible molecules are those just after the bath."""
        return self._reported.temperatures(Snapshot.of(self._context), self._velocities_after_bath(), conserved)

    def _velocities_after_bath(self) -> np.ndarray | None:
        """Return velocities of all particles just after a bath in the middle of the last step, nm/ps, if it had one."""
        has_followed = self._follows_bath and Changes.ATOMS not in self.changes
        if has_followed and self.method.scheme.bath_divides_drift and self.method.fast_groups:
            return per_atom_values(self._integrator, V0)
        return None

    def degrees_of_freedom(self, conserved: bool) -> float:
        return self._reported.degrees_of_freedom(conserved)

    def heat(self) -> float:
        """Return the energy from baths and moves, kJ/mol; NaN where the program does not count it."""
        if not self._program.counts_heat:
            return math.nan
        heat = self.tally.heat
        if WORK in self._program.vectors:
            heat += float(np.sum(per_atom_values(self._integrator, WORK)))
        return heat
