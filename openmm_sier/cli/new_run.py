"""A new run, from coordinates or from the checkpoint of another run."""

import math
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import openmm
from openmm import unit

from openmm_sier.cli import planning, run_checks
from openmm_sier.cli.console import REPORT, note
from openmm_sier.cli.errors import RunError
from openmm_sier.cli.files import checkpoints
from openmm_sier.cli.files.outputs import Outputs
from openmm_sier.cli.settings import RunSettings, checkpoint_of
from openmm_sier.cli.simulated_system import SimulatedSystem
from openmm_sier.dynamics.bodies import RigidityError
from openmm_sier.inputs.equilibration import prepare, stop_centre_of_mass
from openmm_sier.inputs.inputs import sources_of
from openmm_sier.inputs.pdb_files import first_line
from openmm_sier.observe import openmm_integrators


class Origin(NamedTuple):
    """The checkpoint of another run, with which a run starts, and the settings of that run."""

    checkpoint: Path
    settings: RunSettings


def read_origin(checkpoint: Path | None) -> Origin | None:
    """Return the origin of a new run; None without a checkpoint.

    Raises:
        RecordError, RunError, OSError: as their messages say.
    """
    if checkpoint is None:
        return None
    return Origin(checkpoint, planning.noted_settings(checkpoint, checkpoints.read_notes(checkpoint).plan))


class NewRun:
    """The beginning of a run from coordinates, or from the checkpoint of another run.

    Attributes:
        settings: of the run.
        checkpoint: path of its checkpoint.
        sources: files of the input, by purpose.
        notes: of the checkpoint that is continued; None for a new run.
        unsettled: how a doubtful equilibration ended, in words; None without one.
        continues: whether the run was begun earlier, so that the picture of its log is replaced.
    """

    notes = None
    continues = False

    def __init__(self, given: RunSettings):
        """Plan a run by the settings of a user, and open its coordinates and topology.

        Raises:
            Misused, RunError, ForceFieldError, RecordError, OSError: as their messages say.
        """
        self._origin = read_origin(given.start)
        self.settings = planning.new_settings(given, self._origin.settings if self._origin else None)
        if self.settings.hydrogen_mass is not None and self.settings.ensemble == "nve":
            warnings.warn(
                f"hydrogens of {self.settings.hydrogen_mass:g} dalton at constant energy: do not, motion is slower. "
                "Leave --hydrogen-mass out, or give a bath by --ensemble",
                stacklevel=2,
            )
        self.checkpoint = checkpoint_of(self.settings.out)
        self.sources = sources_of(self.settings.box, self.settings.topology, self.settings.forcefield)
        if self._origin is not None:
            box = self.sources["box"]
            planning.refuse_foreign_force_field(self.settings, given.chosen, self._origin.checkpoint, box)
        self.unsettled: str | None = None

    def check_inputs(self, outputs: Outputs) -> None:
        """Accept all inputs."""

    def check_outputs(self, outputs: Outputs) -> None:
        """Refuse to replace files, unless a user allows it."""
        if not self.settings.overwrite:
            outputs.refuse_existing(self.settings.resume)

    def context(self, simulated: SimulatedSystem) -> openmm.Context:
        """Return the Context of the run after its equilibration, if it has one.

        OpenMM's own integrators continue from a start that an integrator of this package has made.
        """
        settings = self.settings
        started = simulated.context_of(simulated.integrator(settings.stand_in))
        started.getIntegrator().impl.refuse_long_step()
        positions, minimize = simulated.box.positions, settings.minimize
        if self._origin is not None:
            state, _ = checkpoints.read_checkpoint(self._origin.checkpoint)
            _start_from(self._origin, state, settings, started)
            positions, minimize = state.getPositions(), bool(minimize)
        if settings.equilibrates:
            self.unsettled = _equilibrate(started, settings, positions, minimize)
        elif settings.ensemble == "nve":
            stop_centre_of_mass(started)
        if settings.method.scheme:
            return started
        context = simulated.context()
        context.setState(started.getState(positions=True, velocities=True))
        if settings.method.leapfrog:
            openmm_integrators.shift_velocities(context, -settings.dt / 2000)
        return context


def _start_from(origin: Origin, state: openmm.State, settings: RunSettings, context: openmm.Context) -> None:
    """Set positions, velocities and box of a checkpoint in a Context."""
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
        openmm_integrators.shift_velocities(context, origin.settings.dt / 2000)
    note(f"starts from the positions, velocities and box of {start}")


def _equilibrate(context: openmm.Context, settings: RunSettings, positions: Any, minimize: bool | None) -> str | None:
    """Equilibrate; return the end of a doubtful equilibration in words, else None."""
    time = settings.equilibrate
    try:
        equilibration = prepare(context, positions, settings.temperature, settings.seed, time, minimize, REPORT)
    except openmm.OpenMMException as error:
        if not run_checks.is_runaway(error):
            raise
        raise run_checks.Runaway(f"the equilibration failed (do atoms overlap?): {first_line(error)}") from error
    return equilibration.described if equilibration.doubtful else None
