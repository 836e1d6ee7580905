"""Beginnings of a run: a new one, or the restart from a checkpoint. The rest of a run is the same."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path

import openmm

from openmm_sier.cli.files.checkpoints import Notes
from openmm_sier.cli.files.outputs import Outputs
from openmm_sier.cli.settings import RunSettings
from openmm_sier.cli.simulated_system import SimulatedSystem
from openmm_sier.inputs.source_files import SourceFile


class Beginning(ABC):
    """The beginning of a run, whose methods `openmm_sier.cli.run` calls in this order.

    Attributes:
        settings: of the run.
        checkpoint: path of its checkpoint.
        sources: files of the input, by purpose.
        notes: of the checkpoint that is continued; None for a new run.
        unsettled: how a doubtful equilibration ended, in words; None without one.
        may_replace: whether a picture and settings of an earlier run are replaced.
    """

    settings: RunSettings
    checkpoint: Path
    sources: Mapping[str, SourceFile]
    notes: Notes | None
    unsettled: str | None
    may_replace: bool

    @abstractmethod
    def check_inputs(self, outputs: Outputs) -> None:
        """Refuse inputs of another run, and a run without any steps left.

        Raises:
            NothingLeft: the run has reached its last step, and its files exist.
            RunError, RecordError, OSError: as their messages say.
        """

    @abstractmethod
    def check_outputs(self, outputs: Outputs) -> None:
        """Refuse outputs of another run, or whose content would be lost. They are locked.

        Raises:
            RunError, RecordError, OSError: as their messages say.
        """

    @abstractmethod
    def context(self, simulated: SimulatedSystem) -> openmm.Context:
        """Return the Context of the run at its first step, with positions and velocities.

        Raises:
            RunError: the checkpoint belongs to another system.
            Runaway: an equilibration broke down.
            RecordError, OSError, openmm.OpenMMException: as their messages say.
        """

    def remarks(self, context: openmm.Context) -> Sequence[str]:
        """Return differences from the run before, in words."""
        return ()
