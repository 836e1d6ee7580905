"""The command `openmm-sier study`: properties of a liquid against the step, from the members of an ensemble."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from openmm_sier.cli import records
from openmm_sier.cli.console import REPORT, note, table
from openmm_sier.cli.plan import CONTINUED, Plan, RunError, noted_plan
from openmm_sier.cli.properties import ROWS, estimated, read_runs
from openmm_sier.measure import properties
from studies import style
from studies.step_study import COLUMNS, StepRow, markdown, step_figure, step_table, with_shared_errors

#: Settings in which runs of one point may differ.
FREE = ("seed", "out", "report", "bodies", "bodies_every", "checkpoint_every")

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
    first = next(iter(points.values()))[0][1]
    rows = with_shared_errors([_row(paths, skip) for paths in points.values()])
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


def _finished(runs: Sequence[Path]) -> dict[tuple, list[tuple[Path, Plan]]]:
    """The finished runs, by what they have in common."""
    points: dict[tuple, list[tuple[Path, Plan]]] = {}
    first: tuple[Path, Plan] | None = None
    for path in runs:
        checkpoint = path / "run.chk" if path.is_dir() else path
        if path.is_dir() and not checkpoint.exists():
            note(f"left out: {path} has no checkpoint yet")
            continue
        _, notes = records.read_checkpoint(checkpoint)
        plan = noted_plan(checkpoint, notes["plan"])
        if notes["step"] < plan.steps:
            note(f"left out: {checkpoint} is at step {notes['step']} of {plan.steps}")
            continue
        first = first or (checkpoint, plan)
        _check_alike(checkpoint, plan, *first)
        names = [name for name in (*CONTINUED, "box", "steps") if name not in FREE]
        points.setdefault(tuple(str(getattr(plan, name)) for name in names), []).append((checkpoint, plan))
    if not points:
        raise RunError("no run is at its end")
    return points


def _check_alike(checkpoint: Path, plan: Plan, other: Path, reference: Plan) -> None:
    for name in SHARED:
        one, two = getattr(plan, name), getattr(reference, name)
        if one != two:
            raise RunError(f"{checkpoint} has {name} {one}, {other} has {two}: a study is of one state of the liquid")


def _row(point: Sequence[tuple[Path, Plan]], skip: float) -> StepRow:
    """One point of the figure, from runs that differ in their seeds alone."""
    runs = read_runs([path for path, _ in point], None, skip)
    plan = runs[0].plan
    name = f"{plan.method.name} HMC" if plan.ensemble == "hmc" else plan.method.name
    found = {}
    for row in ROWS:
        if row.key in COLUMNS:
            given = [value for value in estimated(row, runs).values() if value is not None]
            if given:
                found[row.key] = properties.pooled(given)
    time = sum(float(np.ptp(run.log["Time (ps)"])) for run in runs)
    return StepRow(Path(plan.box or plan.out).stem, name, plan.dt, plan.dt / plan.method.forces, len(runs), time, found)
