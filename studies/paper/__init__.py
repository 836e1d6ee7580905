"""The numerical tests of van Zon and Schofield (2007), repeated, with the paper's values beside ours."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from openmm_sier.measure.ensemble import Member, ensemble
from openmm_sier.measure.report import SILENT, Advance, Report, Table, duration
from studies import style
from studies.paper import (
    dipole,
    figures,
    free_rotation,
    liquids,
    output,
    reference,
    start,
    tables,
    water,
    water_runs,
)
from studies.paper.methods import Progress

#: In the order of the paper.
EXPERIMENTS = ("free-rotation", "dipole", "water")

#: Where results go if nothing else is said.
DIRECTORY = Path("sier-paper")

#: Minutes that experiments take on two cores of a server of the 2020s, in their quick form and in full. The times of
#: water are with Numba, an extra; without it the molecular cut-off alone takes two hours in full.
EXPECTED_MINUTES = {"free-rotation": (0.3, 6), "dipole": (0.1, 1), "water": (1, 60)}


class Finding(NamedTuple):
    """The result of an experiment, its tables, and the rows of its CSV file."""

    result: Any
    tables: list[Table]
    rows: tuple


def run(
    experiment: str,
    quick: bool = False,
    out: Path | None = None,
    seed: int = 1,
    report: Report = SILENT,
    processes: int | None = None,
) -> dict[str, Finding]:
    """Carry out experiments, and write numbers (JSON, CSV) and a figure (PNG) for each.

    The runs of water are members of an ensemble in `out`: runs that are already there are not repeated.

    Args:
        experiment: one of `EXPERIMENTS`, or "all".
        quick: less of everything, so that all experiments take two minutes on two cores.
        out: directory for the files; None is `DIRECTORY`. It is made if it does not exist.
        seed: of everything random.
        report: gets tables, notes and progress.
        processes: for the runs of water, how many at a time; None: one for each core.

    Returns:
        What was found, by experiment.

    Raises:
        ValueError: there is no such experiment.
        ModuleNotFoundError: matplotlib or mpmath is missing.
        ImportError: OpenMM is too old for the liquid.
        EnsembleError: runs of water failed.
    """
    if experiment not in (*EXPERIMENTS, "all"):
        raise ValueError(f"the experiment must be one of {', '.join((*EXPERIMENTS, 'all'))}, got {experiment!r}")
    chosen = EXPERIMENTS if experiment == "all" else (experiment,)
    # Missing packages must be reported before hours of computing.
    style.require()
    if "free-rotation" in chosen:
        reference.require()
    if "water" in chosen:
        liquids.require()
    directory = DIRECTORY if out is None else Path(out)
    directory.mkdir(parents=True, exist_ok=True)
    minutes = sum(EXPECTED_MINUTES[name][0 if quick else 1] for name in chosen)
    report.note(f"{', '.join(chosen)}: expected to take about {minutes:.2g} min on two cores")
    order = Order(quick, seed, directory, report, processes)
    return {name: _carry_out(name, order) for name in chosen}


def run_phase_point(name: str, quick: bool, out: Path, seed: int, report: Report = SILENT) -> None:
    """Make the runs of water from one phase point, which is a member of the ensemble that `run` starts.

    Args:
        name: of the point, as in "pme-3".
        quick, seed, report: as for `run`.
        out: directory for the file of the runs.

    Raises:
        ValueError: there is no such phase point.
    """
    settings = _water_settings(quick, seed)
    point = water_runs.phase_point(name, settings)
    out.mkdir(parents=True, exist_ok=True)
    box = start.water_box(settings.molecules, settings.cutoffs, settings.temperature, seed)
    with report.progress(name) as advance:
        water_runs.make_runs(box, point, settings, out, _shown_by(advance))


class Order(NamedTuple):
    """The settings of experiments, see `run`."""

    quick: bool
    seed: int
    directory: Path
    report: Report
    processes: int | None


def _carry_out(name: str, order: Order) -> Finding:
    experiment = _EXPERIMENTS[name]
    begin = time.perf_counter()
    found = experiment.find(order)
    seconds = time.perf_counter() - begin
    for table in found.tables:
        order.report.table(table)
    paths = [order.directory / f"{name}.{ending}" for ending in ("json", "csv", "png")]
    output.write_json(paths[0], found.result, seconds)
    output.write_csv(paths[1], found.rows)
    experiment.draw(found.result, paths[2])
    order.report.note(f"{name}: {duration(seconds)}; written {', '.join(str(path) for path in paths)}")
    return found


def _free_rotation(order: Order) -> Finding:
    settings = free_rotation.QUICK if order.quick else free_rotation.FreeRotationSettings()
    with order.report.progress("free-rotation") as advance:
        result = free_rotation.rotate_freely(replace(settings, seed=order.seed), _shown_by(advance))
    return Finding(result, [tables.tau_table(result), tables.cost_table(result)], result.curves)


def _dipole(order: Order) -> Finding:
    settings = dipole.QUICK if order.quick else dipole.DipoleSettings()
    with order.report.progress("dipole") as advance:
        result = dipole.turn_in_field(replace(settings, seed=order.seed), _shown_by(advance))
    return Finding(result, [tables.dipole_energy_table(result), tables.dipole_momentum_table(result)], result.entries)


def _shown_by(advance: Advance) -> Progress:
    return lambda what, fraction: advance(fraction, what)


def _water(order: Order) -> Finding:
    settings = _water_settings(order.quick, order.seed)
    points = water_runs.phase_points(settings)
    shared = ("--seed", str(order.seed), *(["--quick"] if order.quick else []))
    members = [Member(point.name, ("paper", "water", "--phase-point", point.name, *shared)) for point in points]
    place = order.directory / "water"
    ensemble(members, place, processes=order.processes, report=order.report)
    runs: dict[str, list[water_runs.Run]] = {kind: [] for kind in settings.kinds}
    for point in points:
        runs[point.kind] += water_runs.read_runs(place / point.name)
    box = start.water_box(settings.molecules, settings.cutoffs, settings.temperature, settings.seed)
    result = water.result_of(settings, box.origin, box.edge, runs)
    shown = [tables.water_table(result, kind) for kind in settings.kinds]
    return Finding(result, [*shown, tables.crossing_table(result)], result.points)


def _water_settings(quick: bool, seed: int) -> water_runs.WaterSettings:
    return replace(water_runs.QUICK if quick else water_runs.WaterSettings(), seed=seed)


class _Experiment(NamedTuple):
    """Functions that find the numbers, and draw the figure (result, path)."""

    find: Callable[[Order], Finding]
    draw: Callable[[Any, Path], None]


_EXPERIMENTS = {
    "free-rotation": _Experiment(_free_rotation, figures.free_rotation),
    "dipole": _Experiment(_dipole, figures.dipole),
    "water": _Experiment(_water, figures.water),
}
