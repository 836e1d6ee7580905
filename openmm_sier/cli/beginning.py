"""Make the System of an input, its integrators, and Contexts for them."""

from typing import Any

import openmm
from openmm import unit

from openmm_sier.cli.console import note
from openmm_sier.cli.errors import Misused, RunError
from openmm_sier.cli.info import with_rigid_bodies
from openmm_sier.cli.platforms import check_platform
from openmm_sier.cli.settings import RunSettings
from openmm_sier.dynamics.schemes import SIER4G
from openmm_sier.ensembles import VelocityRescaling
from openmm_sier.inputs.equilibration import make_context
from openmm_sier.inputs.forcefields import describe
from openmm_sier.inputs.inputs import fingerprints, read_input
from openmm_sier.integrators.constant_temperature import SIERThermostatIntegrator
from openmm_sier.integrators.hmc import SIERHMCIntegrator
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.integrators.langevin import SIERLangevinIntegrator
from openmm_sier.observe.openmm_integrators import BAROSTAT_INTERVAL, make_integrator, seed_noise
from openmm_sier.prepare.preparation import prepare_system


class Simulated:
    """Hold an input and its System, which is prepared for long steps.

    Attributes:
        settings: of the run.
        box: with the System.
        bodies: its rigid bodies.
        fast: force groups that are fast.
        inputs: fingerprints of the files that were read.
    """

    def __init__(self, settings: RunSettings):
        """Read the files of the input, and prepare their System.

        Raises:
            Misused: OpenMM does not have the platform here.
            RunError: the run requires a periodic box, and the input has none.
            ForceFieldError, RigidityError, OSError: as their messages say.
        """
        check_platform(settings.platform)
        given = settings.topology, settings.forcefield, settings.constraints, settings.interactions, settings.edges
        box = read_input(settings.box, *given)
        hint = "" if box.system.usesPeriodicBoundaryConditions() else " (--edges gives a box)"
        note(f"{settings.box}: force field {' '.join(box.files)} ({box.reason}); {describe(box)}{hint}")
        self.settings = settings
        whole, bodies = with_rigid_bodies(box, settings.rigid)
        self.box = whole
        self.bodies = bodies
        prepared = prepare_system(box.system, self.bodies)
        self.fast = prepared.fastForceGroups
        if settings.rigid:
            for done in prepared.done:
                note(done)
        if settings.pressure_tensor and not box.system.usesPeriodicBoundaryConditions():
            raise RunError("--pressure-tensor requires a periodic box, and the input has none")
        self.inputs = fingerprints(box.sources)

    def context(self, step: int = 0) -> openmm.Context:
        """Return the Context of the run when it begins or goes on at a step, without positions.

        Raises:
            Misused: checkpoints are too frequent for OpenMM's barostat.
        """
        settings = self.settings
        if settings.method.scheme is not None:
            return self.context_of(self.integrator(settings))
        if settings.moves_volume and settings.interval(settings.checkpoint_every) < BAROSTAT_INTERVAL:
            raise Misused(
                f"--checkpoint-every {settings.checkpoint_every:g} is too short: OpenMM's barostat counts its "
                f"{BAROSTAT_INTERVAL} steps from zero after each checkpoint, and would never act. Give "
                f"{BAROSTAT_INTERVAL * settings.step_time:g} ps or more"
            )
        bath = settings.temperature if settings.ensemble != "nve" else None
        piston = settings.pressure if settings.moves_volume else None
        dt = settings.dt / 1000
        system, integrator = make_integrator(
            self.box.system,
            self.box.positions.value_in_unit(unit.nanometer),
            settings.scheme,
            dt,
            bath,
            settings.friction,
            piston,
        )
        seed_noise(system, integrator, settings.seed, step)
        context = make_context(system, integrator, settings.platform)
        integrator.bind(context, self.bodies)
        return context

    def context_of(self, integrator: SIERIntegrator) -> openmm.Context:
        """Return a Context of an integrator of this package, without positions."""
        return make_context(self.box.system, integrator, self.settings.platform)

    def integrator(self, settings: RunSettings) -> SIERIntegrator:
        """Return an integrator of this package, with SIER4G where settings have a method of OpenMM."""
        step, scheme = settings.dt / 1000, settings.method.scheme or SIER4G
        # The exact engine, which runs on GPUs too, has what the native one lacks: bodies that no constraints hold.
        engine = "exact" if settings.rigid else "auto"
        shared: dict[str, Any] = {"bodies": self.bodies, "engine": engine, "fastForceGroups": self.fast}
        if settings.ensemble == "nve":
            return SIERIntegrator(step, scheme, **shared)
        temperature, friction = settings.temperature, settings.friction
        pressure = settings.pressure if settings.moves_volume else None
        made: SIERThermostatIntegrator
        if settings.ensemble == "hmc":
            trial = settings.steps_per_trial
            made = SIERHMCIntegrator(temperature, step, scheme, trial, friction or None, pressure=pressure, **shared)
        elif settings.rescales:
            thermostat = VelocityRescaling(temperature, friction, pressure=pressure)
            made = SIERThermostatIntegrator(thermostat, step, scheme, **shared)
        else:
            # The log has the conserved energy, on every platform.
            shared |= {"pressure": pressure, "countsHeat": True}
            made = SIERLangevinIntegrator(temperature, friction, step, scheme, **shared)
        made.setRandomNumberSeed(settings.seed)
        return made
