"""The Python part of an integrator: settings and program and, with a Context, an engine and watches."""

import secrets
import weakref
from collections.abc import Callable
from dataclasses import replace
from threading import RLock
from typing import Any

import numpy as np
import openmm

from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.stages import BATH
from openmm_sier.dynamics.tally import Tally
from openmm_sier.engines import interrupts
from openmm_sier.engines.choice import is_on_host, make_engine, usual_platform
from openmm_sier.engines.native import installation
from openmm_sier.engines.native.engine import TOLERANCE
from openmm_sier.engines.native.refusals import why_not
from openmm_sier.engines.native.writing import general_program, needs_finite_positions, program_for
from openmm_sier.engines.program import WORK, Program
from openmm_sier.engines.protocol import Changes, Engine
from openmm_sier.engines.variables import StoredTally
from openmm_sier.ensembles.ensemble import Runner
from openmm_sier.integrators import settings
from openmm_sier.prepare.fast_forces import find_fast_groups, refuse_other_bodies
from openmm_sier.prepare.pme import warn_about_pme
from openmm_sier.stability.runaway import RunawayWatch
from openmm_sier.system import checks
from openmm_sier.system.user_warnings import warn


class IntegratorImpl:
    """The Python part of a SIER integrator, through its whole life.

    A new integrator has its variables and settings, and no computations yet. `prepare` writes the program before a
    Context is created, and `bind` makes the engine after that, and again when the Context is reinitialized. `step`
    advances it. `SIERContext` and `hooks` record by `changed` what users change in the Context: a call of `step` reads
    and checks nothing unless there was such a change since the last one. `store` writes the variables that checkpoints,
    States and XML carry. `change` replaces settings at any time.

    Attributes:
        settings: the arguments of the integrator.
        program: the program of the native engine: a general one, and from `prepare` on that which OpenMM executes.
        stored: heat, random numbers and counts, in variables that checkpoints carry.
        watch: stops runs that have become too hot; there is none before `bind`.
    """

    watch: RunawayWatch

    def __init__(self, integrator: openmm.CustomIntegrator, integrator_settings: settings.Settings):
        """
        Args:
            integrator: openmm.CustomIntegrator that is bound to no Context. It holds this, which refers to it weakly.
            integrator_settings: its settings.
        """
        self._integrator_ref = weakref.ref(integrator)
        self.settings = integrator_settings
        #: The fast force groups of a prepared System, a bit mask.
        self._prepared_groups = 0
        #: Whether trials need virtual sites placed within them, which OpenMM alone does not do on every platform.
        self._needs_sites = False
        self._method: IntegrationMethod | None = None
        self.program = self.general_program()
        self._computations = integrator.getNumComputations()
        self.stored = StoredTally(integrator, Tally(counts=integrator_settings.ensemble.counts))
        self._engine: Engine | None = None
        #: Makes a number of steps, by the rules of the ensemble.
        self._run: Runner = lambda steps: None
        self._context: Callable[[], openmm.Context | None] = lambda: None
        self._stepping = RLock()
        self._has_warned_of_noise = False
        #: The temperature of the bath with which those of the System's Forces were compared last, K.
        self._compared_temperature = 0.0
        self._has_warned_of_temperatures = False

    @property
    def _integrator(self) -> openmm.CustomIntegrator:
        return self._integrator_ref()

    @property
    def engine(self) -> Engine:
        """Return the engine.

        Raises:
            openmm.OpenMMException: there is no Context, or no longer.
        """
        if self._engine is None or self._context() is None:
            raise self._no_context()
        return self._engine

    def _no_context(self) -> openmm.OpenMMException:
        """Return the error of a call that needs a Context."""
        if self._engine is None:
            message = "This integrator has no Context: create a Context or Simulation with it first"
        else:
            message = "The Context of this integrator no longer exists"
        return openmm.OpenMMException(message)

    @property
    def engine_name(self) -> str:
        """Return the name of the engine or, without a Context, what was requested."""
        return self.settings.engine if self._engine is None else self._engine.name

    @property
    def ensemble(self) -> Any:
        """Return the ensemble of the settings."""
        return self.settings.ensemble

    # --- settings, here and in what OpenMM serializes ---

    def declare(self) -> None:
        """Give a new integrator its variables and its settings."""
        integrator = self._integrator
        for name in self.stored.names:
            integrator.addGlobalVariable(name, 0)
        installation.declare(integrator, bool(self.method().trial_steps))
        integrator.setConstraintTolerance(TOLERANCE)
        self.change()

    def change(self, **changes: Any) -> None:
        """Replace settings, by the names of their fields."""
        self.settings = replace(self.settings, **changes)
        self._method = None
        #: The length of a step of the integrator, ps, and the temperature of the ensemble, K; 0 without one.
        self._duration = self.settings.step * self.ensemble.steps
        self._temperature = getattr(self.ensemble, "temperature", 0.0)
        integrator = self._integrator
        openmm.CustomIntegrator.setStepSize(integrator, self.settings.step / self.native_steps)
        settings.store(integrator, self.settings)
        self._set_program_variables()

    @property
    def native_steps(self) -> float:
        """Return the number of OpenMM steps in one step of the scheme."""
        return self.program.native_steps or 1 if self._computations else 1

    def method(self) -> IntegrationMethod:
        """Return the method of the present settings, the same object until they change."""
        if self._method is None:
            self._method = self.settings.method(self._prepared_groups)
        return self._method

    def _whole_method(self) -> IntegrationMethod:
        """Return the method with the bath of its scheme, which a friction that is set later needs."""
        return replace(self.method(), scheme=self.settings.scheme)

    def general_program(self) -> Program:
        """Return a program that is right in any System."""
        return general_program(self._whole_method())

    def _set_program_variables(self) -> None:
        """Set the program's variables to the values that they must have, whatever was loaded."""
        method = self.method()
        does_less = self.ensemble.needs_package or self.settings.bodies is not None or self._needs_sites
        # A State that was written on another platform may have those of another program.
        self._integrator.setGlobalVariableByName(installation.PARTS, self.native_steps)
        installation.set_bath(self._integrator, method.bath)
        installation.set_trial(self._integrator, self.ensemble.trial(method))
        installation.guard(self._integrator, does_less or why_not(method, self.program) is not None)
        self.changed()

    def store(self) -> None:
        """Write all that checkpoints, States and XML carry to the variables of the integrator."""
        self.stored.write()
        self._set_program_variables()
        if self._engine is not None:
            self._engine.store()

    # --- a Context ---

    def prepare(self, system: openmm.System, platform: openmm.Platform | None = None) -> None:
        """Write the program for the System of a new Context, and clear what a copy holds of another Context.

        Args:
            system: openmm.System.
            platform: that of the Context; None leaves it to OpenMM.

        Raises:
            openmm.OpenMMException: the System has Drude particles, masses or constraints that are impossible, or force
                groups that were changed after its preparation; the integrator was given computations, or its Context
                is gone.
            RigidityError: the System was prepared for other bodies.
        """
        # OpenMM refuses an integrator that has a Context already, and it must stay that Context's own.
        if self._context() is not None:
            return
        if isinstance(self._context, weakref.ref):
            raise openmm.OpenMMException(
                "The Context of this integrator no longer exists, or was refused, and OpenMM deletes an integrator "
                "with its Context: make a new integrator"
            )
        checks.refuse_drude_particles(system)
        checks.refuse_impossible_masses(system)
        checks.refuse_sites_without_place(system)
        installation.refuse_additions(self._integrator, self._computations)
        refuse_other_bodies(system, self.settings.bodies)
        if self.settings.fast_groups is None:
            self._prepared_groups = find_fast_groups(system, self.settings.bodies)
            self._method = None
        has_sites = any(map(system.isVirtualSite, range(system.getNumParticles())))
        self._needs_sites = has_sites and bool(self.method().trial_steps)
        self._write_program(system, platform)
        if self.settings.scheme.without_bath().order >= 4:
            warn_about_pme(system, self.settings.scheme.name)
        self.stored.tally.clear()
        self.stored.tally.seed = 0
        self.stored.write()

    def _write_program(self, system: openmm.System, platform: openmm.Platform | None) -> None:
        """Give the integrator the program that costs least in a System on a platform."""
        integrator, requested = self._integrator, self.settings.engine
        # There is one already where a Context could not be created.
        installation.uninstall(integrator)
        platform = platform or usual_platform()
        on_gpu = not is_on_host(platform)
        groups = integrator.getIntegrationForceGroups()
        checks_positions = requested == "native" and needs_finite_positions(system, platform)
        method = self._whole_method()
        if (not on_gpu and requested != "native") or requested == "exact":
            # The exact engine decides on trials in Python.
            method = replace(method, trial_steps=0)
        self.program = program_for(method, system, groups, on_gpu, checks_positions)
        # What the exact engine stores makes the kernels of GPUs slower.
        is_lean = on_gpu and requested != "exact"
        vectors = self.program.vectors if is_lean else installation.all_vectors(self._whole_method())
        installation.install(self.program, integrator, vectors)
        self._computations = integrator.getNumComputations()
        self.change()

    def bind(self, context: openmm.Context, keeps_tally: bool = True) -> None:
        """Choose and make the engine of a Context that was created or reinitialized with the integrator.

        Args:
            context: openmm.Context, which the integrator belongs to.
            keeps_tally: whether heat, draws and what the ensemble counts go on. OpenMM clears the per-atom variables
                of a Context that is reinitialized without its state, but not the global ones.

        Raises:
            RigidityError, openmm.OpenMMException: the System is refused, as the message says. There is no
                engine then: if a Context is reinitialized, the old System's bodies must not remain.
        """
        tally = self.stored.tally
        if not keeps_tally:
            tally.clear()
        system = context.getSystem()
        self._engine = None
        self._context = weakref.ref(context)
        self._compared_temperature = 0.0
        self._has_warned_of_temperatures = False
        self.watch = RunawayWatch(system)
        bodies, requested = self.settings.bodies, self.settings.engine
        engine = make_engine(requested, context, self.method(), tally, bodies, self.program)
        self.ensemble.check(system, engine)
        self._engine = engine
        # A Context that was reinitialized with its state keeps its seed.
        if self.ensemble.is_random and not tally.seed:
            tally.seed = self._integrator.getRandomNumberSeed() or secrets.randbelow(2**31 - 1) + 1
        self._set_program_variables()

    # --- steps ---

    def step(self, steps: int) -> None:
        """Advance by steps of the integrator; see `SIERIntegrator.step`.

        One thread makes steps, while signals wait for the end of a step. The engine is up to date with the Context
        first, and after an error it recovers.

        Raises:
            openmm.OpenMMException: another thread is stepping the Context.
        """
        engine, context = self._engine, self._context()
        if engine is None or context is None:
            raise self._no_context()
        # To wait would hang a process that was forked while another thread had the lock.
        if not self._stepping.acquire(blocking=False):
            raise openmm.OpenMMException(
                "Another thread is stepping this Context: give each thread a Context of its own"
            )
        handlers = None
        try:
            handlers = interrupts.defer()
            if engine.changes:
                self._begin(engine)
            try:
                self._run(steps)
                engine.publish()
            except BaseException:
                engine.changes |= Changes.SETTINGS
                engine.recover()
                raise
        finally:
            self._stepping.release()
            interrupts.release(handlers)
        watch = self.watch
        watch.steps += steps
        if watch.steps >= watch.pause:
            watch.look(context, self._duration, self._temperature)

    def _begin(self, engine: Engine) -> None:
        """Take over all changes since the last step.

        Raises:
            openmm.OpenMMException: no step can be made from there.
        """
        context = self._context()
        self._compare_temperatures(context, self._temperature)
        self.watch.begin(context)
        self._run = self.ensemble.runner(engine)
        engine.begin(self.method())

    def _compare_temperatures(self, context: openmm.Context, bath: float) -> None:
        """Warn, once, of a bath and a barostat of OpenMM at two temperatures, when steps are made with them."""
        if bath in (0.0, self._compared_temperature) or self._has_warned_of_temperatures:
            return
        self._compared_temperature = bath
        self._has_warned_of_temperatures = checks.warn_about_other_temperatures(context, bath)

    def refuse_long_step(self) -> None:
        """Refuse a step that is too long, before a start is made for it; motions that are measured there are left out.

        Raises:
            openmm.OpenMMException: the step is too long.
        """
        self.engine.step_check(self.method(), self._integrator.getIntegrationForceGroups())

    # --- changes by users ---

    def changed(self, change: Changes = Changes.SETTINGS) -> None:
        """Record a change of some kind, which the next step takes over."""
        if self._engine is None:
            return
        self._engine.changes |= change
        if Changes.ATOMS in change:
            self.watch.forget()

    def draw_velocities(self, by_openmm: Callable[[], None], temperature: Any, seed: int | None = None) -> None:
        """Draw velocities of a temperature; see `Actions.draw_velocities`."""
        if self._engine is None:
            by_openmm()
        else:
            self._engine.actions.draw_velocities(by_openmm, temperature, seed)
        self.changed(Changes.ATOMS)

    def minimize(self, by_openmm: Callable[[], None], tolerance: Any, iterations: int, reporter: Any) -> None:
        """Minimize the energy, see `Actions.minimize`."""
        self.engine.actions.minimize(by_openmm, tolerance, iterations, reporter)
        self.changed(Changes.ATOMS)

    def satisfy(self, by_openmm: Callable[[], None], velocities: bool) -> None:
        """Make positions, or velocities, satisfy the constraints; see `Actions`."""
        if self._engine is None:
            by_openmm()
        elif velocities:
            self._engine.actions.satisfy_velocities(by_openmm)
        else:
            self._engine.actions.satisfy_positions(by_openmm)
        self.changed(Changes.ATOMS)

    def groups_changed(self) -> None:
        """Take over other integration force groups."""
        if self._engine is not None:
            self._engine.select_groups()

    def take_over(self) -> None:
        """Take over a State or checkpoint that was loaded, of either engine.

        The program counts heat for each degree of freedom. Its sum is added to the total that both engines use.
        """
        self.stored.load()
        integrator = self._integrator
        if WORK in installation.vectors_of(integrator):
            work = np.array(integrator.getPerDofVariableByName(WORK))
            self.stored.tally.heat += float(work.sum())
            integrator.setPerDofVariableByName(WORK, np.zeros(work.shape))
        self._set_program_variables()
        self.changed(Changes.VARIABLES | Changes.ATOMS)

    def take_over_state(self, set_state: Callable[[], None], has_parameters: bool) -> None:
        """Call a function that sets a State, and take over what the State holds, except its seed and its used noise.

        Runs with different seeds from one State differ, and so do replicas that share a Context.

        Args:
            set_state: sets the State in the Context.
            has_parameters: whether the State has those of an integrator. Then it is said, once, where noise goes on
                differently than in the run that wrote the State.
        """
        tally = self.stored.tally
        seed, draws = tally.seed, tally.draws
        self.store()
        try:
            set_state()
        finally:
            # OpenMM sets a State in parts.
            self.changed(Changes.BOX | Changes.ATOMS)
        self.take_over()
        tally.seed = seed
        tally.draws = max(draws, tally.draws)
        engine = self._engine
        is_lost = has_parameters and engine is not None and not engine.repeats_noise
        has_noise = engine is not None and (engine.makes_trials or BATH in self.method().scheme.operators)
        if is_lost and has_noise and not self._has_warned_of_noise:
            self._has_warned_of_noise = True
            warn(
                "With the native engine a State does not hold the noise of Langevin dynamics and of trials, which is "
                "OpenMM's: the run continues in the same ensemble, but on another trajectory. To continue the same "
                "trajectory, load a checkpoint"
            )
