"""The output files of a run: their paths, checks before they are written, and the steps at which they are due."""

import os
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

import openmm

from openmm_sier.cli import pictures
from openmm_sier.cli.errors import RunError
from openmm_sier.cli.files import checkpoints, records
from openmm_sier.cli.files.checkpoints import FORMAT, Notes
from openmm_sier.cli.files.kinds import KINDS
from openmm_sier.cli.files.places import check_place
from openmm_sier.cli.settings import RunSettings
from openmm_sier.cli.simulated_system import SimulatedSystem
from openmm_sier.inputs.source_files import FilePath


class Outputs:
    """The files of a run. They are open from `open` on.

    Attributes:
        checkpoint: its path.
        paths: of all files that a restart continues, the checkpoint first.
        saved_step: step of the last checkpoint; None before the first.
    """

    def __init__(self, settings: RunSettings, checkpoint: Path):
        self.checkpoint = checkpoint
        self.saved_step: int | None = None
        self._settings = settings
        self._grown = {name: path for name, kind in KINDS.items() if (path := getattr(settings, kind.option))}
        self.paths = [checkpoint, *self._grown.values()]
        self._intervals = {name: settings.interval(getattr(settings, KINDS[name].every)) for name in self._grown}
        self._intervals["checkpoint"] = settings.interval(settings.checkpoint_every)

    # --- before any is opened ---

    def check(self, sources: Iterable[FilePath], continues: bool) -> None:
        """Refuse outputs that cannot be written, and any that would overwrite an input or another output.

        Args:
            sources: files that the command reads.
            continues: whether the run continues, which replaces the picture of its log.

        Raises:
            RunError: naming the file.
            ModuleNotFoundError: there is no matplotlib for the picture.
        """
        start = self._settings.start
        inputs = [*sources, *([start] if start else [])]
        # The user names the trajectory, and the checkpoint follows from it.
        paths = [*self._grown.values(), self.checkpoint]
        for number, path in enumerate(paths):
            check_place(path, inputs, paths[:number])
        if self._settings.plot:
            log = self._settings.report if continues else None
            pictures.check(self._settings.plot, inputs, self._settings.overwrite, paths, log)

    def refuse_existing(self, resumes: bool = False) -> None:
        """Refuse to replace files.

        Args:
            resumes: whether to accept files of a run that was killed before its first checkpoint.

        Raises:
            RunError: naming the file that is in the way.
        """
        for path in filter(os.path.lexists, self.paths):
            if not resumes:
                raise RunError(
                    f"{path} exists. Continue from a checkpoint with --restart FILE, or replace the file with "
                    "--overwrite"
                )
            if not self._is_beginning(path):
                raise RunError(
                    f"{path} exists, but its checkpoint {self.checkpoint} does not: give another name, or "
                    "replace the file with --overwrite"
                )

    def _is_beginning(self, path: Path) -> bool:
        """Return whether a file holds no more than a run writes before its first checkpoint."""
        if path == self.checkpoint or not path.is_file():
            return False
        kind = next(KINDS[name] for name, grown in self._grown.items() if grown == path)
        return records.is_beginning(path, kind.format)

    def check_noted(self, notes: Notes) -> None:
        """Check, without changing them, that the outputs are those of the run of a checkpoint.

        Raises:
            RecordError: an output is missing or of another run.
            OSError: one cannot be read.
        """
        for name, path in self._grown.items():
            records.check(path, notes.file(name))

    def files_beyond(self, notes: Notes) -> list[Path]:
        """Return the files with records after a checkpoint, which a restart cuts."""
        return [path for name, path in self._grown.items() if os.path.getsize(path) > notes.file(name).size]

    def _remove(self) -> None:
        """Remove all files, the checkpoint first, so that it never remains with files of another run."""
        for path in self.paths:
            Path(os.path.realpath(path)).unlink(missing_ok=True)

    # --- during the run ---

    def open(
        self,
        simulated: SimulatedSystem,
        context: openmm.Context,
        unsettled: str | None,
        notes: Notes | None = None,
    ) -> None:
        """Open the files: new ones, which replace earlier ones, or those of a checkpoint, cut to its lengths.

        Args:
            simulated: System and settings.
            context: at the start, or at the checkpoint.
            unsettled: how a doubtful equilibration ended, in words; None without one.
            notes: of the checkpoint of a continued run, which have passed `check_noted`; None for a new run.
        """
        if notes is None:
            self._remove()
        self._inputs = simulated.inputs
        self._unsettled = unsettled
        self.saved_step = notes.step if notes else None
        self._files = {}
        self._writers = {}
        for name, path in self._grown.items():
            noted = notes.file(name) if notes else None
            self._files[name], self._writers[name] = KINDS[name].open(path, simulated, context, noted)

    def next_due(self, step: int) -> int:
        """Return the next step after this one at which a file is due."""
        return min((step // interval + 1) * interval for interval in self._intervals.values())

    def due(self, step: int) -> list[str]:
        """Return the names of files that are due after a step: outputs, and "checkpoint"."""
        return [name for name, interval in self._intervals.items() if step % interval == 0]

    def write(self, due: Collection[str], context: openmm.Context, values: Mapping[str, float]) -> None:
        """Write the files that are due, the checkpoint last, since it notes the lengths of the others.

        Args:
            due: result of the method `due`.
            context: at the last completed step.
            values: by column of the log; needed for the log and for a checkpoint.
        """
        for name, write in self._writers.items():
            if name in due:
                write(values)
        if "checkpoint" in due:
            self._write_checkpoint(context, values["Potential Energy (kJ/mole)"])

    def _write_checkpoint(self, context: openmm.Context, potential: float) -> None:
        step = context.getStepCount()
        notes = Notes(
            format=FORMAT,
            plan=self._settings.noted(self.checkpoint),
            step=step,
            potential_energy=potential,
            platform={checkpoints.PLATFORM: context.getPlatform().getName()},
            inputs=self._inputs,
            unsettled=self._unsettled,
            **{name: file.noted() for name, file in self._files.items()},
        )
        state = context.getState(positions=True, velocities=True, parameters=True, integratorParameters=True)
        checkpoints.write_checkpoint(self.checkpoint, state, notes)
        self.saved_step = step

    def close(self) -> None:
        """Close all files at the end of the run."""
        for file in self._files.values():
            file.close()
