"""The numerical tests of van Zon and Schofield (2007), repeated, with the paper's values beside ours."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from openmm_sier.measure.report import SILENT, Report, Table, duration
from openmm_sier.studies import style
from openmm_sier.studies.paper import dipole, figures, free_rotation, output, reference, tables, water
from openmm_sier.studies.paper.methods import Progress

#: In the order of the paper.
EXPERIMENTS = ("free-rotation", "dipole", "water")

#: Where results go if nothing else is said.
DIRECTORY = Path("sier-paper")

#: Minutes that experiments take on two cores of a server of the 2020s: in their quick form, and in full. Water is that
#: with Numba, an extra; without it the molecular cut-off alone takes two hours in full.
EXPECTED_MINUTES = {"free-rotation": (0.3, 6), "dipole": (0.1, 1), "water": (1, 90)}


class Finding(NamedTuple):
    """The result of an experiment, its tables, and the rows of its CSV file."""

    result: Any
    tables: list[Table]
    rows: tuple


def run(
    experiment: str, quick: bool = False, out: Path | None = None, seed: int = 1, report: Report = SILENT
) -> dict[str, Finding]:
    """Carry out experiments, and write numbers (JSON, CSV) and a figure (PNG) for each.

    Args:
        experiment: one of `EXPERIMENTS`, or "all".
        quick: less of everything, within two minutes for all of them on two cores.
        out: directory for the files; None is `DIRECTORY`. It is made if it does not exist.
        seed: of everything random.
        report: gets tables, notes and progress.

    Returns:
        What was found, by experiment.

    Raises:
        ValueError: there is no such experiment.
        ModuleNotFoundError: matplotlib or mpmath is missing.
        ImportError: OpenMM is too old for the liquid.
    """
    if experiment not in (*EXPERIMENTS, "all"):
        raise ValueError(f"the experiment must be one of {', '.join((*EXPERIMENTS, 'all'))}, got {experiment!r}")
    chosen = EXPERIMENTS if experiment == "all" else (experiment,)
    # What is missing is to be said before hours of computing.
    style.require()
    if "free-rotation" in chosen:
        reference.require()
    directory = DIRECTORY if out is None else Path(out)
    directory.mkdir(parents=True, exist_ok=True)
    minutes = sum(EXPECTED_MINUTES[name][0 if quick else 1] for name in chosen)
    report.note(f"{', '.join(chosen)}: expected to take about {minutes:.2g} min on two cores")
    return {name: _carry_out(name, quick, seed, directory, report) for name in chosen}


def _carry_out(name: str, quick: bool, seed: int, directory: Path, report: Report) -> Finding:
    experiment = _EXPERIMENTS[name]
    begin = time.perf_counter()
    with report.progress(name) as advance:
        found = experiment.find(quick, seed, lambda what, fraction: advance(fraction, what))
    seconds = time.perf_counter() - begin
    for table in found.tables:
        report.table(table)
    paths = [directory / f"{name}.{ending}" for ending in ("json", "csv", "png")]
    output.write_json(paths[0], found.result, seconds)
    output.write_csv(paths[1], found.rows)
    experiment.draw(found.result, paths[2])
    report.note(f"{name}: {duration(seconds)}; written {', '.join(str(path) for path in paths)}")
    return found


def _free_rotation(quick: bool, seed: int, show: Progress) -> Finding:
    settings = free_rotation.QUICK if quick else free_rotation.FreeRotationSettings()
    result = free_rotation.rotate_freely(replace(settings, seed=seed), show)
    return Finding(result, [tables.tau_table(result), tables.cost_table(result)], result.curves)


def _dipole(quick: bool, seed: int, show: Progress) -> Finding:
    settings = dipole.QUICK if quick else dipole.DipoleSettings()
    result = dipole.turn_in_field(replace(settings, seed=seed), show)
    return Finding(result, [tables.dipole_energy_table(result), tables.dipole_momentum_table(result)], result.entries)


def _water(quick: bool, seed: int, show: Progress) -> Finding:
    settings = water.QUICK if quick else water.WaterSettings()
    result = water.simulate_water(replace(settings, seed=seed), show)
    shown = [tables.water_table(result, kind) for kind in result.settings.kinds]
    return Finding(result, [*shown, tables.crossing_table(result)], result.points)


class _Experiment(NamedTuple):
    """Functions that find the numbers (quick, seed, progress) and draw the figure (result, path)."""

    find: Callable[[bool, int, Progress], Finding]
    draw: Callable[[Any, Path], None]


_EXPERIMENTS = {
    "free-rotation": _Experiment(_free_rotation, figures.free_rotation),
    "dipole": _Experiment(_dipole, figures.dipole),
    "water": _Experiment(_water, figures.water),
}
