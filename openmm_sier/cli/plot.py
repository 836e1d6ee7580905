"""The command `openmm-sier plot`: a picture of the logs of one run or of several."""

from pathlib import Path

from openmm_sier.cli.console import note
from openmm_sier.cli.findings import warnings_of
from openmm_sier.cli.pictures import canvas, drawing
from openmm_sier.cli.settling import read_runs


def execute(logs: list[Path], out: Path | None, skip: float | None) -> None:
    """Run `openmm-sier plot`.

    Args:
        logs: of runs of one kind.
        out: the picture; None for one in the folder of the first log.
        skip: what means leave out, ps or trials; None for what had not settled.

    Raises:
        RunError, RecordError, OSError, ModuleNotFoundError: as their messages say.
    """
    path = out or logs[0].with_suffix(".png")
    canvas.check(path, logs, may_replace=True)
    runs = read_runs(logs, skip)
    drawing.draw(runs, path)
    for text in warnings_of(runs):
        note(text)
    note(f"wrote {path}")
