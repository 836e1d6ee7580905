"""Energy error of SIER4G and Verlet by settings of the System: tolerance and balance of PME, cut-off, switch.

    python -m studies.defaults                                 the whole table: 192 runs of 1 ps
    python -m studies.defaults --tolerance 5e-4 --starts 1     some of it

Each run is kept in defaults.jsonl as soon as it is done, and is not repeated: a command that was stopped goes on where
it was. The table of all runs there is defaults.json.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Any, ClassVar, Literal

import pandas as pd

from openmm_sier.inputs import forcefields
from openmm_sier.inputs.forcefields import Interactions
from studies import boxes, records, text
from studies.command import chosen, command
from studies.methods import CONSTANT_ENERGY
from studies.records import Record, Task
from studies.report import SILENT, Report
from studies.sampling import GridSettings, conserved

#: What makes a cell of the table.
CELL = ["tolerance", "cutoff", "switch", "balanced"]

Choice = tuple[Literal["no", "yes"], ...]


@dataclass(frozen=True, kw_only=True)
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

    SHARED: ClassVar[tuple[str, ...]] = ("box", "temperature", "dt", "time", "equilibrate")


def run(task: Task) -> dict[str, Any]:
    """Return a run with its `percent`, rms(H)/rms(V)."""
    settings, point = task.settings, task.point
    interactions = Interactions(point["cutoff"], None if point["switch"] == "yes" else 0.0, point["tolerance"])
    system = forcefields.read_box(settings.box, settings.forcefield, interactions=interactions).system
    if point["balanced"] == "no":
        boxes.split_by_openmm(system)
    liquid = replace(settings.start(point["seed"]), system=system)
    result, _ = conserved(liquid, CONSTANT_ENERGY[task.method], settings.dt, settings.time)
    return point | {"percent": result["percent"]}


def study(settings: DefaultsSettings, report: Report = SILENT) -> Record:
    """Make the runs that are missing in the directory `out`, and write defaults.json."""
    chosen(settings.methods, CONSTANT_ENERGY, "method")
    cells = product(settings.tolerance, settings.cutoff, settings.switch, settings.balanced)
    tasks = [
        Task(settings, dict(zip(CELL, cell, strict=True)) | {"method": CONSTANT_ENERGY[name].name, "seed": seed}, name)
        for cell, name, seed in product(cells, settings.methods, settings.seeds)
    ]
    form = "{method}, {tolerance:g}, {cutoff:g} nm, switch {switch}, balanced {balanced}, seed {seed}: {percent:.3g} %"
    runs = records.all_runs(settings, "defaults", tasks, run, report, form)
    record = Record(settings.recorded(), {"rows": runs}, {})
    title = f"rms(H)/rms(V)/%, {settings.dt:g} fs per force evaluation: mean and range over starts"
    report.table(title, ranges(runs))
    return record.write(settings.out / "defaults.json")


def ranges(runs: pd.DataFrame) -> pd.DataFrame:
    """Return a table of text with mean and range over the starts, one column for each method."""
    extremes = runs.groupby([*CELL, "method"])["percent"].agg(["mean", "min", "max"]).reset_index()
    columns = {"ewaldErrorTolerance": "{tolerance:g}", "cut-off/nm": "{cutoff:g}"}
    columns |= text.columns("switch", "balanced") | {"{method}": "{mean:.3g} ({min:.2g} to {max:.2g})"}
    return text.table(extremes.sort_values("tolerance", ascending=False, kind="stable"), columns)


main = command(DefaultsSettings, study, __doc__, __name__)
