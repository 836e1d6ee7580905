"""The System of an input, its integrators, and Contexts for them."""

from collections.abc import Mapping, Sequence
from typing import Any

import openmm
from openmm import unit

from openmm_sier.cli.console import note
from openmm_sier.cli.errors import Misused, RunError
from openmm_sier.cli.settings import RunSettings
from openmm_sier.dynamics.schemes import SIER4G
from openmm_sier.ensembles import VelocityRescaling
from openmm_sier.inputs.equilibration import make_context
from openmm_sier.inputs.forcefields import Box, describe
from openmm_sier.inputs.inputs import read_input
from openmm_sier.inputs.source_files import SourceFile
from openmm_sier.integrators.constant_temperature import SIERThermostatIntegrator
from openmm_sier.integrators.hmc import SIERHMCIntegrator
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.integrators.langevin import SIERLangevinIntegrator
from openmm_sier.observe import openmm_integrators
from openmm_sier.prepare.pme import balance_pme, meshed_forces
from openmm_sier.prepare.preparation import prepare_system
from openmm_sier.system import tables
from openmm_sier.system.body_selection import select_bodies
from openmm_sier.system.find_bodies import RigidBodies
from openmm_sier.system.molecules import make_whole

#: Packages that bring platforms of OpenMM for GPUs, whose drivers must be there.
PLATFORMS = {"CUDA": "openmm[cuda12]", "HIP": "openmm[hip6]"}

#: Most bodies named by the user that are shown.
MOST_SHOWN = 6


def check_platform(name: str | None) -> None:
    """Refuse a platform that OpenMM does not have here.

    Raises:
        Misused: naming those that it has.
    """
    here = [openmm.Platform.getPlatform(i).getName() for i in range(openmm.Platform.getNumPlatforms())]
    if name is not None and name not in here:
        install = f": pip install '{PLATFORMS[name]}' brings it" if name in PLATFORMS else ""
        raise Misused(
            f"argument --platform: expected one of those that OpenMM has here, {', '.join(here)}; got {name}{install}"
        )


def _needs_a_box(settings: RunSettings) -> str | None:
    """Return the option of a run that requires a periodic box; None without one."""
    if settings.pressure_tensor:
        return "--pressure-tensor"
    if settings.moves_volume:
        return "--ensemble npt" if settings.ensemble == "npt" else "--pressure"
    return None


def with_rigid_bodies(box: Box, rigid: Sequence[str] | None = None) -> tuple[Box, RigidBodies]:
    """Find the rigid bodies of a box, print the selected ones, and return the box with these whole.

    Args:
        box: as `inputs.read_input` gives it.
        rigid: selection of rigid bodies, with the geometry of the coordinates, see `select_bodies`.

    Raises:
        RigidityError: constraints do not form rigid bodies, or a selected body cannot be one.
        ValueError: nothing is described by one of the words.
    """
    if not rigid:
        return box, RigidBodies.from_system(box.system, box.topology, None, box.positions)
    named = select_bodies(box.topology, rigid)
    shown = str(named).splitlines()
    more = f", and {len(shown) - MOST_SHOWN} more" if len(shown) > MOST_SHOWN else ""
    note(f"rigid: {', '.join(shown[:MOST_SHOWN])}{more}")
    whole = make_whole(box.system, box.positions, box.topology, named)
    bodies = RigidBodies.from_system(box.system, box.topology, named, whole)
    return box._replace(positions=whole * unit.nanometer), bodies


class SimulatedSystem:
    """An input and its System, prepared for long steps.

    Attributes:
        settings: of the run.
        box: with the System.
        bodies: its rigid bodies.
        fast: force groups that are fast.
        inputs: fingerprints of the files of the input, by purpose.
    """

    def __init__(self, settings: RunSettings, sources: Mapping[str, SourceFile]):
        """Read the files of the input, and prepare their System.

        Args:
            settings: of the run.
            sources: files of the input by purpose, see `openmm_sier.inputs.inputs.sources_of`.

        Raises:
            Misused: OpenMM does not have the platform here.
            RunError: the run requires a periodic box, and the input has none.
            ForceFieldError, RigidityError, OSError: as their messages say.
        """
        check_platform(settings.platform)
        box = read_input(
            sources["box"],
            sources.get("topology"),
            settings.forcefield,
            settings.constraints,
            settings.interactions,
            settings.edges,
        )
        is_periodic = box.system.usesPeriodicBoundaryConditions()
        hint = "" if is_periodic else " (--edges gives a box)"
        if not is_periodic and (needed := _needs_a_box(settings)):
            raise RunError(
                f"{needed} requires a periodic box, and the input has none: give one by --edges, or in the files"
            )
        self.settings = settings
        with tables.read_once():
            note(f"{settings.box}: force field {' '.join(box.files)} ({box.reason}); {describe(box)}{hint}")
            whole, bodies = with_rigid_bodies(box, settings.rigid)
            self.box = whole
            self.bodies = bodies
            preparation = prepare_system(box.system, self.bodies)
        self.fast = preparation.fastForceGroups
        if settings.hydrogen_mass is not None and settings.ensemble != "nve" and meshed_forces(box.system):
            # As prepare_system does where it sets the masses, which the System has already.
            balance_pme(box.system, constantEnergy=False)
        if settings.rigid:
            for change in preparation.done:
                note(change)
        self.inputs = {purpose: file.fingerprint for purpose, file in sources.items()}

    def context(self, step: int = 0) -> openmm.Context:
        """Return the Context of the run, which begins or continues at a step, without positions."""
        settings = self.settings
        if settings.method.scheme is not None:
            return self.context_of(self.integrator(settings))
        bath = settings.temperature if settings.ensemble != "nve" else None
        piston = settings.pressure if settings.moves_volume else None
        system, integrator = openmm_integrators.make_integrator(
            self.box.system,
            self.box.positions.value_in_unit(unit.nanometer),
            settings.scheme,
            settings.dt / 1000,
            bath,
            settings.friction,
            piston,
        )
        openmm_integrators.seed_noise(system, integrator, settings.seed, step)
        context = make_context(system, integrator, settings.platform)
        integrator.bind(context, self.bodies)
        return context

    def context_of(self, integrator: SIERIntegrator) -> openmm.Context:
        """Return a Context of an integrator of this package, without positions."""
        return make_context(self.box.system, integrator, self.settings.platform)

    def integrator(self, settings: RunSettings) -> SIERIntegrator:
        """Return an integrator of this package, with SIER4G if settings have a method of OpenMM."""
        step, scheme = settings.dt / 1000, settings.method.scheme or SIER4G
        # Bodies without constraints need the exact engine, which runs on GPUs too.
        engine = "exact" if settings.rigid else "auto"
        shared: dict[str, Any] = {"bodies": self.bodies, "engine": engine, "fastForceGroups": self.fast}
        if settings.ensemble == "nve":
            return SIERIntegrator(step, scheme, **shared)
        temperature, friction = settings.temperature, settings.friction
        pressure = settings.pressure if settings.moves_volume else None
        integrator: SIERThermostatIntegrator
        if settings.ensemble == "hmc":
            trial = settings.steps_per_trial
            integrator = SIERHMCIntegrator(
                temperature, step, scheme, trial, friction or None, pressure=pressure, **shared
            )
        elif settings.rescales:
            thermostat = VelocityRescaling(temperature, friction, pressure=pressure)
            integrator = SIERThermostatIntegrator(thermostat, step, scheme, **shared)
        else:
            # For the conserved energy in the log, on every platform.
            shared |= {"pressure": pressure, "countsHeat": True}
            integrator = SIERLangevinIntegrator(temperature, friction, step, scheme, **shared)
        integrator.setRandomNumberSeed(settings.seed)
        return integrator
