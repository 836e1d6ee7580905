"""Finished runs as other commands read them: plans, logs and pressure tensors, and what may be pooled."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from openmm_sier.cli.files import checkpoints
from openmm_sier.cli.files.records import RecordError, read_log
from openmm_sier.cli.plan import Plan, RunError, noted_plan
from openmm_sier.measure.statistics import FEWEST
from openmm_sier.observe import conservation, pressure

#: Settings in which runs that are pooled may differ: their noise, their length, and their files. All others define the
#: liquid, its state and how it is followed.
FREE = (
    *("seed", "steps", "out", "report", "bodies", "pressure_tensor", "unwrapped"),
    *("every", "report_every", "checkpoint_every", "bodies_every", "pressure_tensor_every"),
)

#: Columns that are NaN throughout where the run has no such motion, no box, or a bath whose heat is not counted.
UNKNOWN = {"Conserved Energy (kJ/mole)", *conservation.TEMPERATURES, "Box Volume (nm^3)", "Density (g/mL)"}


class FinishedRun(NamedTuple):
    """A run on disk, at its last checkpoint.

    Attributes:
        checkpoint: its path.
        plan: of the run.
        notes: of the checkpoint.
    """

    checkpoint: Path
    plan: Plan
    notes: dict[str, Any]

    @property
    def complete(self) -> bool:
        """Whether the run is at its end."""
        return self.notes["step"] >= self.plan.steps

    def settings(self, but: str = "") -> dict[str, str]:
        """What runs that are pooled have in common, by name; one may be left out."""
        found = {field.name: str(getattr(self.plan, field.name)) for field in fields(Plan)}
        for name in ("box", "topology"):
            if (path := getattr(self.plan, name)) is not None:
                found[name] = os.path.realpath(path)
        return {name: value for name, value in found.items() if name not in (*FREE, but)}

    def log(self, skip: float) -> dict[str, np.ndarray]:
        """Columns of the log without the first `skip` ps.

        Raises:
            RunError: fewer than `FEWEST` rows remain.
            RecordError: a column, a number or a row is missing, or there is one too many.
            OSError: the file cannot be read.
        """
        return self._rows("log", "report", conservation.COLUMNS, 0, skip)

    def tensors(self, skip: float) -> dict[str, np.ndarray] | None:
        """Columns of the pressure tensors likewise; None where the run wrote none."""
        if self.plan.pressure_tensor is None:
            return None
        return self._rows("tensors", "pressure_tensor", pressure.COLUMNS, 1, skip)

    def _rows(self, noted: str, option: str, columns: Sequence[str], first: int, skip: float) -> dict[str, np.ndarray]:
        """Columns of a file, whose first row is that of the start (0) or one interval later (1)."""
        path, interval = Path(getattr(self.plan, option)), self.plan.interval(getattr(self.plan, f"{option}_every"))
        values, count = read_log(path), self.notes[noted]["count"]
        if missing := [name for name in columns if name not in values]:
            raise RecordError(f"{path}: expected a heading with {missing[0]}")
        if not np.array_equal(values["Step"], interval * (first + np.arange(count))):
            raise RecordError(
                f"{path}: expected {count} rows, one every {interval} steps, as the checkpoint notes: the run still "
                "goes on, was cut off (run --restart mends that), or the file is not that of the checkpoint"
            )
        for name in columns:
            wrong = ~np.isfinite(values[name])
            if wrong.any() and not (name in UNKNOWN and np.isnan(values[name]).all()):
                raise RecordError(f"{path}: {name} is {values[name][wrong][0]} in row {wrong.argmax() + 1}")
        kept = values["Time (ps)"] >= skip
        if kept.sum() < FEWEST:
            raise RunError(f"{path} has {kept.sum()} rows after {skip:g} ps, {FEWEST} are needed")
        return {name: column[kept] for name, column in values.items()}


def open_runs(paths: Sequence[Path]) -> list[FinishedRun]:
    """Runs by their checkpoints, or by directories of an ensemble's members.

    Raises:
        RunError: two are one run.
        RecordError, OSError: a checkpoint cannot be read.
    """
    runs: list[FinishedRun] = []
    seen: dict[tuple, Path] = {}
    for path in paths:
        checkpoint = path / "run.chk" if path.is_dir() else path
        notes = checkpoints.read_notes(checkpoint)
        run = FinishedRun(checkpoint, noted_plan(checkpoint, notes["plan"]), notes)
        # No two runs arrive at one energy to all digits.
        end = (run.plan.seed, notes["step"], notes.get("potential_energy"), *run.settings().values())
        if end in seen:
            raise RunError(f"{checkpoint} is the same run as {seen[end]}: it would count twice")
        seen[end] = checkpoint
        runs.append(run)
    return runs


def check_alike(run: FinishedRun, first: FinishedRun, names: Sequence[str], reason: str) -> None:
    """Refuse a run whose settings of these names are not those of the first.

    Raises:
        RunError: with the first difference and the reason.
    """
    mine, others = run.settings(), first.settings()
    for name in names:
        if mine[name] != others[name]:
            raise RunError(f"{run.checkpoint} has {name} {mine[name]}, {first.checkpoint} has {others[name]}: {reason}")
