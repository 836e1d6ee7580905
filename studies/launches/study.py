"""All cases, and tables of their commands."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, ClassVar

import pandas as pd

from studies import records, text
from studies.command import RunsSettings, chosen
from studies.launches import cases, counting, shim
from studies.records import Record, Task
from studies.report import SILENT, Report

PRECISIONS = ("mixed", "single")

#: Columns for a terminal.
COLUMNS = {
    "box": "{box}",
    "precision": "{precision}",
    "method": "{method}",
    "launches": "{launches:.1f}",
    "copies": "{copies:.1f}",
    "reads": "{reads:.1f}",
    "blocking": "{blocking_reads:.1f}",
    "writes": "{writes:.1f}",
    "blocking writes": "{blocking_writes:.1f}",
    "bytes": "{bytes:.0f}",
    "waits": "{waits:.1f}",
    "Python/us": "{python:.0f}",
}


@dataclass(frozen=True, kw_only=True)
class LaunchesSettings(RunsSettings):
    """What is counted.

    Attributes:
        boxes: by name.
        methods: by name; where none is named all of them, those of the kernels engine only where it is installed.
        precisions: of OpenMM's OpenCL platform.
        out: for the compiled library and the cases that were counted too.
    """

    boxes: tuple[str, ...] = (*cases.BOXES, cases.BODIES)
    methods: tuple[str, ...] = ()
    precisions: tuple[str, ...] = PRECISIONS
    out: Path = Path("launches")

    SHARED: ClassVar[tuple[str, ...]] = ("seed",)


def tasks(settings: LaunchesSettings) -> Iterator[Task]:
    """Yield a task for each case.

    Raises:
        ValueError: a box or a method is unknown.
    """
    names = settings.methods or cases.usual()
    chosen(names, cases.CASES, "method")
    chosen(settings.boxes, dict.fromkeys((*cases.BOXES, cases.BODIES)), "box")
    for precision, box, name in product(settings.precisions, settings.boxes, names):
        if cases.CASES[name].names_bodies == (box == cases.BODIES):
            yield Task(settings, {"box": box, "precision": precision, "name": name})


def run(task: Task) -> dict[str, Any]:
    """Return the point of a case with what it sends."""
    point, settings = task.point, task.settings
    library = settings.out.resolve() / shim.LIBRARY
    row = counting.run(point["box"], point["name"], point["precision"], settings.seed, library)
    return point | row


def rows_of(run: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of a case: one for a step, one for a call."""
    place = {"box": run["box"], "precision": run["precision"], "method": cases.CASES[run["name"]].integrator.name}
    return [
        place | {"per": per} | {name: round(run[per].get(name, 0.0), 4) for name in (*counting.COUNTS, "python")}
        for per in ("step", "call")
    ]


def kernels_of(run: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of the kernels of a step, by purpose."""
    place = {"box": run["box"], "precision": run["precision"], "method": cases.CASES[run["name"]].integrator.name}
    kinds = (*counting.KINDS, counting.OTHERS)
    return [place | {"kind": kind, "launches": round(run["step"][kind], 4)} for kind in kinds if kind in run["step"]]


def study(settings: LaunchesSettings, report: Report = SILENT) -> Record:
    """Count what `out` lacks, and write launches.json."""
    points = list(tasks(settings))
    shim.build(settings.out)
    form = "{box}, {precision}, {name}"
    runs = records.all_runs(settings, "launches", points, run, report, form).to_dict("records")
    order = [task.point for task in points]
    counted = [each for point in order for each in runs if point.items() <= each.items()]
    rows = pd.DataFrame([row for each in counted for row in rows_of(each)])
    kernels = pd.DataFrame([row for each in counted for row in kernels_of(each)])
    shown = rows.assign(bytes=rows["reads_bytes"] + rows["writes_bytes"])
    for per in ("step", "call"):
        report.table(f"For each {per}", text.table(shown[shown["per"] == per], COLUMNS))
    record = Record(settings.recorded(), {"rows": rows, "kernels": kernels}, {})
    return record.write(settings.out / "launches.json")
