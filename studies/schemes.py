"""Energy conservation of the schemes for a given number of forces.

    python -m studies.schemes [BOX.pdb] [--schemes verlet sier4g] [--dt 1 2] [--starts 4]

compares energy error and drift of every scheme and of OpenMM's Verlet against the simulated time per force evaluation,
from several starts. Each run is kept in schemes.jsonl as soon as it is done, and is not repeated: a command that was
stopped goes on where it was, and commands with other boxes, schemes or steps and one `--out` add to the same table.
Writes schemes.json and schemes.png from all runs there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from openmm_sier.dynamics.schemes import DRIFT, KICK, alternating
from openmm_sier.measure.observables import energy_error
from openmm_sier.measure.statistics import slope_and_error
from studies import records, style
from studies.command import BoxSettings, chosen, claim, command
from studies.methods import CONSTANT_ENERGY, OTHERS, Method, of_scheme
from studies.records import Record
from studies.report import SILENT, Report
from studies.sampling import Liquid, Unstable, equilibrated_liquid, follow

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
class SchemesSettings(BoxSettings):
    """Settings of the comparison; the seeds of the starts follow `seed`.

    Attributes:
        dt: simulated time per force evaluation, fs.
        schemes: by name, all unless given; palindromes also by their fractions, such as drift:0.1189,0.2962,0.3811.
        starts: equilibrated phase points, from which all runs start.
        time: of each run, ps.
        equilibrate: before them, ps.
        tolerance: OpenMM's ewaldErrorTolerance.
    """

    dt: tuple[float, ...] = (1.0, 2.0, 3.0, 4.0, 5.0)
    schemes: tuple[str, ...] = ()
    starts: int = 4
    time: float = 1.0
    equilibrate: float = 3.0
    tolerance: float = 1e-4

    @property
    def liquid(self) -> str:
        """Name of the box, and of the force field if it is not that of the box."""
        return ", ".join([self.box.stem, *(Path(file).stem for file in self.forcefield)])


def run_missing(settings: SchemesSettings, path: Path, report: Report = SILENT) -> None:
    """Make the runs that a file lacks, and add each to it.

    A run has its step in fs, `percent` for rms(H)/rms(V) in per cent (see
    `openmm_sier.measure.observables.energy_error`), the drift of the energy of the whole box in kJ/mol/ps, and why it
    ended early, if it did: `broken`.

    Raises:
        ValueError: a scheme is unknown.
    """
    methods = methods_of(settings.schemes)
    done = {(*(run[name] for name in POINT), run["seed"]) for run in records.kept_runs(path)}

    @cache
    def start(seed: int) -> Liquid:
        kept = path.with_name(f"start of {settings.liquid}, seed {seed}.xml")
        mine = replace(settings, seed=seed)
        return equilibrated_liquid(mine, settings.equilibrate, report, settings.tolerance, kept)

    seeds = range(settings.seed, settings.seed + settings.starts)
    for seed, dt, method in product(seeds, settings.dt, methods):
        if (settings.liquid, method.name, dt, seed) in done:
            continue
        run = {"liquid": settings.liquid, "seed": seed} | _run(start(seed), method, dt, settings.time, report)
        records.keep_run(path, run)
        form = "rms(H)/rms(V) = {percent:.3f} %, drift {drift:+.2f} kJ/mol/ps"
        told = f"broke down ({run['broken']})" if run["broken"] else records.cell(form, run)
        report.note(f"{method.name} at {dt:g} fs per force, seed {seed}: {told}")


def _run(liquid: Liquid, method: Method, dt: float, time: float, report: Report) -> dict[str, Any]:
    run = {
        "method": method.name,
        "order": method.order,
        "forces": method.forces,
        "step": dt * method.forces,
        "fs_per_force": dt,
        "percent": math.nan,
        "drift": math.nan,
        "broken": "",
    }
    try:
        series = follow(liquid, method, dt, time, report=report).series
    except Unstable as error:
        return run | {"broken": str(error)}
    run["percent"] = 100 * energy_error(series.total, series.potential)
    run["drift"] = slope_and_error(series.time, series.total).value
    return run


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
    first, starts = runs.iloc[0], len(runs)
    point = {name: first[name] for name in ("liquid", "method", "order", "forces", "step", "fs_per_force")}
    point |= {"starts": starts, "broken": next((reason for reason in runs["broken"] if reason), "")}
    for name in ("percent", "drift"):
        point[name] = runs[name].mean(skipna=False)
        point[f"{name}_error"] = runs[name].std(skipna=False) / math.sqrt(starts)
    return point | {"least": runs["percent"].min(skipna=False), "most": runs["percent"].max(skipna=False)}


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
    """Make the runs that are missing in the directory `out`, and write schemes.json and schemes.png."""
    shared = {name: settings.recorded()[name] for name in ("temperature", "time", "equilibrate", "tolerance")}
    methods_of(settings.schemes)
    claim(settings.out / "schemes-settings.json", shared)
    path = settings.out / "schemes.jsonl"
    run_missing(settings, path, report)
    runs = pd.DataFrame(records.kept_runs(path)).replace({None: math.nan})
    rows = points(runs)
    report.table(records.table(f"Conservation of energy, {settings.time:g} ps each", rows, COLUMNS, left=2))
    if rows["liquid"].nunique() > 1:
        report.table(records.table("Mean over liquids that have all", over_liquids(rows), MEANS))
    for (liquid, dt), mine in rows.dropna(subset=["percent"]).groupby(["liquid", "fs_per_force"], sort=False):
        best = mine.loc[mine["percent"].idxmin()]
        report.note(f"least energy error of {liquid} at {dt:g} fs per force: {best['method']}, {best['percent']:.3f} %")
    record = Record(shared, {"rows": rows, "runs": runs}, {})
    record.write(settings.out / "schemes.json")
    figure(record, settings.out / "schemes.png")
    return record


def figure(record: Record, path: Path) -> None:
    """Energy error of the first liquid against simulated time per force, one line per scheme."""
    rows = record.tables["rows"]
    first = rows["liquid"].iloc[0]
    rows, liquid = rows[rows["liquid"] == first], style.MODELS.get(first, first)
    usual = rows[(rows["method"] == REFERENCE) & (rows["fs_per_force"] == USUAL)]
    with style.figure(path, 1) as (made, (axes,)):
        style.curves(axes, rows, "fs_per_force", "percent")
        for value in usual["percent"]:
            axes.axhline(value, color=style.GREY, lw=1, zorder=0, label=f"{REFERENCE}, {USUAL:g} fs")
        axes.set(yscale="log", ylabel="rms(H)/rms(V) (%)", title=f"Energy error, {liquid}")
        axes.set_xlabel("simulated time per force evaluation (fs)")
        axes.yaxis.set_major_formatter("{x:g}")
        style.shared_legend(made, axes)


main = command(SchemesSettings, study, __doc__, __name__)
