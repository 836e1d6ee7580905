"""The numerical tests of van Zon and Schofield (2007), repeated, with the paper's values beside ours."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

#: In the order of the paper.
EXPERIMENTS = ("free-rotation", "dipole", "water")

#: Where results go if nothing else is said.
DIRECTORY = Path("sier-paper")

#: Minutes that experiments take on two cores of a server of the 2020s: in their quick form, and in full. Water is that
#: with Numba, an extra; without it the molecular cut-off alone takes two hours in full.
EXPECTED_MINUTES = {"free-rotation": (0.3, 6), "dipole": (0.1, 1), "water": (1, 90)}


class Report(NamedTuple):
    """What an experiment gave: the result, its tables, and the rows of its CSV file."""

    result: Any
    tables: list
    rows: tuple


def run(experiment: str, quick: bool = False, out: Path | None = None, seed: int = 1) -> None:
    """Carry out experiments, print their tables, and write numbers (JSON, CSV) and a figure (PNG) for each.

    Args:
        experiment: one of `EXPERIMENTS`, or "all".
        quick: less of everything, within two minutes for all of them on two cores.
        out: directory for the files; None is `DIRECTORY`. It is made if it does not exist.
        seed: of everything random.

    Raises:
        ValueError: there is no such experiment.
        ModuleNotFoundError: rich, matplotlib or mpmath is missing.
        ImportError: OpenMM is too old for the liquid.
    """
    if experiment not in (*EXPERIMENTS, "all"):
        raise ValueError(f"the experiment must be one of {', '.join((*EXPERIMENTS, 'all'))}, got {experiment!r}")
    chosen = EXPERIMENTS if experiment == "all" else (experiment,)
    # What is missing is to be said before hours of computing.
    from openmm_sier.studies import console
    from openmm_sier.studies.paper import figures, output, progress

    draw: dict[str, Callable[..., None]] = {
        "free-rotation": figures.free_rotation,
        "dipole": figures.dipole,
        "water": figures.water,
    }
    measure: dict[str, Callable[..., Report]] = {"free-rotation": _free_rotation, "dipole": _dipole, "water": _water}
    directory = DIRECTORY if out is None else Path(out)
    directory.mkdir(parents=True, exist_ok=True)
    minutes = sum(EXPECTED_MINUTES[name][0 if quick else 1] for name in chosen)
    console.note(f"{', '.join(chosen)}: expected to take about {minutes:.2g} min on two cores")
    for name in chosen:
        begin = time.perf_counter()
        with progress.Bar(name) as show:
            report = measure[name](quick, seed, show)
        seconds = time.perf_counter() - begin
        for table in report.tables:
            console.table(*table)
        paths = [directory / f"{name}.{ending}" for ending in ("json", "csv", "png")]
        output.write_json(paths[0], report.result, seconds)
        output.write_csv(paths[1], report.rows)
        draw[name](report.result, paths[2])
        console.note(f"{name}: {console.duration(seconds)}; written {', '.join(str(path) for path in paths)}")


def _free_rotation(quick: bool, seed: int, show) -> Report:
    from openmm_sier.studies.paper import free_rotation, reference, tables

    reference.require()
    settings = free_rotation.QUICK if quick else free_rotation.Settings()
    result = free_rotation.measure(replace(settings, seed=seed), show)
    return Report(result, [tables.tau_table(result), tables.cost_table(result)], result.curves)


def _dipole(quick: bool, seed: int, show) -> Report:
    from openmm_sier.studies.paper import dipole, tables

    result = dipole.measure(replace(dipole.QUICK if quick else dipole.Settings(), seed=seed), show)
    return Report(result, [tables.dipole_energy_table(result), tables.dipole_momentum_table(result)], result.entries)


def _water(quick: bool, seed: int, show) -> Report:
    from openmm_sier.studies.paper import tables, water

    result = water.measure(replace(water.QUICK if quick else water.Settings(), seed=seed), show)
    shown = [tables.water_table(result, kind) for kind in result.settings.kinds]
    return Report(result, [*shown, tables.crossing_table(result)], result.points)
