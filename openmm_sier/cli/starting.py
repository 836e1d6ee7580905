"""Start a new run: from coordinates, or from the checkpoint of another run."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import openmm
from openmm import unit

from openmm_sier.cli import run_checks
from openmm_sier.cli.beginning import Simulated
from openmm_sier.cli.console import REPORT, note
from openmm_sier.cli.errors import RunError
from openmm_sier.cli.files import checkpoints
from openmm_sier.cli.files.locks import FileLocks
from openmm_sier.cli.files.outputs import Outputs
from openmm_sier.cli.planning import new_settings, noted_settings
from openmm_sier.cli.running import Run, check_extras, tell_of_settings
from openmm_sier.cli.settings import RunSettings, checkpoint_of
from openmm_sier.cli.stopping import StopRequests
from openmm_sier.dynamics.bodies import RigidityError
from openmm_sier.inputs.equilibration import prepare, stop_centre_of_mass
from openmm_sier.inputs.pdb_files import first_line
from openmm_sier.observe.openmm_integrators import shift_velocities


class Origin(NamedTuple):
    """The checkpoint of another run, from which one starts, and the settings of that run."""

    checkpoint: Path
    settings: RunSettings


def read_origin(checkpoint: Path | None) -> Origin | None:
    """Return the checkpoint that a new run starts from; None without one.

    Raises:
        RecordError, RunError, OSError: as their messages say.
    """
    if checkpoint is None:
        return None
    notes = checkpoints.read_notes(checkpoint)
    return Origin(checkpoint, noted_settings(checkpoint, notes["plan"]))


def start(given: Mapping[str, Any], locks: FileLocks, requests: StopRequests, config: Path | None = None) -> Run:
    """Return a new run at its first step, with its files open.

    Args:
        given: settings by name.
        locks: that take the locks of its files.
        requests: for signals, which wait from when files are replaced.
        config: the file from which some of the settings are.

    Raises:
        RunError: settings contradict each other, or a file is in the way or cannot be written.
        Runaway: the equilibration broke down.
        ForceFieldError, RecordError, RigidityError, OSError, openmm.OpenMMException: as their messages say.
    """
    origin = read_origin(given.get("start"))
    settings = new_settings(given, origin.settings if origin else None)
    outputs = Outputs(settings, checkpoint_of(settings.out))
    check_extras(settings, outputs, may_replace=settings.overwrite)
    tell_of_settings(settings)
    simulated = Simulated(settings)
    # Settings may take the place of those that they are from.
    read = [config] if config and config != settings.save_config else []
    outputs.check([*simulated.box.sources.values(), *read])
    locks.hold(outputs.paths)
    if not settings.overwrite:
        outputs.refuse_existing(settings.resume)
    context, unsettled = begin(simulated, origin)
    # From here on, the step and all files are completed before a signal ends the run.
    requests.defer()
    outputs.remove()
    run = Run(settings, simulated, context, outputs, unsettled)
    run.tell()
    outputs.open(simulated, context, unsettled)
    return run


def begin(simulated: Simulated, origin: Origin | None = None) -> tuple[openmm.Context, str | None]:
    """Return the Context of a new run, with positions and velocities, and how a doubtful equilibration ended, in words.

    All methods begin alike: OpenMM's own integrators go on from a start that one of this package has made.

    Raises:
        RunError: the checkpoint that it starts from belongs to another system.
        Runaway: the equilibration broke down.
    """
    settings = simulated.settings
    begun = simulated.context_of(simulated.integrator(settings.stand_in))
    begun.getIntegrator().binding.check_step()
    positions, minimize, unsettled = simulated.box.positions, settings.minimize, None
    if origin is not None:
        state, _ = checkpoints.read_checkpoint(origin.checkpoint, simulated.box.system.getNumParticles())
        _start_from(origin, state, settings, begun)
        positions, minimize = state.getPositions(), bool(minimize)
    if settings.equilibrates:
        unsettled = _equilibrate(begun, settings, positions, minimize)
    elif settings.ensemble == "nve":
        stop_centre_of_mass(begun)
    if settings.method.scheme:
        return begun, unsettled
    context = simulated.context()
    context.setState(begun.getState(positions=True, velocities=True))
    if settings.method.leapfrog:
        shift_velocities(context, -settings.dt / 2000)
    return context, unsettled


def _start_from(origin: Origin, state: openmm.State, settings: RunSettings, context: openmm.Context) -> None:
    """Take positions, velocities and box of a checkpoint."""
    start = origin.checkpoint
    redraws = origin.settings.hydrogen_mass != settings.hydrogen_mass
    try:
        context.setPeriodicBoxVectors(*state.getPeriodicBoxVectors())
        context.setPositions(state.getPositions())
        if redraws:
            context.setVelocitiesToTemperature(settings.temperature, settings.seed)
        else:
            context.setVelocities(state.getVelocities())
        context.getIntegrator().getBodyState()
        energy = context.getState(energy=True).getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
    except (RigidityError, openmm.OpenMMException) as error:
        raise RunError(f"{start} does not fit {settings.box}: {first_line(error)}") from error
    if not math.isfinite(energy):
        raise RunError(f"{start} does not fit {settings.box}: the energy of its positions is not finite")
    if redraws:
        note(f"starts from the positions and box of {start}; hydrogens had another mass: velocities are drawn anew")
        return
    if origin.settings.method.leapfrog:
        shift_velocities(context, origin.settings.dt / 2000)
    note(f"starts from the positions, velocities and box of {start}")


def _equilibrate(context: openmm.Context, settings: RunSettings, positions: Any, minimize: bool | None) -> str | None:
    """Equilibrate; return how that ended if it is doubtful, in words."""
    time = settings.equilibrate
    try:
        found = prepare(context, positions, settings.temperature, settings.seed, time, minimize, REPORT)
    except openmm.OpenMMException as error:
        if not run_checks.is_runaway(error):
            raise
        raise run_checks.Runaway(f"the equilibration failed (do atoms overlap?): {first_line(error)}") from error
    return found.described if found.doubtful else None
