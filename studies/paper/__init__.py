"""The numerical tests of van Zon and Schofield (2007), repeated, with the paper's values beside ours.

    python -m studies.paper free-rotation | dipole | water | all [--quick]

Writes numbers (JSON) and a figure for each. The runs of water are members of an ensemble in --out: runs that are
already there are not repeated. All take two minutes on two cores with --quick, and about 70 in full.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Literal, NamedTuple

from tyro.conf import Positional

from openmm_sier.cli.pool import Member, ensemble
from openmm_sier.measure.report import duration
from studies.command import Settings
from studies.paper import dipole, free_rotation, liquids, water, water_runs
from studies.records import Record
from studies.report import SILENT, Report, Table

#: The module that executes the members of the ensemble.
MEMBER = "studies.paper.member"


@dataclass(frozen=True)
class PaperSettings(Settings):
    """What is repeated.

    Attributes:
        experiment: one of the paper's three, or all.
        quick: less of everything, to see it work.
        processes: for the runs of water, at a time; one for each core unless given.
        phase_point: the runs of water from one of its starts alone, as in pme-3.
    """

    experiment: Positional[Literal["free-rotation", "dipole", "water", "all"]] = "all"
    quick: bool = False
    processes: int | None = None
    phase_point: str | None = None
    out: Path = Path("sier-paper")


def study(settings: PaperSettings, report: Report = SILENT) -> dict[str, Record]:
    """Carry out experiments, and write a JSON file and a figure for each.

    Returns:
        What was found, by experiment.

    Raises:
        EnsembleError: runs of water failed.
        ValueError: there is no such phase point.
    """
    if settings.phase_point is not None:
        _run_phase_point(settings, settings.phase_point, report)
        return {}
    chosen = EXPERIMENTS if settings.experiment == "all" else {settings.experiment: EXPERIMENTS[settings.experiment]}
    return {name: _carry_out(name, experiment, settings, report) for name, experiment in chosen.items()}


def _carry_out(name: str, experiment: Experiment, settings: PaperSettings, report: Report) -> Record:
    begun = perf_counter()
    record = experiment.find(settings, report)
    seconds = perf_counter() - begun
    for table in experiment.tables(record):
        report.table(table)
    paths = [settings.out / f"{name}.json", settings.out / f"{name}.png"]
    record.write(paths[0])
    experiment.figure(record, paths[1])
    report.note(f"{name}: {duration(seconds)}; written {', '.join(map(str, paths))}")
    return record


def _rotate_freely(settings: PaperSettings, report: Report) -> Record:
    chosen = free_rotation.QUICK if settings.quick else free_rotation.FreeRotationSettings()
    return free_rotation.find(replace(chosen, seed=settings.seed), report)


def _turn_in_field(settings: PaperSettings, report: Report) -> Record:
    chosen = dipole.QUICK if settings.quick else dipole.DipoleSettings()
    return dipole.find(replace(chosen, seed=settings.seed), report)


def _simulate_water(settings: PaperSettings, report: Report) -> Record:
    chosen = _water_settings(settings)
    points = water_runs.phase_points(chosen)
    shared = ("--seed", str(settings.seed), *(["--quick"] if settings.quick else []))
    members = [Member(p.name, ("water", "--phase-point", p.name, *shared), module=MEMBER) for p in points]
    place = settings.out / "water"
    ensemble(members, place, processes=settings.processes, report=report)
    made = [run for point in points for run in water_runs.read_runs(place / point.name)]
    return water.evaluate(chosen, liquids.water_box(chosen.molecules).edge, made)


def _run_phase_point(settings: PaperSettings, name: str, report: Report) -> None:
    """Make the runs of water from one phase point, which is a member of the ensemble."""
    chosen = _water_settings(settings)
    point = water_runs.phase_point(name, chosen)
    water_runs.make_runs(liquids.water_box(chosen.molecules), point, chosen, settings.out, report)


def _water_settings(settings: PaperSettings) -> water_runs.WaterSettings:
    return replace(water_runs.QUICK if settings.quick else water_runs.WaterSettings(), seed=settings.seed)


class Experiment(NamedTuple):
    """Functions that find the numbers, and make tables of text and the figure of them."""

    find: Callable[[PaperSettings, Report], Record]
    tables: Callable[[Record], list[Table]]
    figure: Callable[[Record, Path], None]


#: In the order of the paper.
EXPERIMENTS = {
    "free-rotation": Experiment(_rotate_freely, free_rotation.tables, free_rotation.figure),
    "dipole": Experiment(_turn_in_field, dipole.tables, dipole.figure),
    "water": Experiment(_simulate_water, water.tables, water.figure),
}
