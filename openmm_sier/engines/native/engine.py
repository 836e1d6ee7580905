"""The native engine: OpenMM executes the scheme, which is written out as the integrator's program, on any platform."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import BodyState, RigidBodies, RigidityError
from openmm_sier.dynamics.noise import generator
from openmm_sier.dynamics.thermostat import Thermostat
from openmm_sier.engines import neighbour_list
from openmm_sier.engines.interrupts import act_on_pending
from openmm_sier.engines.native import refusals
from openmm_sier.engines.native.installation import EXACT_ONLY, set_variables
from openmm_sier.engines.native.program import WORK, Program, longest_inner_step
from openmm_sier.engines.protocol import Clock, Engine, Flow, TrajectoryError
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.engines.temperature import Temperatures, temperature, thermal_energies
from openmm_sier.engines.variables import DRAWS, HEAT
from openmm_sier.system import tables
from openmm_sier.system.arguments import Bodies, groups_of
from openmm_sier.system.find_bodies import BodyPlan, known_or_planned
from openmm_sier.system.vibrations import Vibrations

#: Relative tolerance of constraints. OpenMM's default of 1e-5 leaves velocities wrong by 1e-5 of a bond for each
#: substep, a larger energy error than that of the schemes.
TOLERANCE = 1e-9

#: Positions in single precision cannot be constrained better.
SINGLE_TOLERANCE = 1e-6

#: Atoms further than this off their constraints, in nm or nm/ps, were put there from outside and are moved onto them.
#: OpenMM's own constraints leave errors of up to 5e-9 nm, since SETTLE works with lengths in single precision.
OFF = 1e-7

#: Atoms still further off than this afterwards, in nm, have not converged.
NOT_CONVERGED = 1e-4

# OpenMM's methods before `hooks` replaces them: after them forces and energy are still known.
set_velocities, draw_velocities = openmm.Context.setVelocities, openmm.Context.setVelocitiesToTemperature


class _Memory(NamedTuple):
    """What `remember` gives."""

    now: Snapshot
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

    def __init__(
        self,
        integrator: openmm.CustomIntegrator,
        context: openmm.Context,
        flow: Flow,
        bodies: Bodies,
        program: Program,
    ) -> None:
        """The integrator has the program; see `Engine` for the rest.

        Bodies, as users give them, have to be rigid by constraints.

        Raises:
            openmm.OpenMMException: the integrator needs what only the exact engine has, or the System has a Force that
                does not work with divided steps.
        """
        super().__init__(integrator, context, flow)
        system = context.getSystem()
        self._program = program
        refusals.refuse(flow, bodies, program, system)
        # Other integration groups come with another engine, since OpenMM fixes them when it reads the program.
        refusals.refuse_fast_forces(system, groups_of(flow.fast_groups), integrator.getIntegrationForceGroups())
        self._constraints = tables.constraints(system)
        self._points = refusals.points(system)
        try:
            self._found: Any = known_or_planned(system, bodies)
        except RigidityError as error:
            self._found = error
        self._vibrations = Vibrations(system, self._points)
        self._check_step()
        self._masses = tables.masses(system)
        self._potential: float | None = None
        self._environment: Any = None
        self._is_guarded = bool(integrator.getGlobalVariableByName(EXACT_ONLY))
        self._is_fresh = True
        self.evaluations = 0
        platform = context.getPlatform()
        precision = "Precision" in platform.getPropertyNames() and platform.getPropertyValue(context, "Precision")
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
    def _movers(self) -> RigidBodies:
        """The massive atoms, each a body of its own."""
        return self._points

    @property
    def clock(self) -> Clock:
        return Clock(self._context.getTime().value_in_unit(unit.picosecond), self._context.getStepCount())

    @clock.setter
    def clock(self, clock: Clock) -> None:
        self._context.setTime(clock.time)
        self._context.setStepCount(clock.steps)

    @property
    def _counted_heat(self) -> float:
        """The heat without that which the program counts for each degree of freedom, kJ/mol."""
        return self._integrator.getGlobalVariableByName(HEAT)

    def heat(self) -> float:
        return self._counted_heat + float(np.sum(self._integrator.getPerDofVariableByName(WORK)))

    def add_heat(self, energy: float) -> None:
        self._integrator.setGlobalVariableByName(HEAT, self._counted_heat + energy)

    @property
    def draws(self) -> int:
        return int(self._integrator.getGlobalVariableByName(DRAWS))

    @draws.setter
    def draws(self, number: int) -> None:
        self._integrator.setGlobalVariableByName(DRAWS, number)

    # --- one call of the integrator's step ---

    def begin(self, flow: Flow) -> None:
        self._flow = flow
        self._check_step()
        set_variables(self._integrator, flow.bath, is_guarded=False)
        state = self._context.getState(parameters=True)
        environment = state.getPeriodicBoxVectors().value_in_unit(unit.nanometer), dict(state.getParameters())
        if environment != self._environment:
            self._environment, self._potential = environment, None

    def _inner_step(self) -> float:
        return self._flow.step * longest_inner_step(self._flow.scheme, self._flow.substeps)

    def follow(self, steps: int) -> None:
        clock, flow = self.clock, self._flow
        if flow.step == 0:
            # Steps of zero length are only counted: the program would divide by zero.
            self.clock = Clock(clock.time, clock.steps + steps)
            return
        if steps:
            self._settle()
        self._potential = None
        evaluations = flow.scheme.force_evaluations
        for _ in range(steps):
            clock = self._one_step(clock)
            self.evaluations += evaluations
            act_on_pending()

    def _one_step(self, clock: Clock) -> Clock:
        """Make one step, which OpenMM counts as several native ones."""
        parts, after = len(self._program.parts), Clock(clock.time + self._flow.step, clock.steps + 1)
        try:
            openmm.CustomIntegrator.step(self._integrator, parts)
        except openmm.OpenMMException as error:
            if "nan" in str(error).lower():
                raise TrajectoryError(str(error)) from error
            raise
        finally:
            # Even after an error the clock must agree with the positions.
            if self._context.getStepCount() == clock.steps + parts:
                self.clock = after
        return after

    def publish(self) -> None:
        """Close the program to anyone else; the Context has the state at any time."""
        if self._is_guarded:
            self._integrator.setGlobalVariableByName(EXACT_ONLY, 1.0)

    def recover(self) -> None:
        self.publish()

    def start_anew(self) -> None:
        self._is_fresh, self._potential = True, None

    atoms_moved = start_anew

    def _settle(self) -> None:
        """After news from outside, make what follows depend on nothing but what the Context holds."""
        if not self._is_fresh:
            return
        if neighbour_list.is_remembered(self._context):
            neighbour_list.forget(self._context)
        self._satisfy_constraints()
        # Count the force that an earlier step would have left.
        self.evaluations += int(self._flow.scheme.reuses_force)
        self._is_fresh = False

    def _satisfy_constraints(self) -> None:
        """Move atoms and velocities onto the constraints; those that satisfy them are unchanged, bit for bit.

        Raises:
            RigidityError: OpenMM cannot satisfy them.
        """
        if not len(self._constraints.pairs):
            return
        context, tolerance = self._context, self._integrator.getConstraintTolerance()
        errors, speeds = self._constraint_errors()
        if not errors.max() <= OFF:
            context.applyConstraints(tolerance)
            errors, speeds = self._constraint_errors()
            worst = int(np.argmax(np.where(np.isfinite(errors), errors, np.inf)))
            if not errors[worst] <= NOT_CONVERGED:
                i, j = self._constraints.pairs[worst].tolist()
                raise RigidityError(
                    f"the constraint of atoms {i} and {j} wants them {self._constraints.lengths[worst]:.4f} nm apart, "
                    f"and OpenMM could move them no nearer to that than {errors[worst]:.2g} nm: give positions that "
                    "satisfy the constraints"
                )
        if not speeds.max() <= OFF:
            context.applyVelocityConstraints(tolerance)

    def _constraint_errors(self) -> tuple[np.ndarray, np.ndarray]:
        """Errors of the distances, nm, and velocities along the constraints, nm/ps, each (c,)."""
        now, (first, second) = Snapshot(self._context), self._constraints.pairs.T
        arms, velocities = (vectors[second] - vectors[first] for vectors in (now.positions, now.velocities))
        errors = np.abs(np.linalg.norm(arms, axis=1) - self._constraints.lengths)
        return errors, np.abs((arms * velocities).sum(axis=1)) / self._constraints.lengths

    def forces_changed(self) -> None:
        self._potential = None
        # After this OpenMM considers no force valid.
        self._context.setPeriodicBoxVectors(*self._context.getState().getPeriodicBoxVectors())

    def groups_changed(self) -> None:
        """OpenMM fixes the groups when it reads the program."""
        self._context.reinitialize(preserveState=True)

    # --- between flows ---

    def potential_energy(self) -> float:
        self._settle()
        if self._potential is None:
            groups = self._integrator.getIntegrationForceGroups()
            state = self._context.getState(energy=True, groups=groups)
            self._potential = state.getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
        return self._potential

    def kinetic_energy(self) -> float:
        return 0.5 * float(self._masses @ (Snapshot(self._context).velocities ** 2).sum(axis=1))

    def _set_velocities(self, velocities: np.ndarray, gained_since: float) -> None:
        """Set velocities (N, 3); what is gained since a kinetic energy is heat."""
        set_velocities(self._context, velocities)
        self.add_heat(self.kinetic_energy() - gained_since)

    def positions(self) -> np.ndarray:
        return Snapshot(self._context).positions

    def draw_momenta(self, bath: Thermostat, time: float) -> None:
        """Draw velocities anew, keeping a part of the old ones; constraints leave the new ones canonical."""
        self._settle()
        old, before = Snapshot(self._context).velocities, self.kinetic_energy()
        # OpenMM replaces a zero by a seed of its own choice.
        seed = int(generator(bath.seed, self.draws).integers(1, 2**31 - 1))
        draw_velocities(self._context, bath.temperature, seed)
        kept = math.exp(-bath.friction * time)
        self._set_velocities(kept * old + math.sqrt(1 - kept**2) * Snapshot(self._context).velocities, before)
        self.draws += 1

    def remember(self) -> _Memory:
        return _Memory(Snapshot(self._context), self._potential, self._counted_heat, self.draws)

    def go_back(self, memory: _Memory, reverse: bool = False) -> None:
        context, now = self._context, memory.now
        if context.getState().getPeriodicBoxVectors().value_in_unit(unit.nanometer) != now.box:
            context.setPeriodicBoxVectors(*now.box)
        context.setPositions(now.positions)
        context.setVelocities(-now.velocities if reverse else now.velocities)
        self._integrator.setGlobalVariableByName(HEAT, memory.heat)
        self.clock, self.draws, self._potential = Clock(now.time, now.steps), memory.draws, memory.potential

    def centre_velocity(self) -> np.ndarray:
        return self._masses @ Snapshot(self._context).velocities / self.mass

    def shift_velocities(self, velocity: np.ndarray) -> None:
        old = Snapshot(self._context).velocities
        self._set_velocities(np.where(self._masses[:, None] > 0, old + velocity, old), self.kinetic_energy())

    def scale_velocities(self, factor: float) -> None:
        self._set_velocities(factor * Snapshot(self._context).velocities, self.kinetic_energy())

    def scale(self, factor: float) -> None:
        context = self._context
        box = context.getState().getPeriodicBoxVectors(asNumpy=True).value_in_unit(unit.nanometer)
        positions = self.positions()
        context.setPeriodicBoxVectors(*(factor * box))
        atoms = np.concatenate([species.atoms[:, 0] for species in self._points.species])
        positions[atoms] += (factor - 1) * self._centres(positions[atoms].T).T
        context.setPositions(positions)
        context.computeVirtualSites()

    # --- what users ask ---

    @property
    def momentum_lag(self) -> float:
        # The program has its bath also where there is no friction.
        return self._integrator.scheme.momentum_lag

    def state(self) -> BodyState:
        return self._state_of(self.bodies)

    def _state_of(self, bodies: RigidBodies) -> BodyState:
        now = Snapshot(self._context)
        q, A = bodies.fit(now.positions)
        p, L = bodies.momenta(now.velocities, A)
        return BodyState(q, p, A, L, self.heat())

    def temperatures(self) -> Temperatures:
        """Temperatures in K, see `engines.temperature`; without rigid bodies only the total is known."""
        if not isinstance(self._found, RigidityError):
            return super().temperatures()
        kinetic = sum(thermal_energies(self._points, self._state_of(self._points), self.conserves_momentum()))
        return Temperatures(temperature(kinetic, self.degrees_of_freedom()), math.nan, math.nan)

    def degrees_of_freedom(self) -> float:
        if not isinstance(self._found, RigidityError):
            return super().degrees_of_freedom()
        return self._points.dof - len(self._constraints.pairs) - (3 if self.conserves_momentum() else 0)

    def minimize(self, by_openmm: Callable[[], None], tolerance: Any, iterations: int, reporter: Any) -> None:
        by_openmm()
        self.atoms_moved()
