"""The numerical tests of van Zon and Schofield (2007), repeated, with the paper's values next to ours.

    python -m studies.paper free-rotation | dipole | water | all [--quick]

Writes numbers (JSON) for each, and a figure of water. The runs of water are kept in --out, phase point by phase point,
and are not repeated. All take two minutes on two cores with --quick, and about 70 in full.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Literal, NamedTuple

import pandas as pd

from openmm_sier.dynamics.threads import cores
from openmm_sier.inputs.report import duration
from studies import records
from studies.command import RunsSettings
from studies.paper import dipole, free_rotation, liquids, water, water_runs
from studies.records import Record
from studies.report import SILENT, Report


@dataclass(frozen=True, kw_only=True)
class PaperSettings(RunsSettings):
    """What is repeated.

    Attributes:
        experiment: one of the paper's three, or all.
        quick: less of everything, to see it work.
    """

    experiment: Literal["free-rotation", "dipole", "water", "all"] = field(default="all", kw_only=False)
    quick: bool = False
    processes: int = cores()
    out: Path = Path("sier-paper")


def study(settings: PaperSettings, report: Report = SILENT) -> dict[str, Record]:
    """Carry out experiments, and write a JSON file for each and a figure of water.

    Returns:
        The results, by experiment.
    """
    chosen = EXPERIMENTS if settings.experiment == "all" else {settings.experiment: EXPERIMENTS[settings.experiment]}
    return {name: _carry_out(name, experiment, settings, report) for name, experiment in chosen.items()}


def _carry_out(name: str, experiment: Experiment, settings: PaperSettings, report: Report) -> Record:
    begun = perf_counter()
    record = experiment.find(settings, report)
    seconds = perf_counter() - begun
    for title, table in experiment.tables(record).items():
        report.table(title, table)
    record.write(settings.out / f"{name}.json")
    if name == "water":
        water.figure(record, settings.out / "water.png")
    report.note(f"{name}: {duration(seconds)}; written to {settings.out}")
    return record


def _rotate_freely(settings: PaperSettings, report: Report) -> Record:
    chosen = free_rotation.QUICK if settings.quick else free_rotation.FreeRotationSettings()
    return free_rotation.find(replace(chosen, seed=settings.seed), report)


def _turn_in_field(settings: PaperSettings, report: Report) -> Record:
    chosen = dipole.QUICK if settings.quick else dipole.DipoleSettings()
    return dipole.find(replace(chosen, seed=settings.seed), report)


def _simulate_water(settings: PaperSettings, report: Report) -> Record:
    chosen = replace(water_runs.QUICK if settings.quick else water_runs.WaterSettings(), seed=settings.seed)
    tasks = water_runs.tasks(chosen)
    all_runs = records.all_runs(settings, "water", tasks, water_runs.run, report, "{kind}, phase point {number}")
    selected = [
        each for each in all_runs.to_dict("records") if any(task.point.items() <= each.items() for task in tasks)
    ]
    runs = [run for each in selected for run in each["runs"]]
    return water.evaluate(chosen, liquids.water_box(chosen.molecules).edge, runs)


class Experiment(NamedTuple):
    """Functions that find the numbers, and make tables of text of them, by their titles."""

    find: Callable[[PaperSettings, Report], Record]
    tables: Callable[[Record], dict[str, pd.DataFrame]]


#: In the order of the paper.
EXPERIMENTS = {
    "free-rotation": Experiment(_rotate_freely, free_rotation.tables),
    "dipole": Experiment(_turn_in_field, dipole.tables),
    "water": Experiment(_simulate_water, water.tables),
}
