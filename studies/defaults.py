"""Energy error by the settings of the System: tolerance and balance of PME, cut-off, switch; SIER4G beside Verlet.

    python -m studies.defaults                                 the whole table: 192 runs of 1 ps
    python -m studies.defaults --tolerance 5e-4 --starts 1     some of it

Each run is kept in defaults.jsonl as soon as it is done, and is not repeated: a command that was stopped goes on where
it was, and two commands with different seeds can share a directory. The table of all runs there is defaults.json.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any, Literal

import openmm
import pandas as pd

from openmm_sier.measure import forcefields
from openmm_sier.measure.forcefields import Interactions
from openmm_sier.measure.observables import energy_error
from studies import boxes, records
from studies.command import BoxSettings, chosen, claim, command
from studies.methods import CONSTANT_ENERGY, Method
from studies.records import Record
from studies.report import SILENT, Report, Table
from studies.sampling import Liquid, equilibrated_liquid, follow

#: What makes a cell of the table.
CELL = ["tolerance", "cutoff", "switch", "balanced"]

Choice = tuple[Literal["no", "yes"], ...]


@dataclass(frozen=True)
class DefaultsSettings(BoxSettings):
    """Settings of the table; the seeds of the starts follow `seed`.

    Attributes:
        tolerance: OpenMM's ewaldErrorTolerance.
        cutoff: nm.
        switch: whether Lennard-Jones is switched off from five sixths of the cut-off, or jumps there.
        balanced: whether the sums of PME are balanced, or split as OpenMM does it.
        methods: by name.
        dt: simulated time per force evaluation, fs.
        starts: equilibrated phase points, from which all runs start.
        time: of each run, ps.
        equilibrate: before them, ps.
    """

    tolerance: tuple[float, ...] = (5e-4, 1e-4, 1e-5)
    cutoff: tuple[float, ...] = (0.9, 1.0)
    switch: Choice = ("no", "yes")
    balanced: Choice = ("no", "yes")
    methods: tuple[str, ...] = ("verlet", "sier4g")
    dt: float = 2.0
    starts: int = 4
    time: float = 1.0
    equilibrate: float = 2.0


def systems(settings: DefaultsSettings) -> Iterator[tuple[dict[str, Any], openmm.System]]:
    """The box with all combinations of settings, each with its cell of the table."""
    for values in product(settings.tolerance, settings.cutoff, settings.switch, settings.balanced):
        tolerance, cutoff, switch, balanced = values
        interactions = Interactions(cutoff, None if switch == "yes" else 0.0, tolerance)
        box = forcefields.read_box(settings.box, settings.forcefield, interactions=interactions)
        system = box.system if balanced == "yes" else boxes.split_by_openmm(box.system)
        yield dict(zip(CELL, values, strict=True)), system


def percent(liquid: Liquid, method: Method, settings: DefaultsSettings, report: Report) -> float:
    """rms(H)/rms(V) of a run in per cent."""
    with warnings.catch_warnings():
        # This is what is measured here.
        warnings.filterwarnings("ignore", "PME is split as OpenMM does it")
        series = follow(liquid, method, settings.dt, settings.time, report=report).series
    return 100 * energy_error(series.total, series.potential)


def run_missing(settings: DefaultsSettings, path: Path, report: Report) -> None:
    """Make the runs that a file lacks, and add each to it."""
    methods = chosen(settings.methods, CONSTANT_ENERGY, "method")
    done = [{name: value for name, value in row.items() if name != "percent"} for row in records.kept_runs(path)]

    @cache
    def start(seed: int) -> Liquid:
        return equilibrated_liquid(replace(settings, seed=seed), settings.equilibrate, report)

    for cell, system in systems(settings):
        for seed, method in product(range(settings.seed, settings.seed + settings.starts), methods):
            row = cell | {"method": method.name, "seed": seed}
            if row not in done:
                row["percent"] = percent(replace(start(seed), system=system), method, settings, report)
                records.keep_run(path, row)
                report.note(", ".join(f"{name} {value}" for name, value in row.items()))


def table(runs: pd.DataFrame) -> pd.DataFrame:
    """Mean and range over the starts as text, one column for each method."""
    found = runs.groupby([*CELL, "method"])["percent"].agg(["mean", "min", "max"])
    text = [f"{row.mean:.3g} ({row.min:.2g} to {row.max:.2g})" for row in found.itertuples()]
    wide = pd.Series(text, found.index).unstack("method").fillna("-").reset_index()
    return wide.sort_values(CELL, ascending=[False, True, True, True], kind="stable")


def study(settings: DefaultsSettings, report: Report = SILENT) -> Record:
    """Make the runs that are missing in the directory `out`, and write defaults.json."""
    shared = {name: settings.recorded()[name] for name in ("box", "temperature", "dt", "time", "equilibrate")}
    claim(settings.out / "settings.json", shared)
    path = settings.out / "defaults.jsonl"
    run_missing(settings, path, report)
    record = Record(settings.recorded(), {"rows": pd.DataFrame(records.kept_runs(path))}, {})
    report.table(tables(record)[0])
    return record.write(settings.out / "defaults.json")


def tables(record: Record) -> list[Table]:
    """The table, for the report and the documentation."""
    wide = table(record.tables["rows"])
    columns = {
        "ewaldErrorTolerance": "{tolerance:g}",
        "cut-off/nm": "{cutoff:g}",
        "switch": "{switch}",
        "balanced": "{balanced}",
        **{name: f"{{{name}}}" for name in wide.columns if name not in CELL},
    }
    title = f"rms(H)/rms(V)/%, {record.settings['dt']:g} fs per force evaluation: mean and range over starts"
    return [records.table(title, wide, columns, left=4)]


main = command(DefaultsSettings, study, __doc__, __name__)
