"""Properties of a liquid against the step, from the members of an ensemble.

    openmm-sier ensemble systems/step-study.toml --out step-study
    python -m studies.step_study step-study/* --skip 5 --out step-study-figure

Density, energy, diffusion and temperatures by box, method and step, with standard errors, and how far density and
energy are from the exact averages of hybrid Monte Carlo, and diffusion from that at the shortest step. Runs that differ
in their seeds alone count as one; unfinished runs are left out. Writes step-study.json and step-study.png.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd
from tyro.conf import Positional

from openmm_sier.cli.finished_runs import FinishedRun, check_alike, open_runs
from openmm_sier.cli.plan import RunError
from openmm_sier.cli.properties import ROWS, estimated, read_runs
from openmm_sier.measure.figures import context
from openmm_sier.measure.statistics import pooled
from studies import records, style
from studies.command import Settings, command
from studies.records import Record
from studies.report import SILENT, Report, Table

#: Properties by their keys in rows, with their names in the table and labels in the figure.
PROPERTIES = {
    "density": ("density, g/cm³", "density (g/cm³)"),
    "energy": ("potential energy, kJ/mol", "potential energy (kJ/mol)"),
    "diffusion": ("self-diffusion in the box, 10⁻⁹ m²/s", "self-diffusion (10⁻⁹ m²/s)"),
}

#: What follows from runs, with its heading in the table.
MEASURED = {"translation": "T_trans, K", "rotation": "T_rot, K"} | {key: name for key, (name, _) in PROPERTIES.items()}

COLUMNS = records.columns("box", "method", "step", "fs_per_force", "runs", "time") | {
    heading: f"{{{key}_text}}" for key, heading in MEASURED.items()
}

#: What the figure says.
TITLE = "Verlet with AndersenThermostat leaves the exact averages;\nthe others stay near them (grey: two errors)"

#: What ends the name of a method whose averages have no error of the step.
EXACT = " HMC"

#: Left out of the reference: its bath heats the liquid at any step (`studies.checks.andersen_oscillators`).
HEATED = "OpenMM Verlet"

#: fs by which the points of different methods are shifted apart.
APART = 0.06

#: Settings that must be the same in all runs, so that points differ in box, method and step alone.
SHARED = ("temperature", "pressure")


@dataclass(frozen=True)
class StepSettings(Settings):
    """What is read.

    Attributes:
        runs: checkpoints, or directories of an ensemble's members.
        skip: ps to leave out at the beginning of each run.
    """

    runs: Positional[tuple[Path, ...]] = ()
    skip: float = 0.0

    ANY_SIGN: ClassVar[tuple[str, ...]] = ("skip",)


def study(settings: StepSettings, report: Report = SILENT) -> Record:
    """Read runs, and write the record and the figure.

    Raises:
        RunError: temperatures or pressures differ, or no run is finished.
        RecordError, OSError: as their messages say.
    """
    points = _finished(settings.runs, report)
    first = points[0][0].plan
    rows = in_order(with_shared_errors(pd.DataFrame([_row(point, settings.skip) for point in points])))
    pressure = f", {first.pressure:g} bar" if first.moves_volume else ""
    title = f"Water against the step, {first.temperature:g} K{pressure}"
    record = Record(settings.recorded(), {"rows": rows}, {"title": title})
    for made in tables(record):
        report.table(made)
    record.write(settings.out / "step-study.json")
    figure(record, settings.out / "step-study.png")
    return record


def _finished(paths: Sequence[Path], report: Report) -> list[list[FinishedRun]]:
    """The finished runs, by what they have in common."""
    begun = [path for path in paths if not path.is_dir() or (path / "run.chk").exists()]
    for path in sorted(set(paths) - set(begun)):
        report.note(f"left out: {path} has no checkpoint yet")
    points: dict[tuple, list[FinishedRun]] = {}
    for run in open_runs(begun):
        if not run.complete:
            report.note(f"left out: {run.checkpoint} is at step {run.notes['step']} of {run.plan.steps}")
            continue
        points.setdefault(tuple(run.settings().values()), []).append(run)
        first = next(iter(points.values()))[0]
        check_alike(run, first, SHARED, "a study is of one state of the liquid")
    if not points:
        raise RunError("no run is at its end")
    return list(points.values())


def _row(point: Sequence[FinishedRun], skip: float) -> dict[str, Any]:
    """One point of the figure, from runs that differ in their seeds alone; what they do not give is NaN."""
    runs = read_runs(point, None, skip)
    plan = runs[0].plan
    scheme = plan.method.scheme
    row = {
        "box": Path(plan.box or plan.out).stem,
        "method": f"{plan.method.name} HMC" if plan.ensemble == "hmc" else plan.method.name,
        "step": plan.dt,
        "fs_per_force": plan.dt / (scheme.force_evaluations if scheme else 1),
        "runs": len(runs),
        "time": sum(float(np.ptp(run.log["Time (ps)"])) for run in runs),
    }
    row |= {name: math.nan for key in MEASURED for name in (key, f"{key}_error")}
    for each in ROWS:
        given = [value for value in estimated(each, runs).values() if value is not None] if each.key in MEASURED else []
        if given:
            row[each.key], row[f"{each.key}_error"] = pooled(given)[:2]
    return row


def with_shared_errors(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows whose errors fall as the root of their length, with one factor for each box, method and property.

    A run of a few correlation times underestimates the correlation, and so its own error. Liquids relax alike at all
    steps, except by hybrid Monte Carlo with shorter trials. So the square of the factor is the mean over rows of one
    box and method, weighted by their lengths.
    """
    rows = rows.copy()
    for _, alike in rows.groupby(["box", "method"]):
        for key in MEASURED:
            known = alike.dropna(subset=[f"{key}_error"])
            if len(known):
                square = np.average(known["time"] * known[f"{key}_error"] ** 2, weights=known["time"])
                shared = (square / alike["time"]) ** 0.5
                rows.loc[alike.index, f"{key}_error"] = shared.where(alike[key].notna())
    return rows


def in_order(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows by box and method, in the order in which these first appear, and by step."""
    boxes, methods = (list(rows[name].unique()) for name in ("box", "method"))
    places = {"box": boxes.index, "method": methods.index, "fs_per_force": float}
    return rows.sort_values(list(places), key=lambda column: column.map(places[column.name]), ignore_index=True)


def tables(record: Record) -> list[Table]:
    """The rows as text, and the tables of deviations, in the order of `PROPERTIES`."""
    rows = record.tables["rows"]
    found = deviations(rows)
    return [
        records.table(record.notes["title"], rows, COLUMNS, left=2),
        *(_deviations(found[found["property"] == key], PROPERTIES[key][0]) for key in PROPERTIES),
    ]


def deviations(rows: pd.DataFrame) -> pd.DataFrame:
    """How far properties are from the exact averages, by box.

    Hybrid Monte Carlo has no error of the step, so that the mean over its rows is exact. It has no dynamics: the
    diffusion is compared with the mean over the rows of the shortest step at which it is known, without those whose
    bath heats the liquid. Rows of a reference are chosen by their method and step, not by their results, and weighted
    by the inverse squares of their errors. What has no reference is left out.

    Returns:
        For each property, box, method and step the `reference` and its error, and the `difference` from it with that of
        the row alone; rows of which the reference is made have their own difference too.
    """
    found = []
    for key in PROPERTIES:
        for _, own in rows.dropna(subset=[key]).groupby("box", sort=False):
            of = _reference(own[np.isfinite(own[f"{key}_error"])])
            if of.empty:
                continue
            weights = of[f"{key}_error"] ** -2
            mean, doubt = np.average(of[key], weights=weights), weights.sum() ** -0.5
            told = own[["box", "method", "fs_per_force"]].assign(property=key, reference=mean, reference_error=doubt)
            found.append(told.assign(difference=own[key] - mean, difference_error=own[f"{key}_error"]))
    return pd.concat(found, ignore_index=True)


def _reference(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows of one box and property of which the reference is the mean."""
    exact = rows[rows["method"].str.endswith(EXACT)]
    cold = rows[rows["method"] != HEATED]
    return exact if len(exact) else cold[cold["fs_per_force"] == cold["fs_per_force"].min()]


def _deviations(found: pd.DataFrame, name: str) -> Table:
    """A line for each method and step, with a column for each box; errors have that of the reference in them."""
    error = np.hypot(found["difference_error"], found["reference_error"])
    own = found.assign(box=found["box"].replace(style.MODELS), value=found["difference"], value_error=error)
    reference = own.drop_duplicates("box").assign(method="reference", fs_per_force="")
    reference = reference.assign(value=reference["reference"], value_error=reference["reference_error"])
    columns = records.columns("method", "fs_per_force") | {"-": "{value_text}"}
    return records.table(f"{name}, less the reference", pd.concat([reference, own]), columns, across="box")


def figure(record: Record, path: Path) -> None:
    """A row of panels for each property and one for each box: differences from the exact averages, by step.

    The band is two errors of the reference, and so are the bars.
    """
    from matplotlib.figure import Figure

    found = deviations(record.tables["rows"])
    found = found[~found["method"].str.endswith(EXACT)].assign(difference_error=2 * found["difference_error"])
    boxes = list(found["box"].unique())
    with context():
        made = Figure(figsize=(3.1 * len(boxes) + 1, 0.9 + 2.4 * len(PROPERTIES)), layout="constrained")
        made.suptitle(TITLE, x=0.01, ha="left", fontsize=16, fontweight="bold")
        grid = made.subplots(len(PROPERTIES), len(boxes), squeeze=False, sharex=True, sharey="row")
        for key, line in zip(PROPERTIES, grid, strict=True):
            line[0].set_ylabel(f"Δ {PROPERTIES[key][1]}")
            for box, axes in zip(boxes, line, strict=True):
                mine = found[(found["box"] == box) & (found["property"] == key)]
                for doubt in mine["reference_error"][:1]:
                    axes.axhspan(-2 * doubt, 2 * doubt, color="0.85", zorder=0)
                axes.axhline(0, color=style.GREY, lw=1)
                style.curves(axes, mine, "fs_per_force", "difference", apart=APART, lw=1, capsize=0)
        for box, axes in zip(boxes, grid[0], strict=True):
            axes.set_title(style.MODELS.get(box, box))
        for axes in grid[-1]:
            axes.set_xlabel("fs per force")
        handles, labels = grid[0][0].get_legend_handles_labels()
        made.legend(handles, labels, loc="outside lower center", ncols=max(1, len(labels)), fontsize=12)
        made.savefig(path)


main = command(StepSettings, study, __doc__, __name__)
