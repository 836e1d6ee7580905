"""Energy conservation of the schemes for a given number of forces.

    python -m studies.schemes [BOX.pdb] [--schemes verlet sier4g] [--dt 1 2] [--starts 4]

compares energy error and drift of every scheme and of OpenMM's Verlet against the simulated time per force evaluation,
from several starts. Each run is kept in schemes.jsonl as soon as it is done, and is not repeated: a command that was
stopped goes on where it was, and commands with other boxes, schemes or steps and one `--out` add to the same table.
Writes schemes.json from all runs there.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any, ClassVar

import numpy as np
import pandas as pd

from studies import records, text
from studies.command import chosen, command
from studies.methods import CONSTANT_ENERGY
from studies.records import Record, Task
from studies.report import SILENT, Report
from studies.sampling import GridSettings, conserved, over_starts

#: What the errors of a liquid are divided by: OpenMM's Verlet, and its usual simulated time per force evaluation in fs.
REFERENCE, USUAL = CONSTANT_ENERGY["verlet"].name, 2.0

#: What a point of the table has in common; its runs differ in their seeds alone.
POINT = ["liquid", "method", "fs_per_force"]

COLUMNS = text.columns(
    "liquid", "method", "order", "forces", "step", "fs_per_force", "starts", "percent", "relative", "drift"
)


@dataclass(frozen=True, kw_only=True)
class SchemesSettings(GridSettings):
    """Settings of the comparison.

    Attributes:
        dt: simulated time per force evaluation, fs.
        schemes: by name, all unless given.
        tolerance: OpenMM's ewaldErrorTolerance.
    """

    dt: tuple[float, ...] = (1.0, 2.0, 3.0, 4.0, 5.0)
    schemes: tuple[str, ...] = ()
    tolerance: float = 1e-4

    SHARED: ClassVar[tuple[str, ...]] = ("temperature", "time", "equilibrate", "tolerance")


def run(task: Task) -> dict[str, Any]:
    """A run with its step in fs, and its figures, see `studies.sampling.conserved`."""
    settings, fs_per_force = task.settings, task.point["fs_per_force"]
    method = CONSTANT_ENERGY[task.method]
    start = settings.start(task.point["seed"], settings.tolerance)
    row = task.point | {"order": method.order, "forces": method.forces, "step": fs_per_force * method.forces}
    return row | conserved(start, method, fs_per_force, settings.time)[0]


def points(runs: pd.DataFrame) -> pd.DataFrame:
    """A row for each liquid, scheme and simulated time per force: means over the starts, with standard errors.

    What is unknown is NaN: a mean where a start broke down, an error where there is one start, and `relative` in a
    liquid without runs of `REFERENCE` at its `USUAL` step.
    """
    rows = pd.DataFrame([_point(group) for _, group in runs.groupby(POINT, sort=False)])
    is_usual = (rows["method"] == REFERENCE) & (rows["fs_per_force"] == USUAL)
    verlet = rows[is_usual].set_index("liquid")
    divisor, its_error = (rows["liquid"].map(verlet[name]) for name in ("percent", "percent_error"))
    rows["relative"] = rows["percent"] / divisor
    shares = np.hypot(rows["percent_error"] / rows["percent"], its_error / divisor)
    rows["relative_error"] = (rows["relative"] * shares).mask(is_usual, 0.0)
    return rows


def _point(runs: pd.DataFrame) -> dict[str, Any]:
    point = {name: runs.iloc[0][name] for name in ("liquid", "method", "order", "forces", "step", "fs_per_force")}
    return point | over_starts(runs, ("percent", "drift"))


def study(settings: SchemesSettings, report: Report = SILENT) -> Record:
    """Make the runs that are missing in the directory `out`, and write schemes.json."""
    chosen(settings.schemes, CONSTANT_ENERGY, "scheme")
    tasks = []
    for seed, dt, name in product(settings.seeds, settings.dt, settings.schemes or CONSTANT_ENERGY):
        point = {"liquid": settings.liquid, "method": CONSTANT_ENERGY[name].name, "fs_per_force": dt, "seed": seed}
        tasks.append(Task(settings, point, name))
    form = "{method} at {fs_per_force:g} fs per force, seed {seed}: {percent:.3f} %, drift {drift:+.2f} kJ/mol/ps"
    runs = records.all_runs(settings, "schemes", tasks, run, report, form)
    rows = points(runs)
    report.table(f"Conservation of energy, {settings.time:g} ps each", text.table(rows, COLUMNS))
    return Record(settings.shared(), {"rows": rows, "runs": runs}, {}).write(settings.out / "schemes.json")


main = command(SchemesSettings, study, __doc__, __name__)
