"""Cut from the files of a run only the records that a killed run wrote after its last checkpoint."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from openmm_sier.cli.errors import RunError
from openmm_sier.cli.files import checkpoints, records
from openmm_sier.cli.files.checkpoints import Notes
from openmm_sier.cli.files.kinds import KINDS
from openmm_sier.cli.files.places import same_file
from openmm_sier.cli.planning import noted_settings
from openmm_sier.cli.settings import RunSettings


class Cut(NamedTuple):
    """A file to be cut.

    Attributes:
        path: of the file.
        step: of its last record, which may be incomplete.
    """

    path: Path
    step: int


def find_cuts(plan: RunSettings, notes: Notes) -> list[Cut]:
    """Return the files with records after the checkpoint, which a restart cuts.

    Args:
        plan: of the run.
        notes: of the checkpoint, which the files fit.

    Raises:
        OSError: a file cannot be read.
    """
    cuts = []
    for name, kind in KINDS.items():
        if (path := getattr(plan, kind.option)) is None:
            continue
        if count := kind.format(path).records_after(path, notes.file(name).size):
            interval = plan.interval(getattr(plan, kind.every))
            cuts.append(Cut(path, (notes.step // interval + count) * interval))
    return cuts


def describe(cuts: Sequence[Cut], plan: RunSettings, checkpoint: Path, step: int) -> str:
    """Return the files that are cut, with the times of their ends before and after, in words."""
    files = ", ".join(f"{cut.path} from {_ps(plan, cut.step)}" for cut in cuts)
    return f"cuts back to {_ps(plan, step)}, where {checkpoint} is: {files}"


def refuse_to_lose(cuts: Sequence[Cut], plan: RunSettings, checkpoint: Path, step: int) -> None:
    """Refuse to cut more than a killed run leaves after its last checkpoint.

    A run writes its next checkpoint at most one interval later. A file that continues beyond that, or belongs to a
    later checkpoint, is of a run that went on, as after a restart from a copy of a checkpoint.

    Args:
        cuts: as `find_cuts` gives them.
        plan: of the run.
        checkpoint, step: the checkpoint and its step.

    Raises:
        RunError: naming the files, the cut, and a later checkpoint of the run if there is one.
    """
    if not cuts:
        return
    interval = plan.interval(plan.checkpoint_every)
    next_checkpoint = (step // interval + 1) * interval
    last = max(cut.step for cut in cuts)
    later = _later_checkpoint(cuts, plan, checkpoint, step)
    if later is None and last <= next_checkpoint:
        return
    files = ", ".join(str(cut.path) for cut in cuts)
    goes, these = ("goes", "this file") if len(cuts) == 1 else ("go", "these files")
    reason = f"{later} is a later checkpoint" if later else "a killed run writes less after its last checkpoint"
    raise RunError(
        f"{checkpoint} is at {_ps(plan, step)}, but {files} {goes} on to {_ps(plan, last)}; {reason}. A restart from "
        f"here would cut {these}. Give {later or 'the last checkpoint of the run'} to --restart; or begin a new run "
        f"with --start {checkpoint} and another --out; or cut {these} with --overwrite"
    )


def _later_checkpoint(cuts: Sequence[Cut], plan: RunSettings, checkpoint: Path, step: int) -> Path | None:
    """Return the last checkpoint of the same run after this step, in the folders of the checkpoint and its files."""
    places = {path.parent for path in (checkpoint, *(cut.path for cut in cuts))}
    latest, latest_step = None, step
    for other in sorted(path for place in places for path in place.glob("*.chk")):
        # Other files with this ending may have any content.
        with suppress(ValueError, LookupError, TypeError, OSError):
            notes = checkpoints.read_notes(other)
            if notes.step > latest_step and _is_of(cuts, noted_settings(other, notes.plan), notes):
                latest, latest_step = other, notes.step
    return latest


def _is_of(cuts: Sequence[Cut], plan: RunSettings, notes: Notes) -> bool:
    """Return whether a checkpoint, by its plan and notes, fits the present content of one of the files."""
    for name, kind in KINDS.items():
        path = getattr(plan, kind.option)
        if path is not None and any(same_file(path, cut.path) for cut in cuts):
            records.check(path, notes.file(name), kind.format(path))
            return True
    return False


def _ps(plan: RunSettings, step: int) -> str:
    return f"{step * plan.step_time:g} ps"
