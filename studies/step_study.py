"""Properties of a liquid against the step, from the members of an ensemble.

    openmm-sier ensemble systems/step-study.toml --out step-study
    python -m studies.step_study step-study/* --skip 5 --out step-study-figure
    python -m studies.step_study

Density, energy, diffusion and temperatures by box, method and step, with standard errors, and how far energy and
diffusion are from those at the shortest step. Runs that differ in their seeds alone count as one; unfinished runs are
left out. Writes step-study.json, step-study.md and step-study.png. Without runs the numbers are those in
`studies/data`.
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
from openmm_sier.measure.statistics import Estimate, pooled
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

COLUMNS = {
    "box": "{box}",
    "method": "{method}",
    "step, fs": "{step:g}",
    "fs per force": "{fs_per_force:g}",
    "runs": "{runs}",
    "ps": "{time:.4g}",
} | {heading: f"{{{key}_text}}" for key, heading in MEASURED.items()}

#: Properties of which the tables of deviations tell.
COMPARED = {"energy": "Potential energy, kJ/mol", "diffusion": "Self-diffusion, 10⁻⁹ m²/s"}

#: Left out of the reference: its bath heats the liquid at any step (`studies.checks.andersen_oscillators`).
HEATED = "OpenMM Verlet"

#: fs by which the points of different methods are shifted apart.
APART = 0.03

#: Settings that must be the same in all runs, so that points differ in box, method and step alone.
SHARED = ("temperature", "pressure")


#: The numbers of the documentation.
KEPT = Path(__file__).parent / "data" / "step-study.json"


@dataclass(frozen=True)
class StepSettings(Settings):
    """What is read.

    Attributes:
        runs: checkpoints, or directories of an ensemble's members; none: the numbers of the documentation.
        skip: ps to leave out at the beginning of each run.
    """

    runs: Positional[tuple[Path, ...]] = ()
    skip: float = 0.0

    ANY_SIGN: ClassVar[tuple[str, ...]] = ("skip",)


def study(settings: StepSettings, report: Report = SILENT) -> Record:
    """Read runs, and write the table and the figure.

    Raises:
        RunError: temperatures or pressures differ, or no run is finished.
        RecordError, OSError: as their messages say.
    """
    record = _measured(settings, report) if settings.runs else records.read(KEPT)
    tables = [table(record), *(deviations(record, key) for key in COMPARED)]
    for made in tables:
        report.table(made)
    (settings.out / "step-study.md").write_text("\n".join(records.markdown(made) for made in tables))
    record.write(settings.out / "step-study.json")
    figure(record, settings.out / "step-study.png")
    return record


def _measured(settings: StepSettings, report: Report) -> Record:
    points = _finished(settings.runs, report)
    first = points[0][0].plan
    rows = in_order(with_shared_errors(pd.DataFrame([_row(point, settings.skip) for point in points])))
    pressure = f", {first.pressure:g} bar" if first.moves_volume else ""
    title = f"Water against the step, {first.temperature:g} K{pressure}"
    return Record(settings.recorded(), {"rows": rows}, {"title": title})


def _finished(paths: Sequence[Path], report: Report) -> list[list[FinishedRun]]:
    """The finished runs, by what they have in common."""
    begun = []
    for path in paths:
        if path.is_dir() and not (path / "run.chk").exists():
            report.note(f"left out: {path} has no checkpoint yet")
        else:
            begun.append(path)
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


def table(record: Record) -> Table:
    """The rows as text."""
    return records.table(record.notes["title"], records.with_text(record.tables["rows"], *MEASURED), COLUMNS, left=2)


def deviations(record: Record, key: str) -> Table:
    """How far a property is from its mean over the rows of the shortest step at which it is known, by box.

    Those rows are chosen by their step, not by their results; the weights are inverse squares of the errors. Errors of
    differences have that of the mean in them.
    """
    rows = record.tables["rows"].dropna(subset=[key])
    error = f"{key}_error"
    found: dict[tuple[str, str], dict[str, str]] = {}
    for box, own in rows.groupby("box", sort=False):
        cold = own[own["method"] != HEATED]
        shortest = cold["fs_per_force"].min()
        reference = cold[cold["fs_per_force"] == shortest]
        weights = reference[error] ** -2
        mean, doubt = np.average(reference[key], weights=weights), weights.sum() ** -0.5
        found.setdefault(("mean at the shortest step", f"{shortest:g}"), {})[box] = str(Estimate(mean, doubt))
        for _, row in own[own["fs_per_force"] > shortest].iterrows():
            difference = Estimate(row[key] - mean, math.hypot(row[error], doubt))
            found.setdefault((row["method"], f"{row['fs_per_force']:g}"), {})[box] = str(difference)
    boxes = list(rows["box"].unique())
    lines = [[*point, *(texts.get(box, "-") for box in boxes)] for point, texts in found.items()]
    return Table(
        f"{COMPARED[key]}, less its mean at the shortest step",
        ["method", "fs per force", *(style.MODELS.get(box, box) for box in boxes)],
        lines,
    )


def figure(record: Record, path: Path) -> None:
    """A row of panels for each box: properties against simulated time per force evaluation, with standard errors."""
    from matplotlib.figure import Figure

    rows = record.tables["rows"]
    boxes = list(rows["box"].unique())
    with context():
        made = Figure(figsize=(4.2 * len(PROPERTIES), 0.7 + 3.3 * len(boxes)), layout="constrained")
        made.suptitle(record.notes["title"], x=0.01, ha="left", fontsize=14, fontweight="bold")
        grid = made.subplots(len(boxes), len(PROPERTIES), squeeze=False, sharex=True)
        for box, line in zip(boxes, grid, strict=True):
            line[0].set_title(style.MODELS.get(box, box))
            for key, axes in zip(PROPERTIES, line, strict=True):
                style.curves(axes, rows[rows["box"] == box], "fs_per_force", key, apart=APART)
                axes.set(
                    xlim=(0, None),
                    ylabel=PROPERTIES[key][1],
                    title=style.MODELS.get(box, box) if key == "density" else "",
                )
        for axes in grid[-1]:
            axes.set_xlabel("simulated time per force evaluation (fs)")
        handles, labels = grid[0][0].get_legend_handles_labels()
        made.legend(handles, labels, loc="outside upper right", ncols=max(1, len(labels)), fontsize=10)
        made.savefig(path)


main = command(StepSettings, study, __doc__, __name__)
