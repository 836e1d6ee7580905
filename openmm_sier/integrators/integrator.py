"""The integrators that OpenMM users call."""

from __future__ import annotations

import copy
import inspect
import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.barostat import MonteCarloVolumeMove
from openmm_sier.dynamics.bodies import BodyState, RigidBodies
from openmm_sier.dynamics.operators import Operator, Rotation, Stepper, stepper
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.schemes import SIER4G, Scheme
from openmm_sier.engines.exact.engine import Engine
from openmm_sier.engines.native import program as native_program
from openmm_sier.engines.native.engine import TOLERANCE, NativeEngine
from openmm_sier.engines.native.program import EXACT_ONLY, FRICTION, PART, THERMAL, VECTORS, WORK, Program
from openmm_sier.engines.stored_state import DRAWS, HEAT, SEED, SITES, STATE_VARIABLES
from openmm_sier.engines.temperature import Temperatures
from openmm_sier.integrators import stored_settings
from openmm_sier.system import checks
from openmm_sier.system.arguments import Bodies, checked_bodies, group_mask, groups_of, step_size, whole_number
from openmm_sier.system.find_bodies import BodyPlan, KnownBodies, plan_bodies
from openmm_sier.system.runaway import RunawayWatch

#: The platforms on which `engine="auto"` takes the exact engine, since their forces are in memory that Python can read.
EXACT_PLATFORMS = ("CPU", "Reference")

ENGINES = ("auto", "exact", "native")


class SIERIntegrator(openmm.CustomIntegrator):
    """Symplectic integrator for rigid bodies that uses the exact solution of free rotation.

    A drop-in replacement for OpenMM's integrators: pass it to a `Simulation` or a `Context`; nothing else has to be
    called. Rigid molecules are found in the System's constraints when the Context is created. The atoms of other
    molecules are points, joined by their constraints. Velocities in the Context are those at the end of the step.

    Two engines can execute the scheme. The exact engine is a Python layer over the Context and rotates bodies exactly.
    The native engine is the integrator's own program, which OpenMM executes on any platform. It rotates bodies by
    RATTLE steps and moves molecules with constraints of any kind. XML carries the program, so that it also runs where
    this package is not imported: see docs/native.md.

    Source: van Zon and Schofield (2007).
    """

    def __init__(
        self,
        stepSize: Any,
        scheme: Scheme = SIER4G,
        bodies: Bodies = None,
        rotation: Rotation = exact,
        engine: str = "auto",
        substeps: int | None = None,
        fastForceGroups: Iterable[int] | int | None = None,
    ):
        """
        Args:
            stepSize: step, a time quantity or a number in ps.
            scheme: splitting scheme, see `openmm_sier.dynamics.schemes`.
            bodies: the rigid bodies; None finds them in the System's constraints. Lists of particle indices define
                further rigid bodies, with the geometry that they have at the first step.
            rotation: free-rotation map, such as `rotation.exact`.
            engine: "exact", "native", or "auto": exact on the CPU and Reference platforms and native on others.
            substeps: number of steps into which a drift is divided. Without fast forces these are RATTLE steps of the
                native engine: 3 and 5 make the drift fourth order, and None means 3, or 5 with SIER4, SIER4V and other
                schemes with long drifts. The exact engine's drifts are then not divided. With fast forces they are
                inner steps of SIER4G. None then means, with the exact engine, the least number for which they are no
                longer than 3 fs; with the native engine, 1, or 2 for schemes with long drifts.
            fastForceGroups: force groups that act within the drifts, as a set or a bit mask: bonds, angles and torsions
                of molecules that are not rigid, see `prepare_system`. The exact engine computes them in a separate
                Context of those molecules alone.

        Raises:
            ValueError: the step is negative or not finite, the engine is unknown, `substeps` is below 1, or a force
                group is not from 0 to 31. A step of 0 is allowed, for Contexts that only evaluate forces: steps are
                counted and nothing moves.
            TypeError: the step is not a time, `scheme` is not a Scheme, or `bodies` or `fastForceGroups` have the
                wrong type.
        """
        if not isinstance(scheme, Scheme):
            raise TypeError(f"scheme must be a Scheme, such as openmm_sier.SIER4, got {scheme!r}")
        if engine not in ENGINES:
            raise ValueError(f"engine must be one of {', '.join(ENGINES)}, got {engine!r}")
        if substeps is not None and (substeps := whole_number("substeps", substeps)) == 0:
            raise ValueError("substeps must be at least 1, got 0")
        super().__init__(step_size(stepSize))
        self._engine: Engine | NativeEngine | None = None
        self._scheme, self._rotation = scheme, rotation
        self._wanted_engine, self._substeps = engine, substeps
        self._fast_groups = group_mask("fastForceGroups", fastForceGroups)
        self._given_bodies = checked_bodies(bodies)
        for name in (*STATE_VARIABLES, SITES):
            self.addPerDofVariable(name, 0)
        for name in (HEAT, DRAWS, SEED):
            self.addGlobalVariable(name, 0)
        self._program = _written(scheme, substeps, self._fast_groups)
        native_program.install(self._program if isinstance(self._program, Program) else None, self)
        self.setConstraintTolerance(TOLERANCE)
        self.setStepSize(stepSize)
        self._store_settings()
        self._tell_program()

    @property
    def _native_steps(self) -> int:
        """Number of OpenMM steps in one step of the scheme."""
        return len(self._program.parts) if isinstance(self._program, Program) else 1

    def _tell_program(self) -> None:
        """Set the program's variables to the values that they must have, whatever was loaded."""
        friction, thermal = self._coupling()
        for name, value in (
            (EXACT_ONLY, float(self._needs_package())),
            (PART, 0),
            (FRICTION, friction),
            (THERMAL, thermal),
        ):
            if self.getGlobalVariableByName(name) != value:
                self.setGlobalVariableByName(name, value)

    def _bath_temperature(self) -> float | None:
        """Temperature of the heat bath in K, None without one."""
        return None

    def _needs_package(self) -> bool:
        """Whether the program, executed now by OpenMM alone, would do less than this integrator."""
        held = isinstance(self._engine, NativeEngine)
        return not held and (self._only_exact() is not None or self._given_bodies is not None)

    def _coupling(self) -> tuple[float, float]:
        """Friction in 1/ps and thermal energy in kJ/mol of the program's bath."""
        return 0.0, 0.0

    def _only_exact(self) -> str | None:
        """Why the native engine cannot run this integrator, and the remedy; None if it can."""
        if isinstance(self._program, str):
            return f"does not know this scheme, since {self._program}: take another scheme"
        if self._rotation is not exact:
            return "has no other free-rotation maps: leave out `rotation`"
        return None

    def _store_settings(self) -> None:
        """Add all settings that OpenMM does not know of to what it serializes."""
        stored_settings.store(self, "class", text=stored_settings.place_of(type(self)))
        stored_settings.store(self, "rotation", text=stored_settings.place_of(self._rotation))
        stored_settings.store_scheme(self, self._scheme)
        stored_settings.store_bodies(self, self._given_bodies)
        stored_settings.store(self, "engine", [self._substeps or 0, self._fast_groups], self._wanted_engine)

    def _take_settings(self, rotation: Rotation | None = None) -> None:
        """Read all settings from what OpenMM serialized; `rotation`, if given, replaces the free-rotation map."""
        self._engine = None
        self._scheme = stored_settings.stored_scheme(self)
        place = stored_settings.required(self, "rotation")[0]
        self._rotation = rotation or stored_settings.from_place(place, "free-rotation map")
        self._given_bodies = stored_settings.stored_bodies(self)
        self._wanted_engine, (substeps, groups) = stored_settings.required(self, "engine")
        self._substeps, self._fast_groups = int(substeps) or None, int(groups)
        self._program = _written(self._scheme, self._substeps, self._fast_groups)
        (self._step,) = stored_settings.required(self, "step")[1].tolist()
        step = super().getStepSize()._value * self._native_steps
        if not math.isclose(step, self._step, rel_tol=1e-12):
            # The step was set where this package was not imported.
            self._step = step

    # --- what users ask ---

    @property
    def engine(self) -> str:
        """The engine in use; before a Context is created, the one that was requested."""
        return self._wanted_engine if self._engine is None else self._engine.name

    @property
    def substeps(self) -> int | None:
        """Number of steps into which a drift is divided, as requested; None leaves it to the engine."""
        return self._substeps

    @property
    def fastForceGroups(self) -> set[int]:
        """The force groups that act within drifts."""
        return set(groups_of(self._fast_groups))

    @property
    def program(self) -> Program:
        """The program that the native engine executes; it can be printed.

        Raises:
            ValueError: the scheme has an operator that cannot be written out.
        """
        if isinstance(self._program, str):
            raise ValueError(self._program)
        return self._program

    @property
    def scheme(self) -> Scheme:
        """The splitting scheme."""
        return self._scheme

    @property
    def rotation(self) -> Rotation:
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

        See `openmm_sier.engines.temperature.MomentumConservation`.
        """
        return self._bound().conserves_momentum()

    def getStepSize(self) -> unit.Quantity:
        """The step of the scheme, a quantity in ps. OpenMM's own step may be a fraction of it."""
        return self._step * unit.picosecond

    def setStepSize(self, size: Any) -> None:
        """Set the step, a time quantity or a number in ps."""
        self._step = step_size(size)
        super().setStepSize(self._step / self._native_steps)
        stored_settings.store(self, "step", [self._step])

    def getBodyState(self) -> BodyState:
        """The state of the rigid bodies, brought up to date with the Context.

        Raises:
            RigidityError: the Context's positions do not form the bodies.
        """
        engine = self._bound()
        engine.adopt()
        return engine.state

    def step(self, steps: int) -> None:
        """Advance by a number of steps.

        An interrupt leaves the Context at the last completed step. With the exact engine an error does the same. With
        the native engine an error leaves the Context where it happened, as with OpenMM's integrators.

        Raises:
            ValueError: `steps` is negative or not a whole number.
            RigidityError: positions set from outside do not form the bodies.
            openmm.OpenMMException: there is no Context, a force is not finite, or the step is too long for a bond.
        """
        engine, count = self._bound(), whole_number("steps", steps)
        self._watch.over(engine.run, count, self)

    def computeSystemTemperature(self) -> unit.Quantity:
        """Temperature from the kinetic energy and the degrees of freedom of the bodies, a quantity in K.

        OpenMM's StateDataReporter calls it. Where the total momentum is conserved, with or without a CMMotionRemover,
        three degrees of freedom and the kinetic energy of the centre of mass are left out. NaN if there are no degrees
        of freedom.
        """
        return self.computeTemperatures().total * unit.kelvin

    def computeTemperatures(self) -> Temperatures:
        """Temperatures of all motion, of translation, of rotation and of flexible molecules, numbers in K.

        A named tuple (total, translation, rotation, flexible), by the rule of `computeSystemTemperature`; NaN where
        there are no degrees of freedom.
        """
        return self._bound().temperatures()

    def reported(self) -> dict[str, float]:
        """Additional columns for `ConservationReporter`, by name."""
        return {}

    def forcesChanged(self) -> None:
        """Tell the integrator that the potential was changed by other means than a method of the Context or its Forces.

        Changes of positions, velocities, box and Context parameters, and changes by `updateParametersInContext`, are
        noticed automatically.
        """
        self._bound().renew_forces()

    def setIntegrationForceGroups(self, groups: Iterable[int] | int) -> None:
        """Set the force groups that move the bodies, as a set or a bit mask; they take effect with the next step."""
        super().setIntegrationForceGroups(groups)
        if self._engine is not None:
            self._engine.set_groups()

    # --- copies ---

    def __copy__(self) -> SIERIntegrator:
        """An integrator with the same settings and variables, bound to no Context."""
        return _restored(_plain_clone(self), type(self), self._attributes())

    def __deepcopy__(self, memo: dict[int, Any]) -> SIERIntegrator:
        return self.__copy__()

    def __reduce__(self) -> tuple[Any, ...]:
        return _unpickled, (openmm.XmlSerializer.serialize(self), type(self), self._attributes())

    def _attributes(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in ("this", "_engine", "_watch")}

    # --- for the engine and for subclasses ---

    def _prepare_for(self, system: openmm.System) -> None:
        """Before a Context is created, clear what a copied integrator still holds from its original's Context."""
        self._clear_record()
        for name in (SEED, PART):
            self.setGlobalVariableByName(name, 0)
        for name in (*STATE_VARIABLES, SITES, *VECTORS):
            # OpenMM does not check that the number of values fits the System.
            if len(self.getPerDofVariableByName(name)) > 1:
                self.setPerDofVariableByName(name, np.zeros((system.getNumParticles(), 3)))

    def _bind(self, context: openmm.Context) -> None:
        checks.tell_of_frozen_atoms_that_move(context.getSystem())
        self._watch = RunawayWatch(context)
        # If the System is refused when a Context is reinitialized, the old System's bodies must not remain.
        self._engine = None
        exact = self._wanted_engine == "exact"
        if self._wanted_engine == "auto":
            exact = self._prefers_exact(context.getPlatform().getName())
        self._engine = Engine(self, context) if exact else self._native_engine(context)
        self._tell_program()

    def _prefers_exact(self, platform: str) -> bool:
        """Whether `engine="auto"` takes the exact engine on a platform."""
        return platform in EXACT_PLATFORMS

    def _native_engine(self, context: openmm.Context) -> NativeEngine:
        return NativeEngine(self, context)

    def _leave_other_engine(self, context: openmm.Context) -> None:
        """Take over what a loaded State or checkpoint holds, whichever engine wrote it.

        The program counts heat for each degree of freedom. Its sum is added to the total that both engines use.
        """
        work = np.array(self.getPerDofVariableByName(WORK))
        if work.any():
            self.setGlobalVariableByName(HEAT, self.getGlobalVariableByName(HEAT) + float(work.sum()))
            self.setPerDofVariableByName(WORK, np.zeros(work.shape))

    def _bound(self) -> Engine | NativeEngine:
        if self._engine is None:
            raise openmm.OpenMMException("This integrator is not bound to a Context: create one with it first")
        return self._engine

    def _plan_bodies(self, system: openmm.System) -> BodyPlan | KnownBodies:
        return plan_bodies(system, self._given_bodies)

    def _write_record(self, state: BodyState) -> None:
        """Store what a state holds besides its phase point in variables; `host.Host` has all that the engine calls."""
        self.setGlobalVariableByName(HEAT, state.heat)
        self.setGlobalVariableByName(DRAWS, state.draws)

    def _read_record(self, state: BodyState, known: BodyState | None, disturbed: bool) -> BodyState:
        heat, draws = map(self.getGlobalVariableByName, (HEAT, DRAWS))
        return replace(state, heat=heat, draws=int(draws))

    def _clear_record(self) -> None:
        for name in self._RECORD:
            self.setGlobalVariableByName(name, 0)

    #: Global variables for what a state holds besides its phase point.
    _RECORD: tuple[str, ...] = (HEAT, DRAWS)

    def _potential_changed(self) -> None:
        """Respond to a change of forces on bodies, or of the box, from outside."""

    def _active_scheme(self) -> Scheme:
        """The scheme to execute now."""
        return self._scheme

    def _stepper(self, engine: Engine, scheme: Scheme, operators: Mapping[str, Operator], h: float) -> Stepper:
        """The function that makes a step of length h, ps."""
        return stepper(scheme, operators, h)

    def _moves_volume(self, state: BodyState, steps: int) -> bool:
        """Whether to move the volume at a state, before the step that follows `steps` completed ones."""
        return self._piston is not None and (steps + 1) % self._piston.interval == 0

    def _extra_operators(self, bodies: RigidBodies) -> dict[str, Operator]:
        """Operators other than kick and drift."""
        return {}

    #: Looks for temperatures that have run away; set with the engine.
    _watch: RunawayWatch

    #: The Monte Carlo move of the volume between steps; None keeps the volume.
    _piston: MonteCarloVolumeMove | None = None


def revived(integrator: openmm.Integrator) -> openmm.Integrator:
    """Turn a plain CustomIntegrator read from XML back into the SIER integrator it was; return others unchanged.

    Raises:
        openmm.OpenMMException: its class or free-rotation map cannot be imported, or another version wrote the XML.
    """
    if type(integrator) is openmm.CustomIntegrator and (found := stored_settings.stored(integrator, "class")):
        cls = stored_settings.from_place(found[0], "class")
        if not (isinstance(cls, type) and issubclass(cls, SIERIntegrator)):
            raise openmm.OpenMMException(f"{found[0]} is no class of SIER integrators")
        integrator.__class__ = cls
        integrator._take_settings()
    return integrator


def _plain_clone(integrator: SIERIntegrator) -> openmm.CustomIntegrator:
    return inspect.unwrap(openmm.XmlSerializer._cloneIntegrator)(integrator)


def _restored(plain: openmm.CustomIntegrator, cls: type[SIERIntegrator], attributes: dict[str, Any]) -> SIERIntegrator:
    """Turn a plain CustomIntegrator back into one of ours, with the attributes that XML does not hold in full."""
    plain.__class__ = cls
    plain._take_settings(attributes["_rotation"])
    plain._given_bodies = attributes["_given_bodies"]
    for name in attributes.keys() - vars(plain).keys():
        setattr(plain, name, copy.deepcopy(attributes[name]))
    return plain


def _unpickled(xml: str, cls: type[SIERIntegrator], attributes: dict[str, Any]) -> SIERIntegrator:
    return _restored(inspect.unwrap(openmm.XmlSerializer._deserializeIntegrator)(xml), cls, attributes)


def _written(scheme: Scheme, substeps: int | None, fast_groups: int) -> Program | str:
    """The program of a scheme, or the reason why it has none."""
    try:
        return native_program.write(scheme, substeps, groups_of(fast_groups))
    except ValueError as error:
        return str(error)
