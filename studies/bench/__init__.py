"""Cost of a step beyond its forces, and cost of accuracy.

    python -m studies.bench [BOX.pdb] [--parts steps rotations layer accuracy]

measures the cost of a step over that of its forces and over OpenMM's integrators, of the free rotation and of the layer
above the forces alone, and energy error against cost, beside LAMMPS (lmp) and GROMACS (gmx) where they are on the PATH;
it takes some ten minutes of two cores. `studies.speed` compares speeds. Writes bench.json and bench.png.

All timings in a table come from one run. The things compared take turns for several rounds, and ratios are taken within
a round, so that changes of a machine's speed cancel. Medians over the rounds are shown with their standard errors.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import pandas as pd

from openmm_sier.dynamics.backend import threads
from studies.bench import accuracy, layer, peers, rotations, steps, timing
from studies.bench.timing import BenchSettings
from studies.command import chosen
from studies.records import Record, provenance
from studies.report import SILENT, Report, Table


class Part(NamedTuple):
    """Functions that measure, and that make tables of text of what was found."""

    find: Callable[[BenchSettings, Report], dict[str, pd.DataFrame]]
    tables: Callable[[Mapping[str, pd.DataFrame]], list[Table]]


PARTS = {
    "steps": Part(steps.find, steps.tables),
    "rotations": Part(rotations.find, rotations.tables),
    "layer": Part(layer.find, layer.tables),
    "accuracy": Part(accuracy.find, accuracy.tables),
}


def study(settings: BenchSettings, report: Report = SILENT) -> Record:
    """Time and compare, and write bench.json and, with the part `accuracy`, bench.png.

    Raises:
        ValueError: a part is unknown.
    """
    parts = chosen(settings.parts, PARTS, "part of the benchmark")
    report.note(", ".join(f"{name} {value}" for name, value in provenance()["machine"].items()))
    report.note(", ".join(f"{name} {value}" for name, value in settings.recorded().items()))
    found: dict[str, pd.DataFrame] = {}
    for part in parts:
        found |= part.find(settings, report)
    for part in parts:
        for table in part.tables(found):
            report.table(table)
    notes = {}
    if "points" in found:
        of_processor = timing.counts_processor_time(settings.platform)
        builds = {peer.name: peer.build for peer in peers.installed()}
        notes = {"peers": builds, "clock": "processor" if of_processor else "wall", "threads": threads.count()}
    record = Record(settings.recorded(), found, notes)
    record.write(settings.out / "bench.json")
    if "points" in found:
        accuracy.figure(record, settings.out / "bench.png")
    return record
