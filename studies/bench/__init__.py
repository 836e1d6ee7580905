"""Cost of a step beyond its forces, and cost of accuracy: the measurements behind `openmm-sier bench`.

All timings in a table come from one run. The things compared take turns for several rounds, and ratios are taken within
a round, so that changes of a machine's speed cancel. Medians over the rounds are shown with their standard errors.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

from openmm_sier.measure.report import SILENT, Report, Table
from studies import figures, style
from studies.bench import accuracy, layer, platforms, rotations, steps
from studies.bench.timing import BenchSettings, machine


class Part(NamedTuple):
    """Functions that measure, and that make tables of the numbers."""

    find: Callable[[BenchSettings, Report], Any]
    tables: Callable[[Any], list[Table]]


PARTS = {
    "steps": Part(steps.time_steps, steps.tables),
    "rotations": Part(rotations.time_rotations, rotations.tables),
    "layer": Part(layer.time_layer, layer.tables),
    "accuracy": Part(accuracy.compare_accuracy, accuracy.tables),
    "platform": Part(platforms.time_platform, platforms.tables),
}


def run(settings: BenchSettings, out: Path, report: Report = SILENT) -> dict:
    """Time and compare, and write bench.json and, with matplotlib, bench.png to a directory.

    Args:
        settings: what is timed.
        out: the directory, which is made if it does not exist.
        report: gets tables and notes.

    Returns:
        What bench.json holds.

    Raises:
        ValueError: a part is unknown.
    """
    for name in settings.parts or ():
        if name not in PARTS:
            raise ValueError(f"unknown part {name!r} of the benchmark; known are {', '.join(PARTS)}")
    names = settings.parts or [name for name in PARTS if (name == "platform") == (settings.platform is not None)]
    out.mkdir(parents=True, exist_ok=True)
    here = machine()
    report.note(", ".join(f"{name} {value}" for name, value in here.items()))
    parameters = asdict(settings) | {"box": settings.box.name}
    report.note(", ".join(f"{name} {value}" for name, value in parameters.items()))
    found: dict[str, Any] = {name: PARTS[name].find(settings, report) for name in names}
    for name, values in found.items():
        for table in PARTS[name].tables(values):
            report.table(table)
    record = {"machine": here, "settings": parameters} | found
    points = found.get("accuracy", [])
    for note in accuracy.notes(points):
        report.note(note)
    if points:
        record["accuracy"] = accuracy.record(points)
    (out / "bench.json").write_text(json.dumps(record, indent=1, default=str))
    if points and style.can_draw(report):
        figures.cost_figure(points, out / "bench.png")
    return record
