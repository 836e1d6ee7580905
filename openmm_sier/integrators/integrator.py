"""The integrators that OpenMM users call."""

from __future__ import annotations

import secrets
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import BodyState, RigidBodies
from openmm_sier.dynamics.operators import Rotation
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.schemes import BATH, SIER4G, Scheme
from openmm_sier.engines import interrupts
from openmm_sier.engines.choice import engine_for
from openmm_sier.engines.native import installation
from openmm_sier.engines.native import program as native_program
from openmm_sier.engines.native.engine import TOLERANCE
from openmm_sier.engines.native.program import VECTORS, WORK, Program
from openmm_sier.engines.native.refusals import why_not
from openmm_sier.engines.protocol import Engine, Flow
from openmm_sier.engines.temperature import Temperatures
from openmm_sier.engines.variables import DRAWS, HEAT, PART, SEED, SITES, STATE_VARIABLES, Record
from openmm_sier.ensembles.ensemble import ConstantEnergy, Ensemble
from openmm_sier.integrators import settings
from openmm_sier.integrators.settings import Settings
from openmm_sier.prepare.fast_forces import find_fast_groups
from openmm_sier.prepare.pme import tell_of_pme
from openmm_sier.system import checks
from openmm_sier.system.arguments import (
    Bodies,
    checked_bodies,
    checked_scheme,
    group_mask,
    groups_of,
    step_size,
    whole_number,
)
from openmm_sier.system.runaway import RunawayWatch
from openmm_sier.system.unchanged import UnchangedSystem


class SIERIntegrator(openmm.CustomIntegrator):
    """Integrator for rigid bodies by splitting schemes, with the exact solution of free rotation.

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
        scheme: Scheme | str = SIER4G,
        bodies: Bodies = None,
        rotation: Rotation = exact,
        engine: str = "auto",
        substeps: int | None = None,
        fastForceGroups: Iterable[int] | int | None = None,
        ensemble: Ensemble | None = None,
    ):
        """
        Args:
            stepSize: step, a time quantity or a number in ps.
            scheme: splitting scheme, see `openmm_sier.dynamics.schemes`, or its name, such as "SIER4G".
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
                of molecules that are not rigid. None: those of a System that `prepare_system` prepared, which are found
                when the Context is created, and none in other Systems. The exact engine computes them in a separate
                Context of those molecules alone.
            ensemble: what happens between steps of the scheme, see `openmm_sier.ensembles`; None: constant energy.

        Raises:
            ValueError: the step is negative or not finite, scheme or engine are unknown, `substeps` is below 1, or a
                force group is not from 0 to 31. A step of 0 is allowed, for Contexts that only evaluate forces: steps
                are counted and nothing moves.
            TypeError: the step is not a time, `scheme` is neither a Scheme nor a name, or `bodies` or `fastForceGroups`
                have the wrong type.
        """
        given = Settings(
            kind=settings.place_of(type(self)),
            scheme=checked_scheme(scheme),
            step=step_size(stepSize),
            engine=engine,
            substeps=None if substeps is None else whole_number("substeps", substeps),
            fast_groups=group_mask("fastForceGroups", fastForceGroups),
            finds_fast_groups=fastForceGroups is None,
            bodies=checked_bodies(bodies),
            rotation=rotation,
            ensemble=ensemble or ConstantEnergy(),
        )
        super().__init__(given.step)
        for name in (*STATE_VARIABLES, SITES):
            self.addPerDofVariable(name, 0)
        for name in (HEAT, DRAWS, SEED, *given.ensemble.record):
            self.addGlobalVariable(name, 0)
        self._use(given)
        installation.install(self._program, self)
        self.setConstraintTolerance(TOLERANCE)
        self._store()

    def _use(self, given: Settings) -> None:
        """Take settings for an integrator that is bound to no Context."""
        self._settings = given
        self._program = _written(given)
        self._engine: Engine | None = None
        self._system: UnchangedSystem | None = None
        self._record = Record(self, given.ensemble.record)
        self._told_of_noise = False
        self._watch: RunawayWatch

    def _change(self, **changes: Any) -> None:
        """Replace settings, here and in what OpenMM serializes."""
        self._settings = replace(self._settings, **changes)
        self._store()

    def _store(self) -> None:
        super().setStepSize(self._settings.step / self._native_steps)
        settings.store(self, self._settings)
        self._set_program_variables()

    @property
    def _ensemble(self) -> Any:
        return self._settings.ensemble

    @property
    def _native_steps(self) -> int:
        """Number of OpenMM steps in one step of the scheme."""
        return len(self._program.parts) or 1

    def _flow(self) -> Flow:
        """What an engine is to follow now; a loaded checkpoint brings the seed of its run."""
        given, ensemble = self._settings, self._settings.ensemble
        return Flow(
            scheme=ensemble.executed(given.scheme),
            step=given.step,
            rotation=given.rotation,
            substeps=given.substeps,
            fast_groups=given.fast_groups,
            bath=ensemble.bath(int(self.getGlobalVariableByName(SEED))),
            constant_energy=ensemble.constant_energy,
            updates_context=ensemble.updates_context,
        )

    def _set_program_variables(self) -> None:
        """Set the program's variables to the values that they must have, whatever was loaded."""
        flow = self._flow()
        less = self._ensemble.needs_package or self._settings.bodies is not None
        installation.set_variables(self, flow.bath, less or why_not(flow, self._program) is not None)

    # --- what users ask ---

    @property
    def engine(self) -> str:
        """The engine in use; before a Context is created, the one that was requested."""
        return self._settings.engine if self._engine is None else self._engine.name

    @property
    def substeps(self) -> int | None:
        """Number of steps into which a drift is divided, as requested; None leaves it to the engine."""
        return self._settings.substeps

    @property
    def fastForceGroups(self) -> set[int]:
        """The force groups that act within drifts."""
        return set(groups_of(self._settings.fast_groups))

    @property
    def program(self) -> Program:
        """The program that the native engine executes; it can be printed.

        Raises:
            ValueError: the scheme has an operator that cannot be written out.
        """
        if self._program.refusal:
            raise ValueError(self._program.refusal)
        return self._program

    @property
    def scheme(self) -> Scheme:
        """The splitting scheme."""
        return self._settings.scheme

    @property
    def rotation(self) -> Rotation:
        """The free-rotation map."""
        return self._settings.rotation

    @property
    def bodies(self) -> RigidBodies:
        """The rigid bodies of the Context that this integrator is bound to."""
        return self._bound().bodies

    @property
    def forceEvaluations(self) -> int:
        """Number of force evaluations done by this integrator since its Context was created."""
        return self._bound().evaluations

    @property
    def conservesMomentum(self) -> bool:
        """Whether the total momentum is conserved, so that three degrees of freedom hold no heat.

        See `openmm_sier.engines.temperature.MomentumConservation`.
        """
        return self._bound().conserves_momentum()

    def getStepSize(self) -> unit.Quantity:
        """Time by which `step(1)` advances the Context, a quantity in ps. OpenMM's own step may be a fraction of it."""
        return self._settings.step * self._ensemble.steps * unit.picosecond

    def setStepSize(self, size: Any) -> None:
        """Set the time by which `step(1)` advances the Context, a time quantity or a number in ps."""
        self._change(step=step_size(size) / self._ensemble.steps)

    def getBodyState(self) -> BodyState:
        """The state of the rigid bodies, brought up to date with the Context.

        Raises:
            RigidityError: the Context's positions do not form the bodies.
        """
        return self._bound().state()

    def step(self, steps: int) -> None:
        """Advance by a number of steps.

        An interrupt leaves the Context at the last completed step. With the exact engine an error does the same. With
        the native engine an error leaves the Context where it happened, as with OpenMM's integrators.

        Raises:
            ValueError: `steps` is negative or not a whole number.
            RigidityError: positions set from outside do not form the bodies.
            openmm.OpenMMException: there is no Context, its System was changed, a force is not finite, or the step is
                too long for a bond.
        """
        count = whole_number("steps", steps)
        context = self._bound()._context
        if self._system is not None:
            self._system.check(context.getSystem())
        self._watch.over(self._advance, count, self, context)

    def _advance(self, count: int) -> None:
        engine = self._bound()
        with interrupts.deferred():
            self._record.restore()
            flow = self._flow()
            try:
                with engine.following(flow):
                    self._ensemble.advance(engine, flow, self._record, count)
            finally:
                self._record.keep()

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
        self._bound().forces_changed()

    def setIntegrationForceGroups(self, groups: Iterable[int] | int) -> None:
        """Set the force groups that move the bodies, as a set or a bit mask; they take effect with the next step."""
        super().setIntegrationForceGroups(groups)
        if self._engine is not None:
            self._engine.groups_changed()

    # --- copies ---

    def __copy__(self) -> SIERIntegrator:
        """An integrator with the same settings and variables, bound to no Context."""
        make, arguments = self.__reduce__()
        return make(*arguments)

    def __deepcopy__(self, memo: dict[int, Any]) -> SIERIntegrator:
        return self.__copy__()

    def __reduce__(self) -> tuple[Any, ...]:
        bound = "this", "_engine", "_system", "_record", "_watch"
        attributes = {name: value for name, value in vars(self).items() if name not in bound}
        return settings.unpickled, (openmm.XmlSerializer.serialize(self), type(self), attributes)

    # --- for the hooks ---

    def _prepare_for(self, system: openmm.System) -> None:
        """Before a Context is created, find the fast forces, and clear what a copy holds of its original's Context."""
        checks.refuse_drude_particles(system)
        self._find_fast_forces(system)
        if self.scheme.without(BATH).order >= 4:
            tell_of_pme(system, self.scheme.name)
        self._record.clear()
        for name in (SEED, PART):
            self.setGlobalVariableByName(name, 0)
        for name in (*STATE_VARIABLES, SITES, *VECTORS):
            # OpenMM does not check that the number of values fits the System.
            if len(self.getPerDofVariableByName(name)) > 1:
                self.setPerDofVariableByName(name, np.zeros((system.getNumParticles(), 3)))

    def _find_fast_forces(self, system: openmm.System) -> None:
        # An integrator that has a Context already is refused by OpenMM, and must stay that Context's own.
        given = self._settings
        if self._system is not None or not given.finds_fast_groups:
            return
        groups = find_fast_groups(system, given.bodies, says=True)
        if groups == given.fast_groups:
            return
        self._settings = replace(self._settings, fast_groups=groups)
        self._program = _written(self._settings)
        installation.rewrite(self, self._program)
        self._store()

    def _bind(self, context: openmm.Context) -> None:
        checks.tell_of_frozen_atoms_that_move(context.getSystem())
        self._watch = RunawayWatch(context.getSystem())
        # If the System is refused when a Context is reinitialized, the old System's bodies must not remain.
        self._engine, self._system = None, UnchangedSystem(context.getSystem())
        given = self._settings
        if given.finds_fast_groups and find_fast_groups(context.getSystem(), given.bodies) != given.fast_groups:
            raise openmm.OpenMMException(
                "The System was prepared after the integrator was given to its Context: create a new Context"
            )
        engine = engine_for(given.engine, context, self._flow(), given.bodies, self._program)
        self._ensemble.check(context.getSystem(), engine)
        self._engine = engine
        # A Context that was reinitialized with its state keeps its seed.
        if self._ensemble.is_random and self.getGlobalVariableByName(SEED) == 0:
            seed = self.getRandomNumberSeed() or secrets.randbelow(2**31 - 1) + 1
            self.setGlobalVariableByName(SEED, seed)
        self._set_program_variables()
        self._record.keep()

    def _take_over(self) -> None:
        """Take over what a loaded State or checkpoint holds, whichever engine wrote it.

        The program counts heat for each degree of freedom. Its sum is added to the total that both engines use.
        """
        work = np.array(self.getPerDofVariableByName(WORK))
        if work.any():
            self.setGlobalVariableByName(HEAT, self.getGlobalVariableByName(HEAT) + float(work.sum()))
            self.setPerDofVariableByName(WORK, np.zeros(work.shape))
        self._set_program_variables()
        if self._engine is not None:
            self._watch.forget()
            self._engine.atoms_moved()

    def _bound(self) -> Engine:
        if self._engine is None:
            raise openmm.OpenMMException("This integrator is not bound to a Context: create one with it first")
        return self._engine


def _written(given: Settings) -> Program:
    groups, updates = groups_of(given.fast_groups), given.ensemble.updates_context
    try:
        return native_program.write(given.scheme, given.substeps, groups, updates_context=updates)
    except ValueError as error:
        return Program(given.scheme.name, (), str(error))
