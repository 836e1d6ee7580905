"""The command `openmm-sier summary`: means over runs that differ in their seeds, with their errors."""

import json
import math
import os
from pathlib import Path
from typing import Any

from openmm_sier.analysis.statistics import Estimate
from openmm_sier.cli import pictures
from openmm_sier.cli.console import note, table
from openmm_sier.cli.files import records
from openmm_sier.cli.files.places import check_place, refuse_to_replace
from openmm_sier.cli.findings import findings
from openmm_sier.cli.logged_runs import Runs
from openmm_sier.cli.results import Quantity
from openmm_sier.cli.settling import read_runs, verdict
from openmm_sier.version import __version__


def execute(logs: list[Path], json: Path | None, plot: Path | None, skip: float | None, overwrite: bool) -> None:
    """Run `openmm-sier summary`.

    Args:
        logs: of runs of one kind.
        json: file for the numbers; None for none.
        plot: the picture; None for none.
        skip: part that means leave out, ps or trials; None for the part before equilibrium.
        overwrite: whether existing files are replaced.

    Raises:
        RunError, RecordError, OSError, ModuleNotFoundError: as their messages say.
    """
    if json:
        check_place(json, logs)
        if not overwrite:
            refuse_to_replace(json)
    if plot:
        pictures.check(plot, logs, overwrite, outputs=[json] if json else [])
    runs = read_runs(logs, skip)
    means = runs.means()
    rows = [(over_all.name, str(over_all)) for over_all, _ in means]
    table(runs.title, ("", f"mean over {_counted(runs)}"), rows)
    note(verdict(runs))
    for sentence in findings(runs, [over_all for over_all, _ in means]):
        note(sentence)
    written = [path for path in (json, plot) if path]
    if json:
        records.replace(json, memoryview(_as_json(runs, means).encode()))
    if plot:
        pictures.draw(runs, plot)
    if written:
        note(f"wrote {', '.join(map(str, written))}")


def _counted(runs: Runs) -> str:
    return "1 run" if len(runs.runs) == 1 else f"{len(runs.runs)} runs"


def _number(quantity: Quantity) -> float:
    return quantity.value.value if isinstance(quantity.value, Estimate) else quantity.value


def _as_json(runs: Runs, means: list[tuple[Quantity, list[Quantity]]]) -> str:
    """Return all numbers as JSON, with null for unknown ones."""
    content = {
        "openmm_sier": __version__,
        "runs": [os.fspath(run.path) for run in runs.runs],
        "title": runs.title,
        "clock": runs.unit,
        "length": runs.length,
        "left_out": runs.begin,
        "moved_before": list(runs.moving),
        "settled": False if runs.drifting else None if runs.unclear else True,
        "drifting": list(runs.drifting),
        "too_short_to_tell": list(runs.unclear),
        "means": [
            {
                "name": over_all.name,
                "unit": over_all.unit,
                **_pair(over_all),
                "runs": [_pair(single) for single in by_run],
            }
            for over_all, by_run in means
        ],
    }
    return json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _pair(quantity: Quantity) -> dict[str, Any]:
    value, error = _number(quantity), quantity.value.error if isinstance(quantity.value, Estimate) else math.nan
    return {name: number if math.isfinite(number) else None for name, number in (("value", value), ("error", error))}
