"""Cut from the files of a run only the records that a killed run wrote after its last checkpoint."""

import os
from collections.abc import Sequence
from pathlib import Path

from openmm_sier.cli.errors import RunError
from openmm_sier.cli.files.checkpoints import Notes
from openmm_sier.cli.files.kinds import KINDS
from openmm_sier.cli.files.records import last_step
from openmm_sier.cli.settings import RunSettings


def find_cuts(plan: RunSettings, notes: Notes) -> list[Path]:
    """Return the files with records after the checkpoint, which a restart cuts.

    Args:
        plan: of the run.
        notes: of the checkpoint, which the files fit.
    """
    files = {name: path for name, kind in KINDS.items() if (path := getattr(plan, kind.option))}
    return [path for name, path in files.items() if os.path.getsize(path) > notes.file(name).size]


def refuse_to_lose(cuts: Sequence[Path], plan: RunSettings, checkpoint: Path, step: int) -> None:
    """Refuse to cut more than a killed run leaves after its last checkpoint.

    A run writes its next checkpoint at most one interval later. A log that continues beyond that is of a run that went
    on, as after a restart from a copy of a checkpoint.

    Args:
        cuts: as `find_cuts` gives them.
        plan: of the run.
        checkpoint, step: the checkpoint and its step.

    Raises:
        RunError: naming the files.
    """
    if plan.report not in cuts:
        return
    interval = plan.interval(plan.checkpoint_every)
    last = last_step(plan.report)
    if last > (step // interval + 1) * interval:
        raise RunError(
            f"{checkpoint} is at step {plan.length(step)}, but {plan.report} goes on to step {plan.length(last)}, "
            f"further than a killed run writes after its last checkpoint. A restart would cut {_listed(cuts)}. Give "
            f"the last checkpoint to --restart; or begin a new run with --start {checkpoint} and another --out; or cut "
            "the files with --overwrite"
        )


def describe(cuts: Sequence[Path], plan: RunSettings, checkpoint: Path, step: int) -> str:
    """Return the files that are cut, in words."""
    return f"cuts {_listed(cuts)} back to step {plan.length(step)}, where {checkpoint} is"


def _listed(cuts: Sequence[Path]) -> str:
    return ", ".join(map(str, cuts))
