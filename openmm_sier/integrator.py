"""The OpenMM face of the package; the only module that touches a Context."""

from __future__ import annotations

import functools
import math
import numbers
import weakref

import numpy as np
import openmm
from openmm import unit

from openmm_sier import propagation, rotor
from openmm_sier.bodies import BodyState, RigidBodies
from openmm_sier.schemes import DRIFT, KICK, SIER2, SIER4, Scheme

#: Forces that change positions, velocities or the box between steps do so in `updateContextState`. These are known not
#: to; after any other kind the Context is read again each step.
PASSIVE_FORCES = (
    openmm.NonbondedForce,
    openmm.HarmonicBondForce,
    openmm.HarmonicAngleForce,
    openmm.PeriodicTorsionForce,
    openmm.RBTorsionForce,
    openmm.CMAPTorsionForce,
    openmm.GBSAOBCForce,
    openmm.GayBerneForce,
    openmm.RMSDForce,
    openmm.CustomBondForce,
    openmm.CustomAngleForce,
    openmm.CustomTorsionForce,
    openmm.CustomExternalForce,
    openmm.CustomCompoundBondForce,
    openmm.CustomCentroidBondForce,
    openmm.CustomNonbondedForce,
    openmm.CustomGBForce,
    openmm.CustomHbondForce,
    openmm.CustomManyParticleForce,
    openmm.CustomCVForce,
)


class SIERIntegrator(openmm.CustomIntegrator):
    """Symplectic integrator for rigid bodies that uses the exact solution of free rotation.

    A drop-in for OpenMM's integrators: give it to a `Simulation` or a `Context` and nothing else is to be called. Rigid
    molecules are found in the System's constraints when the Context is created; a System that has constraints that form
    no rigid bodies is refused there. Velocities in the Context are those of the whole step.

    Source: van Zon and Schofield (2007).
    """

    def __init__(self, stepSize, scheme: Scheme = SIER2, bodies: RigidBodies | None = None, rotation=rotor.exact):
        """
        Args:
            stepSize: step, a time quantity or a number in ps. A negative step runs backwards.
            scheme: splitting scheme, see `openmm_sier.schemes`.
            bodies: the rigid bodies; None finds them in the System's constraints.
            rotation: free-rotation map, as `rotor.exact`.

        Raises:
            ValueError: the step is zero or not finite.
            TypeError: the step is no time, or `scheme` is no Scheme.
        """
        if not isinstance(scheme, Scheme):
            raise TypeError(f"scheme must be a Scheme, such as openmm_sier.SIER4, got {scheme!r}")
        super().__init__(_step_size(stepSize))
        self.addUpdateContextState()
        self._scheme = scheme
        self._given_bodies = bodies
        self._rotation = rotation
        self._engine: _Engine | None = None

    @property
    def scheme(self) -> Scheme:
        """The splitting scheme."""
        return self._scheme

    @property
    def bodies(self) -> RigidBodies:
        """The rigid bodies of the Context that this integrator is bound to."""
        return self._bound().bodies

    @property
    def forceEvaluations(self) -> int:
        """Number of force evaluations done by this integrator since its Context was created."""
        return self._bound().forces.evaluations

    def setStepSize(self, size) -> None:
        """Set the step, a time quantity or a number in ps."""
        super().setStepSize(_step_size(size))

    def getBodyState(self) -> BodyState:
        """The rigid bodies' state at the last completed step, in agreement with the Context.

        Raises:
            RigidityError: the Context's positions do not form the bodies.
        """
        engine = self._bound()
        engine.adopt()
        return engine.state

    def step(self, steps) -> None:
        """Advance by a number of steps.

        An error or interrupt leaves the Context at the last completed step.

        Raises:
            ValueError: `steps` is negative or no whole number.
            RigidityError: positions set from outside do not form the bodies.
            openmm.OpenMMException: there is no Context, or a force is not finite.
        """
        count = _whole_number(steps)
        self._bound().run(count)

    def forcesChanged(self) -> None:
        """Say that the potential was changed by `Force.updateParametersInContext`.

        Changes of positions, velocities, box and Context parameters are noticed without this.
        """
        self._bound().forces.forget()

    def _bind(self, context) -> None:
        self._engine = _Engine(self, context)

    def _bound(self) -> _Engine:
        if self._engine is None:
            raise openmm.OpenMMException("This integrator is not bound to a Context: create one with it first")
        return self._engine


class SIER2Integrator(SIERIntegrator):
    """Second-order integrator for rigid bodies with one force evaluation a step.

    Source: van Zon and Schofield (2007), Eq. Verlet.
    """

    def __init__(self, stepSize, bodies: RigidBodies | None = None):
        """
        Args:
            stepSize: step, a time quantity or a number in ps.
            bodies: the rigid bodies; None finds them in the System's constraints.
        """
        super().__init__(stepSize, SIER2, bodies)


class SIER4Integrator(SIERIntegrator):
    """Fourth-order integrator for rigid bodies with four force evaluations a step.

    Source: van Zon and Schofield (2007), Eq. EFRL.
    """

    def __init__(self, stepSize, bodies: RigidBodies | None = None):
        """
        Args:
            stepSize: step, a time quantity or a number in ps.
            bodies: the rigid bodies; None finds them in the System's constraints.
        """
        super().__init__(stepSize, SIER4, bodies)


class _Engine:
    """Runs one integrator in one Context.

    The Context holds the atoms, the engine the bodies. `_echo` is what the Context gave back when the bodies were last
    written to it; whatever differs later was changed from outside.
    """

    def __init__(self, integrator: SIERIntegrator, context):
        # The Context owns its integrator, so that a strong reference back would keep both alive.
        self._context = weakref.ref(context)
        self._integrator = weakref.ref(integrator)
        system = context.getSystem()
        self.bodies = integrator._given_bodies or RigidBodies.from_system(system)
        if self.bodies.n_particles != system.getNumParticles():
            raise ValueError(
                f"bodies are those of a system of {self.bodies.n_particles} particles, this one has {system.getNumParticles()}"
            )
        self._positions = np.zeros((system.getNumParticles(), 3))
        self._velocities = np.zeros((system.getNumParticles(), 3))
        self._has_sites = any(system.isVirtualSite(i) for i in range(system.getNumParticles()))
        forces = [system.getForce(i) for i in range(system.getNumForces())]
        self._sweeps = [f.getFrequency() for f in forces if isinstance(f, openmm.CMMotionRemover)]
        passive = (*PASSIVE_FORCES, openmm.CMMotionRemover)
        self._has_actors = any(not isinstance(f, passive) for f in forces)
        self.forces = propagation.CachedForces(self._compute_forces)
        self.operators = {
            KICK: propagation.kick(self.forces),
            DRIFT: propagation.drift(self.bodies, integrator._rotation),
        }
        self.state: BodyState | None = None
        self._placed: tuple = (None, None)
        self._echo: _Snapshot | None = None

    def run(self, count: int) -> None:
        self.adopt()
        integrator, context = self._integrator(), self._context()
        before = None
        try:
            for _ in range(count):
                before = (context.getTime(), context.getStepCount(), context.getState().getPeriodicBoxVectors())
                self._one_step(integrator, context)
        except BaseException:
            if before is not None:
                context.setTime(before[0])
                context.setStepCount(before[1])
                context.setPeriodicBoxVectors(*before[2])
            self.forces.forget()
            raise
        finally:
            self._publish()
            self._echo = _Snapshot(context)

    def _one_step(self, integrator, context) -> None:
        sweeps = any(context.getStepCount() % frequency == 0 for frequency in self._sweeps)
        state = self.state
        if self._has_actors:
            self._publish()
            echo = _Snapshot(context)
            openmm.CustomIntegrator.step(integrator, 1)
            state = self._reconcile(state, echo, _Snapshot(context))
        else:
            openmm.CustomIntegrator.step(integrator, 1)
        if sweeps:
            drift = state.p.sum(axis=1) / self.bodies.masses.sum()
            state = BodyState(state.q, state.p - self.bodies.masses * drift[:, None], state.A, state.L)
        h = integrator.getStepSize().value_in_unit(unit.picosecond)
        self.state = propagation.step(integrator.scheme, self.operators, state, h)

    def adopt(self) -> None:
        """Take over what was changed in the Context from outside."""
        context = self._context()
        if context is None:
            raise openmm.OpenMMException("The Context of this integrator no longer exists")
        now = _Snapshot(context)
        self.state = self._reconcile(self.state, self._echo, now)
        self._echo = now

    def _reconcile(self, state: BodyState | None, before: _Snapshot | None, now: _Snapshot) -> BodyState:
        """The bodies' state after the Context changed from one snapshot to another."""
        if before is None or before.environment != now.environment:
            self.forces.forget()
        still = before is not None and np.array_equal(before.positions, now.positions)
        coasting = before is not None and np.array_equal(before.velocities, now.velocities)
        if state is None or not still:
            q, A = self.bodies.fit(now.positions, state)
            self._positions[:] = now.positions
            self._placed = (None, None)
            coasting = coasting and state is not None and np.array_equal(A, state.A)
        else:
            q, A = state.q, state.A
        p, L = (state.p, state.L) if coasting and state is not None else self.bodies.momenta(now.velocities, A)
        return BodyState(q, p, A, L)

    def _compute_forces(self, q, A):
        self._place(q, A)
        groups = self._integrator().getIntegrationForceGroups()
        forces = self._context().getState(forces=True, groups=groups).getForces(asNumpy=True)
        F, tau = self.bodies.forces_and_torques(forces._value, A)
        if not (np.isfinite(F).all() and np.isfinite(tau).all()):
            body = int(np.flatnonzero(~(np.isfinite(F) & np.isfinite(tau)).all(axis=0))[0])
            raise openmm.OpenMMException(
                f"The force on {self.bodies.describe(body)} is not finite in the step after step "
                f"{self._context().getStepCount()}. Is the step size too long, or do atoms overlap?"
            )
        return F, tau

    def _place(self, q, A) -> None:
        if self._placed[0] is q and self._placed[1] is A:
            return
        context = self._context()
        context.setPositions(self.bodies.place(q, A, self._positions))
        if self._has_sites:
            context.computeVirtualSites()
        self._placed = (q, A)

    def _publish(self) -> None:
        """Write the bodies' state to the Context."""
        self._place(self.state.q, self.state.A)
        self._context().setVelocities(self.bodies.move(self.state, self._velocities))


class _Snapshot:
    """What a Context holds that can be changed from outside."""

    def __init__(self, context):
        state = context.getState(positions=True, velocities=True, parameters=True)
        self.positions = state.getPositions(asNumpy=True)._value
        self.velocities = state.getVelocities(asNumpy=True)._value
        box = state.getPeriodicBoxVectors(asNumpy=True)._value
        self.environment = (box.tobytes(), dict(state.getParameters()))


def _step_size(size) -> float:
    if unit.is_quantity(size):
        if not size.unit.is_compatible(unit.picosecond):
            raise TypeError(f"stepSize must be a time, got {size}")
        size = size.value_in_unit(unit.picosecond)
    try:
        size = float(size)
    except (TypeError, ValueError):
        raise TypeError(f"stepSize must be a time quantity or a number in ps, got {size!r}") from None
    if not math.isfinite(size) or size == 0:
        raise ValueError(f"stepSize must be finite and not zero, got {size} ps")
    return size


def _whole_number(steps) -> int:
    if not isinstance(steps, numbers.Real) or steps != steps or math.isinf(steps) or int(steps) != steps or steps < 0:
        raise ValueError(f"steps must be a whole number that is not negative, got {steps!r}")
    return int(steps)


def _bind_at_creation(context_init):
    """OpenMM tells a Python integrator nothing of its Context, so that the Context's constructor has to."""

    @functools.wraps(context_init)
    def __init__(self, *args):
        context_init(self, *args)
        if len(args) > 1 and isinstance(args[1], SIERIntegrator):
            args[1]._bind(self)

    return __init__


openmm.Context.__init__ = _bind_at_creation(openmm.Context.__init__)
