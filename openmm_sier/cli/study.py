"""The command `openmm-sier study`: properties of a liquid against the step, from the members of an ensemble."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from openmm_sier.cli.console import REPORT, note, table
from openmm_sier.cli.finished_runs import FinishedRun, check_alike, open_runs
from openmm_sier.cli.plan import RunError
from openmm_sier.cli.properties import ROWS, estimated, read_runs
from openmm_sier.measure.statistics import pooled
from studies import style
from studies.step_study import COLUMNS, StepRow, markdown, step_figure, step_table, with_shared_errors

#: Settings that must be the same in all runs, so that points differ in box, method and step alone.
SHARED = ("temperature", "pressure")


def study(runs: Sequence[Path], skip: float, out: Path) -> None:
    """Run `openmm-sier study`.

    Args:
        runs: checkpoints, or directories of an ensemble's members; unfinished runs are left out.
        skip: ps to leave out at the beginning of each run.
        out: directory for the table and the figure.

    Raises:
        RunError: temperatures or pressures differ, or no run is finished.
        RecordError, NoLiquidError, OSError: as their messages say.
    """
    points = _finished(runs)
    first = points[0][0].plan
    rows = with_shared_errors([_row(point, skip) for point in points])
    head, cells = step_table(rows)
    pressure = f", {first.pressure:g} bar" if first.moves_volume else ""
    title = f"Water against the step, {first.temperature:g} K{pressure}"
    table(title, head, cells, 2)
    out.mkdir(parents=True, exist_ok=True)
    (out / "step-study.md").write_text(markdown(rows))
    written = [out / "step-study.md"]
    if style.can_draw(REPORT):
        step_figure(rows, title, out / "step-study.png")
        written.append(out / "step-study.png")
    note(f"wrote {', '.join(map(str, written))}")


def _finished(paths: Sequence[Path]) -> list[list[FinishedRun]]:
    """The finished runs, by what they have in common."""
    begun = []
    for path in paths:
        if path.is_dir() and not (path / "run.chk").exists():
            note(f"left out: {path} has no checkpoint yet")
        else:
            begun.append(path)
    points: dict[tuple, list[FinishedRun]] = {}
    for run in open_runs(begun):
        if not run.complete:
            note(f"left out: {run.checkpoint} is at step {run.notes['step']} of {run.plan.steps}")
            continue
        points.setdefault(tuple(run.settings().values()), []).append(run)
        first = next(iter(points.values()))[0]
        check_alike(run, first, SHARED, "a study is of one state of the liquid")
    if not points:
        raise RunError("no run is at its end")
    return list(points.values())


def _row(point: Sequence[FinishedRun], skip: float) -> StepRow:
    """One point of the figure, from runs that differ in their seeds alone."""
    runs = read_runs(point, None, skip)
    plan = runs[0].plan
    name = f"{plan.method.name} HMC" if plan.ensemble == "hmc" else plan.method.name
    found = {}
    for row in ROWS:
        if row.key in COLUMNS:
            given = [value for value in estimated(row, runs).values() if value is not None]
            if given:
                found[row.key] = pooled(given)
    time = sum(float(np.ptp(run.log["Time (ps)"])) for run in runs)
    return StepRow(Path(plan.box or plan.out).stem, name, plan.dt, plan.dt / plan.method.forces, len(runs), time, found)
