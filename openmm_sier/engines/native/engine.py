"""Runs an integrator's own program in one Context: the counterpart of `engine`, for any platform."""

from __future__ import annotations

import math
import weakref
from collections.abc import Sequence
from itertools import combinations

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodyState, RigidBodies, RigidityError, Species
from openmm_sier.dynamics.schemes import WITHIN_DRIFTS
from openmm_sier.engines import neighbour_list
from openmm_sier.engines.constraint_errors import Constraints
from openmm_sier.engines.host import Host
from openmm_sier.engines.native import fast_forces as native_fast_forces
from openmm_sier.engines.native.program import WORK, longest_inner_step
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.engines.stored_state import HEAT
from openmm_sier.engines.temperature import (
    MomentumConservation,
    Temperatures,
    temperature,
    temperatures,
    thermal_energies,
)
from openmm_sier.system import checks, tables
from openmm_sier.system.arguments import groups_of
from openmm_sier.system.vibrations import Vibrations

#: Relative tolerance of constraints. OpenMM's default of 1e-5 leaves velocities wrong by 1e-5 of a bond for each
#: substep, a larger energy error than that of the schemes.
TOLERANCE = 1e-9

#: Positions in single precision cannot be constrained better.
SINGLE_TOLERANCE = 1e-6


class _Forces:
    """Count of force evaluations, which OpenMM makes on its own.

    Attributes:
        evaluations: how many there were.
    """

    def __init__(self, engine: NativeEngine):
        self.evaluations = 0
        self._engine = weakref.ref(engine)

    def invalidate(self) -> None:
        """Compute anew next time: the potential has changed."""
        if (engine := self._engine()) is not None:
            context = engine.context
            # After this OpenMM considers no force valid.
            context.setPeriodicBoxVectors(*context.getState().getPeriodicBoxVectors())


class NativeEngine:
    """Binding of a `SIERIntegrator` to a Context in which OpenMM executes its program.

    Attributes:
        forces: the count of force evaluations.
    """

    #: The value of `SIERIntegrator.engine`.
    name = "native"

    def __init__(self, integrator: Host, context: openmm.Context) -> None:
        """
        Raises:
            openmm.OpenMMException: the integrator needs what only the exact engine has, or the System has a Force that
                does not work with divided steps.
        """
        # The Context owns its integrator, so that a strong reference back would keep both alive.
        self._context_ref = weakref.ref(context)
        self._integrator_ref = weakref.ref(integrator)
        system = context.getSystem()
        _refuse(integrator, system)
        self._constraints = Constraints(system)
        self._points = _points(system)
        self._bodies: RigidBodies | None = None
        try:
            self._plan, self._no_bodies = integrator._plan_bodies(system), None
        except RigidityError as error:
            self._plan, self._no_bodies = None, str(error)
        self._vibrations = Vibrations(system, self._points)
        self._check_step()
        self._momentum = MomentumConservation.of_system(system, self._points)
        self.forces = _Forces(self)
        self._state: BodyState | None = None
        self._is_fresh = True
        _loosen_for_single_precision(integrator, context)

    @property
    def context(self) -> openmm.Context:
        """The Context."""
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

    def _check_step(self) -> None:
        integrator = self._integrator
        h, groups = integrator.getStepSize()._value, integrator.getIntegrationForceGroups()
        scheme, fast = integrator.scheme, integrator._fast_groups
        native_fast_forces.refuse(self.context.getSystem(), groups_of(fast), groups)
        self._vibrations.check(scheme, h, groups & ~fast)
        inner = h * longest_inner_step(scheme, integrator._substeps)
        self._vibrations.check_nested(WITHIN_DRIFTS, inner, h, fast)

    # --- stepping ---

    def run(self, count: int) -> None:
        """Advance by `count` steps. As with OpenMM's integrators, an error leaves the Context where it happened."""
        integrator, context = self._integrator, self.context
        self._check_step()
        integrator._tell_program()
        if count and self._is_fresh:
            self._start_anew()
        parts, h = integrator._native_steps, integrator.getStepSize()._value
        if h == 0:
            # Steps of zero length are only counted: the program would divide by zero.
            context.setStepCount(context.getStepCount() + count)
            return
        evaluations, native_step = integrator.scheme.force_evaluations, openmm.CustomIntegrator.step
        for _ in range(count):
            time, steps = context.getTime()._value, context.getStepCount()
            try:
                native_step(integrator, parts)
            finally:
                # OpenMM has counted native steps. Even after an interrupt the clock must agree with the positions.
                if context.getStepCount() == steps + parts:
                    context.setStepCount(steps + 1)
                    context.setTime(time + h)
            self.forces.evaluations += evaluations

    def notice(self) -> None:
        """Respond to positions or velocities that were set from outside."""
        self._is_fresh = True

    def start_anew(self) -> None:
        """Make the next step depend on nothing but what the Context holds, so that a restart repeats it bit for bit."""
        self._is_fresh = True

    def _start_anew(self) -> None:
        if neighbour_list.is_remembered(self.context):
            neighbour_list.forget(self.context)
        self._constraints.satisfy(self.context, self._integrator.getConstraintTolerance())
        # Count the force that an earlier step would have left.
        self.forces.evaluations += int(self._integrator.scheme.reuses_force)
        self._is_fresh = False

    def renew_forces(self) -> None:
        """Respond to a change of the potential."""
        self.forces.invalidate()

    def set_groups(self) -> None:
        """Respond to a change of the force groups that move the atoms, which OpenMM fixes when it reads the program."""
        self.context.reinitialize(preserveState=True)

    # --- what users ask ---

    @property
    def bodies(self) -> RigidBodies:
        """The rigid bodies of the Context's System.

        Raises:
            RigidityError: the System has constraints that do not form rigid bodies.
        """
        if self._plan is None:
            raise RigidityError(self._no_bodies)
        if self._bodies is None:
            positions = Snapshot(self.context).positions if self._plan.needs_positions else None
            self._bodies = self._plan.bodies(positions)
        return self._bodies

    @property
    def state(self) -> BodyState:
        """The bodies' phase point at the last call of `adopt`."""
        if self._state is None:
            raise openmm.OpenMMException("The Context has no positions yet")
        return self._state

    def adopt(self) -> None:
        """Work out the bodies' phase point from the atoms.

        Raises:
            RigidityError: the System has constraints that do not form rigid bodies, or the positions do not fit the
                bodies.
        """
        self._state = self._state_of(self.bodies)

    def _state_of(self, bodies: RigidBodies) -> BodyState:
        now = Snapshot(self.context)
        q, A = bodies.fit(now.positions)
        p, L = bodies.momenta(now.velocities, A)
        return BodyState(q, p, A, L, self.heat())

    def heat(self) -> float:
        """Energy that the bath has given, kJ/mol."""
        integrator = self._integrator
        return integrator.getGlobalVariableByName(HEAT) + float(np.sum(integrator.getPerDofVariableByName(WORK)))

    def conserves_momentum(self) -> bool:
        """Whether the total momentum is conserved, see `MomentumConservation`."""
        return self._momentum.holds(self._integrator)

    def temperatures(self) -> Temperatures:
        """Temperatures in K, see `openmm_sier.engines.temperature`; without rigid bodies only the total is known."""
        conserved = self.conserves_momentum()
        if self._plan is not None:
            return temperatures(self.bodies, self._state_of(self.bodies), conserved)
        kinetic = sum(thermal_energies(self._points, self._state_of(self._points), conserved))
        dof = self._points.dof - len(self._constraints.pairs) - (3 if conserved else 0)
        return Temperatures(temperature(kinetic, dof), math.nan, math.nan)


def _points(system: openmm.System) -> RigidBodies:
    """The atoms of a System, each a body of its own."""
    masses = tables.masses(system)
    kinds = [(mass, np.flatnonzero(masses == mass)[:, None]) for mass in np.unique(masses[masses > 0])]
    return RigidBodies(
        [Species(atoms, np.array([mass]), np.zeros((3, 1)), np.zeros(3)) for mass, atoms in kinds], len(masses)
    )


def _refuse(integrator: Host, system: openmm.System) -> None:
    """Refuse what only the exact engine can do.

    Raises:
        openmm.OpenMMException: the message says what that is, and the remedy.
    """
    reason = integrator._only_exact() or _unheld_bodies(integrator._given_bodies, system)
    if reason is not None:
        raise openmm.OpenMMException(f"The native engine {reason}, or take engine='exact', which any platform runs")
    for force in system.getForces():
        if isinstance(force, openmm.AndersenThermostat):
            raise openmm.OpenMMException(
                "The native engine divides its step, which AndersenThermostat takes for the whole one: use "
                "SIERLangevinIntegrator without it, or take engine='exact'"
            )
        deforms = isinstance(force, checks.BAROSTATS) and hasattr(force, "getScaleMoleculesAsRigid")
        if deforms and system.getNumConstraints() and not force.getScaleMoleculesAsRigid():
            raise openmm.OpenMMException(
                f"{type(force).__name__} scales every atom apart, which constraints do not bear: create it with "
                "scaleMoleculesAsRigid=True"
            )


def _unheld_bodies(given: RigidBodies | Sequence[Sequence[int]] | None, system: openmm.System) -> str | None:
    """Text of a refusal for a named body that constraints do not keep rigid; None if there is no such body."""
    if given is None:
        return None
    rows = [a for s in given.species for a in s.atoms.tolist()] if isinstance(given, RigidBodies) else given
    held, masses = tables.constraints(system).pair_set(), tables.masses(system)
    for row in rows:
        massive = sorted(int(i) for i in row if 0 <= i < len(masses) and masses[i] > 0)
        for pair in combinations(massive, 2):
            if pair not in held:
                return (
                    f"keeps rigid what constraints do, and none joins atoms {pair[0]} and {pair[1]} of a body in "
                    "`bodies`: constrain every two atoms of it"
                )
    return None


def _loosen_for_single_precision(integrator: Host, context: openmm.Context) -> None:
    platform = context.getPlatform()
    single = "Precision" in platform.getPropertyNames() and platform.getPropertyValue(context, "Precision") == "single"
    if single and integrator.getConstraintTolerance() < SINGLE_TOLERANCE:
        integrator.setConstraintTolerance(SINGLE_TOLERANCE)
