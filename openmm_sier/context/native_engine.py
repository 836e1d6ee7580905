"""Runs an integrator's own program in one Context: the counterpart of `engine`, for any platform."""

from __future__ import annotations

import weakref
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
import openmm

from openmm_sier.context import checks, neighbour_list
from openmm_sier.context.engine import HEAT
from openmm_sier.context.native_program import WORK
from openmm_sier.context.snapshot import Snapshot
from openmm_sier.dynamics.bodies import BodyState, RigidBodies, RigidityError
from openmm_sier.dynamics.constants import GAS_CONSTANT

if TYPE_CHECKING:
    from openmm_sier.context.integrator import SIERIntegrator

#: Tolerance of constraints, relative. OpenMM's default of 1e-5 leaves velocities wrong by 1e-5 of a bond for each
#: substep, which costs more energy than the schemes do.
TOLERANCE = 1e-9

#: Positions of single precision cannot be constrained better.
SINGLE_TOLERANCE = 1e-6

#: Atoms this far off their constraints, in nm or nm/ps, were put there from outside and are moved onto them. OpenMM's
#: own constraints leave up to 5e-9 nm, since SETTLE works with lengths of single precision.
OFF_CONSTRAINTS = 1e-7

#: Atoms still this far off in nm afterwards have not converged.
NOT_CONVERGED = 1e-4


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
            # OpenMM holds no force to be valid after this.
            context.setPeriodicBoxVectors(*context.getState().getPeriodicBoxVectors())


class NativeEngine:
    """Binding of a `SIERIntegrator` to a Context in which OpenMM executes its program.

    Attributes:
        forces: the count of force evaluations.
    """

    #: What `SIERIntegrator.engine` says.
    name = "native"

    def __init__(self, integrator: SIERIntegrator, context):
        """
        Raises:
            openmm.OpenMMException: the integrator asks for what only the exact engine has, or the System has a Force
                that works with no step that is divided.
        """
        # The Context owns its integrator, so that a strong reference back would keep both alive.
        self._context_ref = weakref.ref(context)
        self._integrator_ref = weakref.ref(integrator)
        system = context.getSystem()
        _refuse(integrator, system)
        self._pairs, self._lengths = _constraints(system)
        self._masses = np.array([system.getParticleMass(i)._value for i in range(system.getNumParticles())])
        forces = [system.getForce(i) for i in range(system.getNumForces())]
        self.removes_motion = any(isinstance(force, openmm.CMMotionRemover) for force in forces)
        self.forces = _Forces(self)
        self._bodies: RigidBodies | None = None
        self._state: BodyState | None = None
        self._is_fresh = True
        _loosen_for_single_precision(integrator, context)

    @property
    def context(self):
        """The Context."""
        context = self._context_ref()
        if context is None:
            raise openmm.OpenMMException("The Context of this integrator no longer exists")
        return context

    @property
    def _integrator(self) -> SIERIntegrator:
        integrator = self._integrator_ref()
        if integrator is None:
            raise openmm.OpenMMException("The integrator of this Context no longer exists")
        return integrator

    # --- stepping ---

    def run(self, count: int) -> None:
        """Advance by `count` steps. As with OpenMM's integrators, an error leaves the Context where it happened."""
        integrator, context = self._integrator, self.context
        if not count:
            return
        integrator._tell_program()
        if self._is_fresh:
            self._start_anew()
        parts, h = integrator._native_steps, integrator.getStepSize()._value
        if h == 0:
            # Steps of no length are counted; the program would divide by them.
            context.setStepCount(context.getStepCount() + count)
            return
        evaluations = integrator.scheme.force_evaluations
        native_step = openmm.CustomIntegrator.step
        for _ in range(count):
            time, steps = context.getTime()._value, context.getStepCount()
            try:
                native_step(integrator, parts)
            finally:
                # Whatever interrupts, the clock agrees with the positions: OpenMM has counted native steps.
                if context.getStepCount() == steps + parts:
                    context.setStepCount(steps + 1)
                    context.setTime(time + h)
            self.forces.evaluations += evaluations

    def notice(self) -> None:
        """Positions or velocities were set from outside."""
        self._is_fresh = True

    def start_anew(self) -> None:
        """Make the next step depend on nothing but what the Context holds, so that a restart repeats it to the bit."""
        self._is_fresh = True

    def _start_anew(self) -> None:
        if neighbour_list.is_remembered(self.context):
            neighbour_list.forget(self.context)
        self._constrain()
        self._is_fresh = False

    def set_groups(self) -> None:
        """Other force groups move the atoms from now on: OpenMM fixes them when it reads the program."""
        self.context.reinitialize(preserveState=True)

    def _constrain(self) -> None:
        """Move atoms that were set from outside, and their velocities, onto the constraints.

        Those that satisfy them stay as they are, to the bit.
        """
        context, tolerance = self.context, self._integrator.getConstraintTolerance()
        now = Snapshot(context)
        off = self._off_constraints(now)
        if off[0] > OFF_CONSTRAINTS:
            context.applyConstraints(tolerance)
            now = Snapshot(context)
            self._demand_converged(now)
            off = self._off_constraints(now)
        if off[1] > OFF_CONSTRAINTS:
            context.applyVelocityConstraints(tolerance)

    def _off_constraints(self, now: Snapshot) -> tuple[float, float]:
        """Largest error of a length, nm, and largest velocity along a constraint, nm/ps."""
        if not len(self._pairs):
            return 0.0, 0.0
        lengths, along = self._along_constraints(now)
        return float(np.abs(lengths - self._lengths).max()), float(np.abs(along).max())

    def _along_constraints(self, now: Snapshot) -> tuple[np.ndarray, np.ndarray]:
        i, j = self._pairs.T
        arms, velocities = now.positions[j] - now.positions[i], now.velocities[j] - now.velocities[i]
        lengths = np.linalg.norm(arms, axis=1)
        return lengths, (arms * velocities).sum(axis=1) / np.where(lengths > 0, lengths, 1)

    def _demand_converged(self, now: Snapshot) -> None:
        lengths, _ = self._along_constraints(now)
        errors = np.abs(lengths - self._lengths)
        worst = int(np.argmax(np.where(np.isfinite(errors), errors, np.inf)))
        if not errors[worst] <= NOT_CONVERGED:
            i, j = self._pairs[worst].tolist()
            raise RigidityError(
                f"atoms {i} and {j} are {lengths[worst]:.4f} nm apart and their constraint wants "
                f"{self._lengths[worst]:.4f} nm, onto which OpenMM could not move them: minimize the energy first"
            )

    # --- what users ask ---

    @property
    def bodies(self) -> RigidBodies:
        """The rigid bodies of the Context's System.

        Raises:
            RigidityError: the System has constraints that form no rigid bodies.
        """
        return self._bodies or self._settle(Snapshot(self.context).positions)

    def _settle(self, positions) -> RigidBodies:
        plan = self._integrator._plan_bodies(self.context.getSystem())
        self._bodies = plan.bodies(positions)
        return self._bodies

    @property
    def state(self) -> BodyState:
        """The bodies' phase point when `adopt` was called."""
        if self._state is None:
            raise openmm.OpenMMException("The Context has no positions yet")
        return self._state

    def adopt(self) -> None:
        """Work out the bodies' phase point from the atoms.

        Raises:
            RigidityError: the System has constraints that form no rigid bodies, or positions do not form them.
        """
        if self._is_fresh:
            self._constrain()
        now = Snapshot(self.context)
        bodies = self._bodies or self._settle(now.positions)
        q, A = bodies.fit(now.positions)
        p, L = bodies.momenta(now.velocities, A)
        self._state = BodyState(q, p, A, L, self.heat())

    def heat(self) -> float:
        """Energy that the bath has given, kJ/mol."""
        integrator = self._integrator
        return integrator.getGlobalVariableByName(HEAT) + float(np.sum(integrator.getPerDofVariableByName(WORK)))

    def temperature(self) -> float:
        """In K, of all degrees of freedom that constraints leave; NaN where there are none."""
        velocities = Snapshot(self.context).velocities
        kinetic = 0.5 * float(self._masses @ (velocities * velocities).sum(axis=1))
        freedoms = 3 * int((self._masses > 0).sum()) - len(self._pairs) - (3 if self.removes_motion else 0)
        return 2 * kinetic / (freedoms * GAS_CONSTANT) if freedoms > 0 else float("nan")


def _refuse(integrator: SIERIntegrator, system) -> None:
    """Refuse what only the exact engine can do.

    Raises:
        openmm.OpenMMException: saying what that is and the remedy.
    """
    reason = integrator._only_exact() or _unheld_bodies(integrator._given_bodies, system)
    if reason is not None:
        raise openmm.OpenMMException(f"The native engine {reason}, or take engine='exact', which any platform runs")
    forces = [system.getForce(i) for i in range(system.getNumForces())]
    for force in forces:
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


def _unheld_bodies(given, system) -> str | None:
    """What is said of a body that is named and that constraints do not keep rigid; None if there is none."""
    if given is None:
        return None
    rows = [a for s in given.species for a in s.atoms.tolist()] if isinstance(given, RigidBodies) else given
    held = {tuple(sorted(system.getConstraintParameters(i)[:2])) for i in range(system.getNumConstraints())}
    for row in rows:
        massive = sorted(int(i) for i in row if system.getParticleMass(int(i))._value > 0)
        for pair in combinations(massive, 2):
            if pair not in held:
                return (
                    f"keeps rigid what constraints do, and none joins atoms {pair[0]} and {pair[1]} of a body in "
                    "`bodies`: constrain every two atoms of it"
                )
    return None


def _constraints(system) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (n, 2) of atoms and lengths (n,) in nm of all constraints."""
    found = [system.getConstraintParameters(i) for i in range(system.getNumConstraints())]
    pairs = np.array([(a, b) for a, b, _ in found], dtype=np.int64).reshape(-1, 2)
    return pairs, np.array([length._value for *_, length in found])


def _loosen_for_single_precision(integrator: SIERIntegrator, context) -> None:
    platform = context.getPlatform()
    single = "Precision" in platform.getPropertyNames() and platform.getPropertyValue(context, "Precision") == "single"
    if single and integrator.getConstraintTolerance() < SINGLE_TOLERANCE:
        integrator.setConstraintTolerance(SINGLE_TOLERANCE)
