"""Energy error by the settings of the System: tolerance and balance of PME, cut-off, switch; SIER4G beside Verlet.

    python -m studies.defaults                                 the whole table: 192 runs of 1 ps
    python -m studies.defaults --tolerance 5e-4 --starts 1     some of it

Each run is kept in defaults.jsonl as soon as it is done, and is not repeated: a command that was stopped goes on where
it was. The table of all runs there is defaults.json.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Literal, NamedTuple

import pandas as pd

from openmm_sier.measure import forcefields
from openmm_sier.measure.forcefields import Interactions
from studies import boxes, records
from studies.command import chosen, claim, command
from studies.methods import CONSTANT_ENERGY
from studies.records import Record
from studies.report import SILENT, Report, Table
from studies.sampling import GridSettings, conserved

#: What makes a cell of the table.
CELL = ["tolerance", "cutoff", "switch", "balanced"]

Choice = tuple[Literal["no", "yes"], ...]


@dataclass(frozen=True)
class DefaultsSettings(GridSettings):
    """Settings of the table.

    Attributes:
        tolerance: OpenMM's ewaldErrorTolerance.
        cutoff: nm.
        switch: whether Lennard-Jones is switched off from five sixths of the cut-off, or jumps there.
        balanced: whether the sums of PME are balanced, or split as OpenMM does it.
        methods: by name.
        dt: simulated time per force evaluation, fs.
    """

    tolerance: tuple[float, ...] = (5e-4, 1e-4, 1e-5)
    cutoff: tuple[float, ...] = (0.9, 1.0)
    switch: Choice = ("no", "yes")
    balanced: Choice = ("no", "yes")
    methods: tuple[str, ...] = ("verlet", "sier4g")
    dt: float = 2.0
    equilibrate: float = 2.0


class Task(NamedTuple):
    """One run."""

    settings: DefaultsSettings
    cell: tuple[float, float, str, str]
    method: str
    seed: int

    @property
    def point(self) -> dict[str, Any]:
        """What identifies the run."""
        cell = dict(zip(CELL, self.cell, strict=True))
        return cell | {"method": CONSTANT_ENERGY[self.method].name, "seed": self.seed}


def run(task: Task) -> dict[str, Any]:
    """A run with its `percent`, rms(H)/rms(V)."""
    settings, (tolerance, cutoff, switch, balanced) = task.settings, task.cell
    interactions = Interactions(cutoff, None if switch == "yes" else 0.0, tolerance)
    system = forcefields.read_box(settings.box, settings.forcefield, interactions=interactions).system
    if balanced == "no":
        boxes.split_by_openmm(system)
    liquid = replace(settings.start(task.seed), system=system)
    found, _ = conserved(liquid, CONSTANT_ENERGY[task.method], settings.dt, settings.time)
    return task.point | {"percent": found["percent"]}


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
    chosen(settings.methods, CONSTANT_ENERGY, "method")
    cells = product(settings.tolerance, settings.cutoff, settings.switch, settings.balanced)
    tasks = [Task(settings, *each) for each in product(cells, settings.methods, settings.seeds)]
    for made in records.make_missing(path, tasks, run, settings.processes):
        report.note(", ".join(f"{name} {value}" for name, value in made.items()))
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
