"""The figures of the documentation, drawn again from the numbers in the repository.

    python -m studies.figures [--names acceptance equipartition]

After a change of the style this draws all figures whose numbers are in `studies/data` anew. A study that is run again
writes its JSON file, which replaces the one there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from studies import acceptance, crowding, equipartition, liquid_figure, mesh, records, step_study, whole_run
from studies.bench import accuracy
from studies.command import Settings, chosen, command
from studies.paper import water
from studies.records import Record
from studies.report import SILENT, Report

DATA = Path(__file__).parent / "data"
DOCS = Path(__file__).parents[1] / "docs"


class Drawn(NamedTuple):
    """A figure of the documentation: what draws it, from which file of `DATA`, and the command that made the file."""

    figure: Callable[[Record, Path], None]
    data: str
    command: str


FIGURES = {
    "acceptance": Drawn(acceptance.figure, "acceptance.json", "python -m studies.acceptance"),
    "cost": Drawn(accuracy.figure, "cost.json", "python -m studies.bench --parts accuracy"),
    "crowding": Drawn(crowding.figure, "crowding.json", "python -m studies.crowding"),
    "equipartition": Drawn(equipartition.figure, "equipartition.json", "python -m studies.equipartition"),
    "mesh": Drawn(mesh.figure, "mesh.json", "python -m studies.mesh"),
    "paper-water": Drawn(water.figure, "paper-water.json", "python -m studies.paper water"),
    "properties": Drawn(liquid_figure.figure, "properties.json", "python -m studies.liquid_figure motion/*"),
    "whole-run": Drawn(whole_run.figure, "whole-run.json", "python -m studies.whole_run"),
    "step-study": Drawn(step_study.figure, "step-study.json", "python -m studies.step_study step-study/* --skip 5"),
}


@dataclass(frozen=True)
class FigureSettings(Settings):
    """What is drawn.

    Attributes:
        names: of figures; all unless given.
    """

    names: tuple[str, ...] = ()
    out: Path = DOCS


def study(settings: FigureSettings, report: Report = SILENT) -> None:
    """Draw figures.

    Raises:
        ValueError: there is no such figure.
    """
    chosen(settings.names, FIGURES, "figure")
    for name in settings.names or FIGURES:
        drawn = FIGURES[name]
        path = settings.out / f"{name}.png"
        drawn.figure(records.read(DATA / drawn.data), path)
        report.note(f"{path}, from studies/data/{drawn.data}, which `{drawn.command}` made")


main = command(FigureSettings, study, __doc__, __name__)
