"""The integrators that OpenMM users call."""

from __future__ import annotations

import functools
import math
import numbers
import re
from collections.abc import Sequence

import openmm
from openmm import unit

from openmm_sier.context.engine import ARMED, DRAWS, HEAT, SEED, SITES, STATE_VARIABLES, Engine
from openmm_sier.context.find_bodies import BodyPlan, refuse_other_masses
from openmm_sier.context.temperature import Temperatures
from openmm_sier.dynamics.barostat import Piston
from openmm_sier.dynamics.bodies import BodyState, RigidBodies
from openmm_sier.dynamics.rotation import rotor
from openmm_sier.dynamics.schemes import SIER2, SIER4, Scheme

#: OpenMM's message about an illegal variable of this name tells what happened.
LOST = "A_SIER_integrator_is_lost_in_XML__create_it_anew_or_copy_it_by_deepcopy_or_pickle"

#: What users may give as bodies.
Bodies = RigidBodies | Sequence[Sequence[int]] | None


class SIERIntegrator(openmm.CustomIntegrator):
    """Symplectic integrator for rigid bodies that uses the exact solution of free rotation.

    A drop-in for OpenMM's integrators: give it to a `Simulation` or a `Context` and nothing else is to be called. Rigid
    molecules are found in the System's constraints when the Context is created; a System with constraints that form
    no rigid bodies is refused there. Velocities in the Context are those of the whole step.

    Source: van Zon and Schofield (2007).
    """

    def __init__(self, stepSize, scheme: Scheme = SIER2, bodies: Bodies = None, rotation=rotor.exact):
        """
        Args:
            stepSize: step, a time quantity or a number in ps.
            scheme: splitting scheme, see `openmm_sier.dynamics.schemes`.
            bodies: the rigid bodies; None finds them in the System's constraints. Lists of particle indices make rigid
                bodies, of the geometry that they have at the first step, besides those that constraints make.
            rotation: free-rotation map, as `rotor.exact`.

        Raises:
            ValueError: the step is not positive and finite.
            TypeError: the step is no time, or `scheme` is no Scheme.
        """
        if not isinstance(scheme, Scheme):
            raise TypeError(f"scheme must be a Scheme, such as openmm_sier.SIER4, got {scheme!r}")
        super().__init__(_step_size(stepSize))
        self._scheme = scheme
        self._given_bodies = bodies
        self._rotation = rotation
        self._engine: Engine | None = None
        self._write_program()

    def _write_program(self) -> None:
        for name in (*STATE_VARIABLES, SITES):
            self.addPerDofVariable(name, 0)
        for name in (HEAT, DRAWS, SEED, ARMED):
            self.addGlobalVariable(name, 0)
        # A copy that has lost this class, through XML say, would advance the clock and move nothing. It fails instead:
        # Reference and CPU name the variable that does not exist, other platforms stop at positions that are NaN.
        self.beginIfBlock(f"{ARMED} < 0.5")
        self.addComputePerDof(LOST, "0")
        self.addComputePerDof("x", f"x + sqrt({ARMED} - 1)")
        self.addComputeGlobal(ARMED, "energy")
        self.endBlock()
        self.addUpdateContextState()

    # --- what users ask ---

    @property
    def scheme(self) -> Scheme:
        """The splitting scheme."""
        return self._scheme

    @property
    def rotation(self):
        """The free-rotation map."""
        return self._rotation

    @property
    def bodies(self) -> RigidBodies:
        """The rigid bodies of the Context that this integrator is bound to."""
        return self._bound().bodies

    @property
    def forceEvaluations(self) -> int:
        """Number of force evaluations done by this integrator since its Context was created."""
        return self._bound().forces.evaluations

    @property
    def conservesMomentum(self) -> bool:
        """Whether the total momentum is conserved, so that three degrees of freedom hold no heat.

        See `openmm_sier.context.temperature.MomentumConservation`.
        """
        return self._bound().conserves_momentum()

    def setStepSize(self, size) -> None:
        """Set the step, a time quantity or a number in ps."""
        super().setStepSize(_step_size(size))

    def getBodyState(self) -> BodyState:
        """The rigid bodies' state, in agreement with the Context.

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
        self._bound().run(whole_number("steps", steps))

    def computeSystemTemperature(self):
        """Temperature from the kinetic energy and the degrees of freedom of the bodies, a quantity in K.

        OpenMM's StateDataReporter asks for it. Where the total momentum is conserved, three degrees of freedom and the
        kinetic energy of the centre of mass are left out, with a CMMotionRemover or without. NaN without degrees of
        freedom.
        """
        return self.computeTemperatures().total * unit.kelvin

    def computeTemperatures(self) -> Temperatures:
        """Temperatures of all motion, of translation and of rotation, numbers in K.

        A named tuple (total, translation, rotation), counted as `computeSystemTemperature` does; NaN for what has no
        degrees of freedom.
        """
        return self._bound().temperatures()

    def forcesChanged(self) -> None:
        """Say that the potential was changed in a way that no method of the Context or of its Forces makes.

        Changes of positions, velocities, box and Context parameters, and those by `updateParametersInContext`, are
        noticed without this.
        """
        self._bound().forces.forget()

    def setIntegrationForceGroups(self, groups) -> None:
        """Set the force groups that move the bodies, as a set or a bit mask; it takes effect with the next step."""
        super().setIntegrationForceGroups(groups)
        if self._engine is not None:
            self._engine.forces.forget()

    # --- copies ---

    def __reduce__(self):
        settings = {
            "IntegrationForceGroups": self.getIntegrationForceGroups(),
            "ConstraintTolerance": self.getConstraintTolerance(),
            "RandomNumberSeed": self.getRandomNumberSeed(),
        }
        return _rebuild, (type(self), self._arguments(), settings)

    def __copy__(self):
        return _rebuild(*self.__reduce__()[1])

    def __deepcopy__(self, memo):
        return self.__copy__()

    def _arguments(self) -> dict:
        """What the constructor needs to make an integrator like this one, not bound to a Context."""
        return {**self._own_arguments(), "stepSize": self.getStepSize(), "bodies": self._given_bodies}

    def _own_arguments(self) -> dict:
        return {"scheme": self._scheme, "rotation": self._rotation}

    # --- for the engine and for subclasses ---

    def _bind(self, context) -> None:
        # A System that is refused when a Context is reinitialized must not leave the bodies of the old one.
        self._engine = None
        self._engine = Engine(self, context)

    def _bound(self) -> Engine:
        if self._engine is None:
            raise openmm.OpenMMException("This integrator is not bound to a Context: create one with it first")
        return self._engine

    def _plan_bodies(self, system):
        """What the engine gets its bodies from: something with `needs_positions` and `bodies(positions)`."""
        n = system.getNumParticles()
        given = self._given_bodies
        if not isinstance(given, RigidBodies):
            return BodyPlan(system, rigid=given)
        if given.n_particles != n:
            raise ValueError(f"bodies are those of a system of {given.n_particles} particles, this one has {n}")
        refuse_other_masses(system, given)
        return _Settled(given)

    def _active_scheme(self) -> Scheme:
        """The scheme to execute now."""
        return self._scheme

    def _extra_operators(self, bodies: RigidBodies) -> dict:
        """Operators other than kick and drift."""
        return {}

    #: What changes the volume between steps.
    _piston: Piston | None = None


class _Settled:
    """A plan with bodies that are known already."""

    needs_positions = False

    def __init__(self, bodies: RigidBodies):
        self._bodies = bodies

    def bodies(self, positions, sites=None) -> RigidBodies:
        return self._bodies


class SIER2Integrator(SIERIntegrator):
    """Second-order integrator for rigid bodies with one force evaluation a step.

    Source: van Zon and Schofield (2007), Eq. Verlet.
    """

    def __init__(self, stepSize, bodies: Bodies = None):
        """
        Args:
            stepSize: step, a time quantity or a number in ps.
            bodies: see `SIERIntegrator`.
        """
        super().__init__(stepSize, SIER2, bodies)

    def _own_arguments(self) -> dict:
        return {}


class SIER4Integrator(SIERIntegrator):
    """Fourth-order integrator for rigid bodies with four force evaluations a step.

    Source: van Zon and Schofield (2007), Eq. EFRL.
    """

    def __init__(self, stepSize, bodies: Bodies = None):
        """
        Args:
            stepSize: step, a time quantity or a number in ps.
            bodies: see `SIERIntegrator`.
        """
        super().__init__(stepSize, SIER4, bodies)

    def _own_arguments(self) -> dict:
        return {}


def _rebuild(cls, arguments: dict, settings: dict):
    """The integrator of which `SIERIntegrator.__reduce__` gave class, constructor arguments and settings."""
    integrator = cls(**arguments)
    for name, value in settings.items():
        getattr(integrator, f"set{name}")(value)
    return integrator


def _step_size(size) -> float:
    size = quantity_to_float("stepSize", size, unit.picosecond, "ps")
    if size <= 0:
        raise ValueError(f"stepSize must be positive, got {size} ps; to run backwards reverse the velocities")
    return size


def quantity_to_float(name: str, value, of, symbol: str) -> float:
    """A finite number in a unit, from a quantity or a plain number."""
    if unit.is_quantity(value):
        if not value.unit.is_compatible(of):
            raise TypeError(f"{name} must be in units like {symbol}, got {value}")
        value = value.value_in_unit(of)
    try:
        value = float(value)
    except (TypeError, ValueError):
        raise TypeError(f"{name} must be a quantity or a number in {symbol}, got {value!r}") from None
    if not math.isfinite(value):
        raise ValueError(f"{name} must be finite, got {value} {symbol}")
    return value


def whole_number(name: str, value) -> int:
    """A nonnegative integer, from an int or a float without a fraction."""
    whole = isinstance(value, numbers.Integral) or (isinstance(value, numbers.Real) and float(value).is_integer())
    if not whole or value < 0:
        raise ValueError(f"{name} must be a whole number that is not negative, got {value!r}")
    return int(value)


def _binding(method):
    """A Context method after which the Context's integrator has to look at the System anew.

    OpenMM tells a Python integrator nothing of its Context, so that the Context has to.
    """

    @functools.wraps(method)
    def wrapper(self, *args, **kwargs):
        result = method(self, *args, **kwargs)
        integrator = getattr(self, "_integrator", None)
        if isinstance(integrator, SIERIntegrator):
            integrator._bind(self)
        else:
            _refuse_lost(integrator)
        return result

    return wrapper


def _forgetting(method):
    """`Context.reinitialize`, which without the state clears the per-atom variables but not the global ones."""

    @functools.wraps(method)
    def wrapper(self, preserveState=False):
        result = method(self, preserveState)
        integrator = getattr(self, "_integrator", None)
        if isinstance(integrator, SIERIntegrator) and not preserveState:
            integrator.setGlobalVariableByName(HEAT, 0)
            integrator.setGlobalVariableByName(DRAWS, 0)
        return result

    return wrapper


def _updating(method):
    """`updateParametersInContext` of a Force, after which the Context's forces are not those that were computed."""

    @functools.wraps(method)
    def wrapper(self, context, *args, **kwargs):
        result = method(self, context, *args, **kwargs)
        integrator = getattr(context, "_integrator", None)
        if isinstance(integrator, SIERIntegrator) and integrator._engine is not None:
            integrator.forcesChanged()
        return result

    return wrapper


def _accepting(method):
    """`Context.setState` as users of OpenMM's integrators know it.

    A State that another kind of integrator saved, after an equilibration say, is welcome: OpenMM takes over all of it
    and then fails over the parameters of that integrator, which mean nothing to ours. And as with OpenMM's integrators
    a State brings no noise that was used already: runs with other seeds from one State differ, and so do replicas that
    share a Context.
    """

    @functools.wraps(method)
    def wrapper(self, state):
        integrator = getattr(self, "_integrator", None)
        if not isinstance(integrator, SIERIntegrator):
            return method(self, state)
        seed, draws = map(integrator.getGlobalVariableByName, (SEED, DRAWS))
        try:
            method(self, state)
        except openmm.OpenMMException as error:
            if not re.search("IntegratorParameters|Illegal (global|per-DOF) variable", str(error)):
                raise
        integrator.setGlobalVariableByName(SEED, seed)
        integrator.setGlobalVariableByName(DRAWS, max(draws, integrator.getGlobalVariableByName(DRAWS)))
        return None

    return wrapper


def _refuse_lost(integrator) -> None:
    """Refuse what the package's Python part cannot reach."""
    parts = [integrator]
    if isinstance(integrator, openmm.CompoundIntegrator):
        parts = [integrator.getIntegrator(i) for i in range(integrator.getNumIntegrators())]
    for part in parts:
        if isinstance(part, openmm.CustomIntegrator) and _has_variable(part, ARMED):
            raise openmm.OpenMMException(
                "A SIER integrator cannot be part of a CompoundIntegrator"
                if isinstance(integrator, openmm.CompoundIntegrator)
                else "This CustomIntegrator was a SIER integrator before it went through XML, and cannot move anything "
                "by itself: create the SIER integrator anew, or copy it by copy.deepcopy or pickle"
            )


def _has_variable(integrator, name: str) -> bool:
    return any(integrator.getGlobalVariableName(i) == name for i in range(integrator.getNumGlobalVariables()))


def _replace(cls, name: str, wrapped) -> None:
    if name in vars(cls):
        setattr(cls, name, wrapped(vars(cls)[name]))


_replace(openmm.Context, "__init__", _binding)
_replace(openmm.Context, "reinitialize", _forgetting)
_replace(openmm.Context, "reinitialize", _binding)
_replace(openmm.Context, "setState", _accepting)
for _class in [member for member in vars(openmm).values() if isinstance(member, type)]:
    _replace(_class, "updateParametersInContext", _updating)
