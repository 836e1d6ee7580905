"""The command `openmm-sier plot`: a picture of the logs of one run or of several."""

from pathlib import Path

from openmm_sier.cli import pictures
from openmm_sier.cli.console import note
from openmm_sier.cli.settling import read_runs, verdict


def execute(logs: list[Path], out: Path | None, skip: float | None, overwrite: bool) -> None:
    """Run `openmm-sier plot`.

    Args:
        logs: of runs of one kind.
        out: the picture; None for one in the folder of the first log.
        skip: what means leave out, ps or trials; None for what had not settled.
        overwrite: whether an existing file is replaced.

    Raises:
        RunError, RecordError, OSError, ModuleNotFoundError: as their messages say.
    """
    path = out or logs[0].with_suffix(".png")
    pictures.check(path, logs, overwrite)
    runs = read_runs(logs, skip)
    pictures.draw(runs, path)
    note(verdict(runs))
    note(f"wrote {path}")
