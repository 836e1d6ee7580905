"""Averages of rigid water in a heat bath by the number of substeps of the native engine, compared with exact ones.

    python -m studies.native.substeps [BOX.pdb] [--substeps 1 2 3] [--steps 9 10] [--time 100] [--starts 2]

SIER2 moves water with hydrogens of 4 dalton. With n substeps its drift has 2n - 1 steps of RATTLE, where the exact
engine rotates molecules exactly. Hybrid Monte Carlo has no error of the step. Temperatures are those of velocities at
the end of steps. Each run is kept in native-substeps.jsonl as soon as it is done and is not repeated; runs with other
seeds add to the same averages. Writes native-substeps.json.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd

from studies import heat_bath, records, text
from studies.command import SYSTEMS, command
from studies.heat_bath import BathSettings
from studies.hmc import trials
from studies.methods import HEAVY, in_bath
from studies.records import Record, Task
from studies.report import SILENT, Report

#: What is averaged, with its heading.
AVERAGED = {key: heat_bath.AVERAGED[key] for key in ("translation", "rotation", "potential")}

#: What a run differs by from the others, beside its seed.
POINT = ["method", "step", "engine", "substeps"]

#: Trials of steps that small boxes of water bear.
EXACT = trials.METHODS[trials.LONGER]

COLUMNS = {
    "method": "{method}",
    "step, fs": "{step:g}",
    "engine": "{engine}",
    "substeps": "{substeps}",
    "ps": "{time:g}",
    **{heading: f"{{{key}_text}}" for key, heading in AVERAGED.items()},
}


@dataclass(frozen=True, kw_only=True)
class SubstepSettings(BathSettings):
    """Choose what is compared; the seeds of runs follow `seed`.

    Attributes:
        box: PDB file of water of three sites.
        substeps: numbers of them on the native engine.
        steps: of SIER2, fs.
    """

    box: Path = field(default=SYSTEMS / "tip3p-512.pdb", kw_only=False)
    time: float = 100.0
    starts: int = 2
    substeps: tuple[int, ...] = (1, 2, 3)
    steps: tuple[float, ...] = (9.0, 10.0)

    SHARED = ("temperature", "tolerance", "equilibrate", "friction", "pressure", "time", "box")


def tasks(settings: SubstepSettings) -> Iterator[Task]:
    """Return all runs that the settings ask for, seed by seed."""
    engines = [("exact", ""), *(("native", number) for number in settings.substeps)]
    points = [
        {"method": "SIER2", "step": step, "engine": engine, "substeps": number}
        for step, (engine, number) in product(settings.steps, engines)
    ]
    points.append({"method": EXACT.method.name, "step": EXACT.step, "engine": "exact", "substeps": ""})
    for seed, point in product(range(settings.seed, settings.seed + settings.starts), points):
        yield Task(settings, point | {"seed": seed})


def run(task: Task) -> dict[str, Any]:
    """Return what is kept of a run."""
    point, settings, method = task.point, task.settings, EXACT
    if point["method"] == "SIER2":
        method = in_bath(engine=point["engine"], substeps=point["substeps"] or None).at(point["step"], **HEAVY)
    return point | {"time": settings.time} | heat_bath.measure(settings, method, point["seed"], at_ends=True)


def study(settings: SubstepSettings, report: Report = SILENT) -> Record:
    """Make the runs that are missing in the directory `out`, and write native-substeps.json."""
    form = "{method}, {step:g} fs, {engine} engine, substeps {substeps}, seed {seed}: done"
    runs = records.all_runs(settings, "native-substeps", tasks(settings), run, report, form)
    rows = pd.DataFrame(
        mine.iloc[0][POINT].to_dict() | {"time": mine["time"].sum()} | records.pooled(mine, AVERAGED)
        for _, mine in runs.groupby(POINT, sort=False)
    )
    report.table(f"{settings.box.stem} in a heat bath", text.table(rows, COLUMNS))
    return Record(settings.shared(), {"rows": rows}, {}).write(settings.out / "native-substeps.json")


main = command(SubstepSettings, study, __doc__, __name__)
