"""Energy conservation of the schemes for a given number of forces.

    python -m studies.schemes [BOX.pdb] [--schemes verlet sier4g] [--dt 1 2] [--starts 4]

compares energy error and drift of every scheme and of OpenMM's Verlet against the simulated time per force evaluation,
from several starts. Each run is kept in schemes.jsonl as soon as it is done, and is not repeated: a command that was
stopped goes on where it was, and commands with other boxes, schemes or steps and one `--out` add to the same table.
Writes schemes.json from all runs there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from openmm_sier.dynamics.schemes import DRIFT, KICK, alternating
from studies import records
from studies.command import chosen, claim, command
from studies.methods import CONSTANT_ENERGY, OTHERS, Method, of_scheme
from studies.records import Record
from studies.report import SILENT, Report
from studies.sampling import GridSettings, conserved, over_starts

#: Everything that can be compared, by the names that users give.
KNOWN: dict[str, Method] = CONSTANT_ENERGY | {name: of_scheme(scheme) for name, scheme in OTHERS.items()}

#: Palindromes of kicks and drifts by what stands before the colon; after it are the fractions up to the middle stage.
FIRST = {"kick": (KICK, DRIFT), "drift": (DRIFT, KICK)}

#: What the errors of a liquid are divided by: OpenMM's Verlet, and its usual simulated time per force evaluation in fs.
REFERENCE, USUAL = CONSTANT_ENERGY["verlet"].name, 2.0

#: What a point of the table has in common; its runs differ in their seeds alone.
POINT = ["liquid", "method", "fs_per_force"]

COLUMNS = {
    "liquid": "{liquid}",
    "scheme": "{method}",
    "order": "{order}",
    "forces a step": "{forces}",
    "step/fs": "{step:g}",
    "fs per force": "{fs_per_force:g}",
    "starts": "{starts}",
    "rms(H)/rms(V)/%": "{percent:.3g} ± {percent_error:.1g}",
    "range": "{least:.2g} to {most:.2g}",
    "over Verlet at 2 fs": "{relative:.2f} ± {relative_error:.2f}",
    "drift of the box/kJ/mol/ps": "{drift:.3f} ± {drift_error:.3f}",
}


def methods_of(names: Sequence[str]) -> list[Method]:
    """Methods by name; a palindrome that has none is kick:0.1932,0.5 or drift:0.1189,0.2962,0.3811, see `FIRST`.

    Raises:
        ValueError: a scheme is unknown, or fractions are not numbers that sum to one.
    """
    given = {name: palindrome(name) for name in names if name.partition(":")[0] in FIRST}
    return chosen(names, KNOWN | given, "scheme")


def palindrome(name: str) -> Method:
    """The palindrome of kicks and drifts that a name such as kick:0.1932,0.5 describes."""
    first, _, fractions = name.partition(":")
    return of_scheme(alternating(name, *FIRST[first], tuple(float(each) for each in fractions.split(","))))


#: Of `over_liquids`.
MEANS = {
    "scheme": "{method}",
    "fs per force": "{fs_per_force:g}",
    "over Verlet at 2 fs": "{relative:.2f} ± {relative_error:.2f}",
}


@dataclass(frozen=True)
class SchemesSettings(GridSettings):
    """Settings of the comparison.

    Attributes:
        dt: simulated time per force evaluation, fs.
        schemes: by name, all unless given; palindromes also by their fractions, such as drift:0.1189,0.2962,0.3811.
        tolerance: OpenMM's ewaldErrorTolerance.
    """

    dt: tuple[float, ...] = (1.0, 2.0, 3.0, 4.0, 5.0)
    schemes: tuple[str, ...] = ()
    tolerance: float = 1e-4


class Task(NamedTuple):
    """One run."""

    settings: SchemesSettings
    scheme: str
    fs_per_force: float
    seed: int

    @property
    def method(self) -> Method:
        (method,) = methods_of([self.scheme])
        return method

    @property
    def point(self) -> dict[str, Any]:
        """What identifies the run."""
        named = {"liquid": self.settings.liquid, "method": self.method.name}
        return named | {"fs_per_force": self.fs_per_force, "seed": self.seed}


def run(task: Task) -> dict[str, Any]:
    """A run with its step in fs, and its figures, see `studies.sampling.conserved`."""
    settings, method = task.settings, task.method
    start = settings.start(task.seed, settings.tolerance)
    found = task.point | {"order": method.order, "forces": method.forces, "step": task.fs_per_force * method.forces}
    return found | conserved(start, method, task.fs_per_force, settings.time)[0]


def points(runs: pd.DataFrame) -> pd.DataFrame:
    """A row for each liquid, scheme and simulated time per force: means over the starts, with standard errors.

    What is unknown is NaN: a mean where a start broke down, an error where there is one start, and `relative` in a
    liquid without runs of `REFERENCE` at its `USUAL` step.
    """
    rows = pd.DataFrame([_point(mine) for _, mine in runs.groupby(POINT, sort=False)])
    is_usual = (rows["method"] == REFERENCE) & (rows["fs_per_force"] == USUAL)
    verlet = rows[is_usual].set_index("liquid")
    divisor, its_error = (rows["liquid"].map(verlet[name]) for name in ("percent", "percent_error"))
    rows["relative"] = rows["percent"] / divisor
    shares = np.hypot(rows["percent_error"] / rows["percent"], its_error / divisor)
    rows["relative_error"] = (rows["relative"] * shares).mask(is_usual, 0.0)
    return rows


def _point(runs: pd.DataFrame) -> dict[str, Any]:
    point = {name: runs.iloc[0][name] for name in ("liquid", "method", "order", "forces", "step", "fs_per_force")}
    percent = runs["percent"]
    range_of = {"least": percent.min(skipna=False), "most": percent.max(skipna=False)}
    return point | over_starts(runs, ("percent", "drift")) | range_of


def over_liquids(rows: pd.DataFrame) -> pd.DataFrame:
    """Means of `relative` over the liquids, for each scheme and simulated time per force that all of them have."""
    known = rows.dropna(subset=["relative"])
    liquids = known["liquid"].nunique()
    means = []
    for (method, dt), mine in known.groupby(["method", "fs_per_force"], sort=False):
        if len(mine) == liquids:
            mean, error = mine["relative"].mean(), math.sqrt((mine["relative_error"] ** 2).sum()) / liquids
            means.append({"method": method, "fs_per_force": dt, "relative": mean, "relative_error": error})
    return pd.DataFrame(means, columns=["method", "fs_per_force", "relative", "relative_error"])


def study(settings: SchemesSettings, report: Report = SILENT) -> Record:
    """Make the runs that are missing in the directory `out`, and write schemes.json."""
    shared = {name: settings.recorded()[name] for name in ("temperature", "time", "equilibrate", "tolerance")}
    methods_of(settings.schemes)
    claim(settings.out / "schemes-settings.json", shared)
    path = settings.out / "schemes.jsonl"
    each = product(settings.seeds, settings.dt, settings.schemes or KNOWN)
    tasks = [Task(settings, scheme, dt, seed) for seed, dt, scheme in each]
    form = "{method} at {fs_per_force:g} fs per force, seed {seed}: {percent:.3f} %, drift {drift:+.2f} kJ/mol/ps"
    for made in records.make_missing(path, tasks, run, settings.processes):
        report.note(records.cell(form, made))
    runs = pd.DataFrame(records.kept_runs(path)).replace({None: math.nan})
    rows = points(runs)
    report.table(records.table(f"Conservation of energy, {settings.time:g} ps each", rows, COLUMNS, left=2))
    if rows["liquid"].nunique() > 1:
        report.table(records.table("Mean over liquids that have all", over_liquids(rows), MEANS))
    for (liquid, dt), mine in rows.dropna(subset=["percent"]).groupby(["liquid", "fs_per_force"], sort=False):
        best = mine.loc[mine["percent"].idxmin()]
        report.note(f"least energy error of {liquid} at {dt:g} fs per force: {best['method']}, {best['percent']:.3f} %")
    return Record(shared, {"rows": rows, "runs": runs}, {}).write(settings.out / "schemes.json")


main = command(SchemesSettings, study, __doc__, __name__)
