"""A run that continues from its checkpoint, without a gap."""

from pathlib import Path

import openmm
from openmm import unit

from openmm_sier.cli import planning
from openmm_sier.cli.console import note
from openmm_sier.cli.errors import Misused, NothingLeft, RunError
from openmm_sier.cli.files import checkpoints
from openmm_sier.cli.files.locks import FileLocks
from openmm_sier.cli.files.outputs import Outputs
from openmm_sier.cli.files.records import last_step
from openmm_sier.cli.settings import RunSettings, checkpoint_of
from openmm_sier.cli.simulated_system import SimulatedSystem
from openmm_sier.inputs.inputs import sources_of

#: Allowed relative difference between the energy of a checkpoint's positions and its noted energy. Platforms differ by
#: single precision.
ENERGY_TOLERANCE = 1e-4


def checkpoint_to_continue(given: RunSettings, locks: FileLocks) -> Path | None:
    """Return the checkpoint of `restart`, or with `resume` that of the run; None for a new run.

    It is locked before it is looked for or read, so that no other command creates or replaces it. A run that has just
    removed it still holds the lock.

    Raises:
        Misused: settings contradict each other.
        RunError: another command writes the checkpoint.
    """
    checkpoint = given.restart
    if given.resume:
        if checkpoint:
            raise Misused("--resume finds the checkpoint beside --out: leave --restart out")
        checkpoint = checkpoint_of(given.out)
    elif checkpoint and given.start:
        raise Misused("--start begins a new run, and --restart continues an old one: give one of them")
    if checkpoint and checkpoint.parent.is_dir():
        locks.hold([checkpoint])
    return checkpoint if given.restart or (checkpoint and checkpoint.exists()) else None


class Restart:
    """The beginning of a run that continues from its checkpoint, with the attributes and methods of `NewRun`."""

    continues = True

    def __init__(self, given: RunSettings, checkpoint: Path):
        """Plan a run by a locked checkpoint and the settings of a user.

        Raises:
            Misused, RunError, RecordError, OSError: as their messages say.
        """
        self.checkpoint = checkpoint
        self.notes = checkpoints.read_notes(checkpoint)
        settings = planning.continued_settings(given, checkpoint, self.notes.plan)
        platform = settings.platform or self.notes.platform[checkpoints.PLATFORM]
        self.settings = settings.model_copy(update={"platform": platform})
        self.sources = sources_of(settings.box, settings.topology, settings.forcefield)
        planning.refuse_foreign_force_field(settings, given.chosen, checkpoint, self.sources["box"])
        self.unsettled = self.notes.unsettled

    def check_inputs(self, outputs: Outputs) -> None:
        """Refuse inputs of another run, and a run that has reached its last step."""
        self._refuse_other_files()
        step, settings = self.notes.step, self.settings
        if step < settings.steps:
            return
        message = (
            f"{self.checkpoint} is at step {settings.length(step)}, and the run ends at step {settings.steps}; "
            "ask for more with --steps or --time"
        )
        if step > settings.steps:
            raise RunError(message)
        outputs.check_noted(self.notes)
        raise NothingLeft(message)

    def _refuse_other_files(self) -> None:
        """Refuse inputs of another run, even if their system has nearly the same energy."""
        noted = self.notes.inputs
        for purpose, file in self.sources.items():
            if file.fingerprint != noted.get(purpose):
                raise RunError(
                    f"{file} is not the file that the run of {self.checkpoint} read, or was edited. Give the original "
                    "file, or begin a new run with --start"
                )

    def check_outputs(self, outputs: Outputs) -> None:
        """Refuse outputs of another run, or from which more would be cut than a killed run leaves."""
        outputs.check_noted(self.notes)
        if not self.settings.overwrite:
            self._refuse_to_lose()
        if cuts := outputs.files_beyond(self.notes):
            step = self.settings.length(self.notes.step)
            note(f"cuts {', '.join(map(str, cuts))} back to step {step}, where {self.checkpoint} is")

    def _refuse_to_lose(self) -> None:
        """Refuse to cut more than a killed run leaves after its last checkpoint.

        A run writes its next checkpoint at most one interval later. A log that continues beyond that is of a run that
        went on, as after a restart from a copy of a checkpoint.
        """
        settings, step, last = self.settings, self.notes.step, last_step(self.settings.report)
        interval = settings.interval(settings.checkpoint_every)
        if last > (step // interval + 1) * interval:
            raise RunError(
                f"{self.checkpoint} is at step {settings.length(step)}, but {settings.report} goes on to step "
                f"{settings.length(last)}, further than a killed run writes after its last checkpoint. Give the last "
                f"checkpoint to --restart; or begin a new run with --start {self.checkpoint} and another --out; or cut "
                "the files back with --overwrite"
            )

    def context(self, simulated: SimulatedSystem) -> openmm.Context:
        """Return a Context in the state of the checkpoint, which must belong to this system."""
        notes = self.notes
        state, _ = checkpoints.read_checkpoint(self.checkpoint)
        context = simulated.context(notes.step)
        context.setState(state)
        energy = context.getState(energy=True).getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
        # An energy that is not a number differs too.
        if not abs(energy - notes.potential_energy) <= ENERGY_TOLERANCE * (abs(energy) + 1):
            raise RunError(
                f"the positions of {self.checkpoint} have the energy {energy:.6g} kJ/mol in the system of "
                f"{self.settings.box}, but had {notes.potential_energy:.6g} in the run: the molecules or the force "
                "field are not those of the run. Give the files of the run"
            )
        return context
