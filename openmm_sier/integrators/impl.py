"""The Python part of an integrator: its settings, and its program and engine for a Context."""

import secrets
import weakref
from dataclasses import replace
from typing import Any

import openmm

from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.tally import Tally
from openmm_sier.engines.choice import make_engine, usual_platform
from openmm_sier.engines.compiled.engine import KernelsEngine
from openmm_sier.engines.compiled.installation import InstalledStep, installed
from openmm_sier.engines.native import installation
from openmm_sier.engines.native.engine import TOLERANCE
from openmm_sier.engines.native.program import general_program, program_for
from openmm_sier.engines.native.refusals import needs_finite_positions
from openmm_sier.engines.program import Program
from openmm_sier.engines.protocol import Engine
from openmm_sier.engines.session import Rules, Session
from openmm_sier.engines.snapshot import is_on_host
from openmm_sier.engines.variables import names_of, report_hidden_kinetic_energy, write_tally
from openmm_sier.integrators import settings
from openmm_sier.prepare.fast_forces import find_fast_groups, refuse_other_bodies
from openmm_sier.prepare.pme import warn_about_pme
from openmm_sier.system import checks
from openmm_sier.system.arguments import ForceGroups, group_mask


class IntegratorImpl:
    """The Python part of a SIER integrator, through its whole life.

    A new integrator has its variables and settings, and no computations yet. `prepare` writes the program before a
    Context is created, and `bind` makes the engine after that, and again when the Context is reinitialized. `change`
    replaces settings at any time. `session` makes steps, and hears of all changes; `storage` writes and reads what
    checkpoints, States and XML carry.

    Attributes:
        settings: the arguments of the integrator.
        session: its steps, and the engine that makes them.
        program: the program of the native engine: a general one, and from `prepare` on that which OpenMM executes.
        tally: heat, random numbers and counts, which variables carry in checkpoints.
        has_warned_of_noise: whether a warning was given that a State has no noise.
    """

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
        self.session = Session(self._rules(integrator_settings))
        self.program = self.general_program()
        self._computations = integrator.getNumComputations()
        #: The step of the kernels engine for the next Context; None without one.
        self._installed: InstalledStep | None = None
        self.tally = Tally(counts=integrator_settings.ensemble.counts)
        self.has_warned_of_noise = False

    @property
    def integrator(self) -> openmm.CustomIntegrator:
        """Return the integrator."""
        return self._integrator_ref()

    @property
    def engine(self) -> Engine:
        """Return the engine, see `Session.engine`."""
        return self.session.engine

    @property
    def engine_name(self) -> str:
        """Return the name of the engine or, without a Context, what was requested."""
        engine = self.session.engine_or_none
        return self.settings.engine if engine is None else engine.name

    @property
    def ensemble(self) -> Any:
        """Return the ensemble of the settings."""
        return self.settings.ensemble

    # --- settings, here and in what OpenMM serializes ---

    def declare(self) -> None:
        """Give a new integrator its variables and its settings."""
        integrator = self.integrator
        for name in names_of(self.tally):
            integrator.addGlobalVariable(name, 0)
        installation.declare(integrator, bool(self.method().trial_steps))
        integrator.setConstraintTolerance(TOLERANCE)
        self.change()

    def change(self, **changes: Any) -> None:
        """Replace settings, by the names of their fields.

        Raises:
            ValueError, TypeError: the constructor would refuse them too.
            openmm.OpenMMException: the engine of the Context cannot follow them. Nothing has been changed then.
        """
        changed = replace(self.settings, **changes)
        rules, engine = self._rules(changed), self.session.engine_or_none
        if engine is not None:
            engine.accept(rules.method)
        self.settings = changed
        self.session.rules = rules
        integrator = self.integrator
        openmm.CustomIntegrator.setStepSize(integrator, changed.step / self.native_steps)
        settings.store(integrator, changed)
        self.set_program_variables()

    def set_groups(self, groups: ForceGroups) -> None:
        """Set the integration force groups.

        Raises:
            ValueError: a group is not from 0 to 31.
            TypeError: `groups` is neither a set of numbers nor a mask.
            openmm.OpenMMException: the engine of the Context cannot follow them. Nothing has been changed then.
        """
        # getIntegrationForceGroups returns a mask with group 31 as a negative number.
        if isinstance(groups, int) and -(2**31) <= groups < 0:
            groups += 2**32
        mask = group_mask("groups", groups)
        engine = self.session.engine_or_none
        if engine is not None:
            engine.accept(self.method(), mask)
        openmm.CustomIntegrator.setIntegrationForceGroups(self.integrator, mask)
        if engine is not None:
            engine.select_groups()

    def refuse_long_step(self) -> None:
        """Refuse a step that is too long, before a start is made for it; motions that are measured there are left out.

        Raises:
            openmm.OpenMMException: the step is too long.
        """
        self.engine.step_check(self.method(), self.integrator.getIntegrationForceGroups())

    @property
    def native_steps(self) -> int:
        """Return the number of OpenMM steps in one step of the scheme."""
        if not self._computations:
            return 1
        return self.program.native_steps or 1

    def _rules(self, given: settings.Settings) -> Rules:
        """Return what steps with settings follow."""
        ensemble = given.ensemble
        method = given.method(self._prepared_groups)
        return Rules(method, ensemble.advancer, given.step * ensemble.steps, getattr(ensemble, "temperature", 0.0))

    def method(self) -> IntegrationMethod:
        """Return the method of the present settings, the same object until they change."""
        return self.session.rules.method

    def _whole_method(self) -> IntegrationMethod:
        """Return the method with the bath of its scheme, which a friction that is set later needs."""
        return replace(self.method(), scheme=self.settings.scheme)

    def general_program(self) -> Program:
        """Return a program that is right in any System."""
        return general_program(self._whole_method())

    def set_program_variables(self) -> None:
        """Set the program's variables to the values that they must have, whatever was loaded."""
        installation.set_variables(self.integrator, self.native_steps, self.method().bath)
        self.session.changed()

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
        if self.session.context is not None:
            return
        if self.session.had_context:
            raise openmm.OpenMMException(
                "The Context of this integrator no longer exists, or was refused, and OpenMM deletes an integrator "
                "with its Context: make a new integrator"
            )
        checks.refuse_drude_particles(system)
        checks.refuse_impossible_masses(system)
        checks.refuse_sites_without_place(system)
        installation.refuse_additions(self.integrator, self._computations)
        refuse_other_bodies(system, self.settings.bodies)
        if self.settings.fast_groups is None:
            self._prepared_groups = find_fast_groups(system, self.settings.bodies)
            self.session.rules = self._rules(self.settings)
        self._write_program(system, platform)
        if self.settings.scheme.without_bath().order >= 4:
            warn_about_pme(system, self.settings.scheme.name)
        self.tally.clear()
        self.tally.seed = 0
        write_tally(self.integrator, self.tally)

    @property
    def has_hidden_kinetic_energy(self) -> bool:
        """Return whether velocities of atoms do not carry all of the kinetic energy of the bodies."""
        bodies = self.settings.bodies
        return bodies is not None and bodies.has_other_moments

    def _write_program(self, system: openmm.System, platform: openmm.Platform | None) -> None:
        """Give the integrator the program that costs least in a System on a platform."""
        integrator, requested = self.integrator, self.settings.engine
        # There is one already where a Context could not be created.
        self._forget_compiled_step()
        installation.uninstall(integrator)
        platform = platform or usual_platform()
        on_gpu = not is_on_host(platform)
        groups = integrator.getIntegrationForceGroups()
        checks_positions = requested == "native" and needs_finite_positions(system, platform)
        method = self._whole_method()
        if (not on_gpu and requested != "native") or requested == "exact":
            # The exact engine decides on trials in Python.
            method = replace(method, trial_steps=0)
        self.program = program_for(method, system, self.settings.bodies, groups, on_gpu, checks_positions)
        # What the exact engine stores makes the kernels of GPUs slower.
        is_lean = on_gpu and requested != "exact"
        vectors = self.program.vectors if is_lean else installation.all_vectors(self._whole_method())
        installation.install(self.program, integrator, vectors)
        self._computations = integrator.getNumComputations()
        if self.has_hidden_kinetic_energy:
            report_hidden_kinetic_energy(integrator)
        self._installed = self._compiled_step(system, platform)
        self.change()

    def _compiled_step(self, system: openmm.System, platform: openmm.Platform) -> InstalledStep | None:
        """Give the integrator a step of the kernels engine for a System, and return it; None without one."""
        requested = self.settings.engine
        if requested != KernelsEngine.name and (requested != "auto" or is_on_host(platform)):
            return None
        is_asked_for = requested != "auto"
        bodies = self.settings.bodies
        return installed(is_asked_for, self._whole_method(), system, bodies, self.integrator, platform)

    def _forget_compiled_step(self) -> None:
        """Take the step of the kernels engine back."""
        if self._installed is not None:
            self._installed.take_back()
            self._installed = None

    def renew_compiled_step(self, context: openmm.Context) -> None:
        """Write the step of the kernels engine for a Context that is about to be reinitialized, if that has one.

        Raises:
            openmm.OpenMMException: kernels cannot move the System any more, and were asked for.
        """
        if self._installed is None:
            return
        renewed = self._compiled_step(context.getSystem(), context.getPlatform())
        self._forget_compiled_step()
        self._installed = renewed

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
        tally = self.tally
        if not keeps_tally:
            tally.clear()
        system = context.getSystem()
        self.session.bind(context)
        bodies, requested = self.settings.bodies, self.settings.engine
        engine = make_engine(requested, context, self.method(), tally, bodies, self.program, self._installed)
        if engine.name != KernelsEngine.name:
            self._forget_compiled_step()
        self.ensemble.check(system, engine)
        self.session.take(engine, system)
        # A Context that was reinitialized with its state keeps its seed.
        if self.ensemble.is_random and not tally.seed:
            tally.seed = self.integrator.getRandomNumberSeed() or secrets.randbelow(2**31 - 1) + 1
        self.set_program_variables()
