"""The curves of a liquid that `openmm-sier properties` draws, kept as numbers.

    openmm-sier ensemble systems/motion.toml --out motion
    python -m studies.liquid_figure motion/* --out motion-figure

Pair distribution, displacements, orientations and the running integral of the viscosity, the means of runs that differ
in their seeds alone. Writes properties.json and properties.png.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pandas as pd
from tyro.conf import Positional

from openmm_sier.cli.finished_runs import open_runs
from openmm_sier.cli.properties import Run, curves_of, read_runs, title_of
from openmm_sier.measure.figures import Curve, property_figure
from studies import style
from studies.command import Settings, command
from studies.records import Record
from studies.report import SILENT, Report

#: Digits of the numbers that are kept: more than any error bar needs.
DIGITS = 5


@dataclass(frozen=True)
class LiquidFigureSettings(Settings):
    """What is drawn.

    Attributes:
        runs: directories of members, or checkpoints.
        skip: ps to leave out at the beginning of each run.
    """

    runs: Positional[tuple[Path, ...]] = ()
    skip: float = 0.0

    ANY_SIGN: ClassVar[tuple[str, ...]] = ("skip",)


def study(settings: LiquidFigureSettings, report: Report = SILENT) -> Record:
    """Write properties.json and properties.png."""
    if not settings.runs:
        raise ValueError("name the directories of an ensemble's members")
    runs = read_runs(open_runs(settings.runs), None, settings.skip)
    curves = curves_of(runs, [run for run in runs if run.tensors is not None])
    rounded = {name: _rounded(curve) for name, curve in curves.items()}
    record = Record({"skip": settings.skip}, rounded, _notes(runs))
    record.write(settings.out / "properties.json")
    figure(record, settings.out / "properties.png")
    report.note(f"wrote {settings.out / 'properties.png'}")
    return record


def _notes(runs: Sequence[Run]) -> dict[str, str]:
    box = Path(str(runs[0].plan.box)).stem
    return {"title": f"{style.MODELS.get(box, box)}: {title_of(runs)}"}


def _rounded(curve: Curve) -> pd.DataFrame:
    frame = pd.DataFrame({name: values for name, values in curve._asdict().items() if values is not None})
    return frame.map(lambda value: float(np.format_float_positional(value, DIGITS, fractional=False)))


def figure(record: Record, path: Path) -> None:
    """Draw the curves of a record."""
    columns = {name: frame.to_dict("list") for name, frame in record.tables.items()}
    curves = {name: Curve(**{key: np.array(values) for key, values in each.items()}) for name, each in columns.items()}
    property_figure(curves, record.notes["title"], path)


main = command(LiquidFigureSettings, study, __doc__, __name__)
