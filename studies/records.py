"""Results of studies: tables of pandas with the settings that gave them, as files and as text.

A column that has a standard error has it in another one, whose name ends in `_error`.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import platform
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

import pandas as pd

from openmm_sier.analysis import statistics
from openmm_sier.analysis.statistics import Estimate
from openmm_sier.dynamics import backend
from openmm_sier.dynamics.backend import threads
from openmm_sier.version import __version__
from studies.command import RunsSettings, claim
from studies.report import Report, Table

#: Packages that results can depend on.
PACKAGES = ("numpy", "openmm", "numba", "mpmath", "pandas")


@dataclass(frozen=True)
class Record:
    """The results of a study.

    Attributes:
        settings: of the study.
        tables: by their names.
        notes: further numbers that can be written as JSON.
    """

    settings: Mapping[str, Any]
    tables: Mapping[str, pd.DataFrame]
    notes: Mapping[str, Any]

    def write(self, path: Path) -> Record:
        """Write everything, and versions and machine, as JSON, with null for what is not finite; the record itself."""
        tables = {name: frame.to_dict("records") for name, frame in self.tables.items()}
        content = {**provenance(), "settings": self.settings, "notes": self.notes, "tables": tables}
        replace_file(path, json.dumps(_plain(content), indent=1, allow_nan=False, default=str) + "\n")
        return self


def read(path: Path) -> Record:
    """A record that was written.

    Raises:
        ValueError: the file is no such record.
        OSError: it cannot be read.
    """
    content = json.loads(path.read_text())
    if "tables" not in content:
        raise ValueError(f"{path} is no record of a study: it has no tables")
    tables = {name: pd.DataFrame(rows).replace({None: math.nan}) for name, rows in content["tables"].items()}
    return Record(content["settings"], tables, content["notes"])


def provenance() -> dict[str, Any]:
    """Versions and machine."""
    versions = {"openmm-sier": __version__, "python": platform.python_version()}
    for name in PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    machine = {"processor": processor(), "cores": threads.cores(), "threads": threads.count()}
    return {"versions": versions, "machine": machine | {"backend": backend.active().name}}


def processor() -> str:
    """The name of the processor."""
    information = Path("/proc/cpuinfo")
    for line in information.read_text().splitlines() if information.exists() else []:
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _plain(value: Any) -> Any:
    """A value as JSON can hold it."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def replace_file(path: Path, text: str) -> None:
    """Write a file, all of it or nothing."""
    temporary = path.with_name("new-" + path.name)
    temporary.write_text(text)
    temporary.replace(path)


# --- runs kept one by one ---


def kept_runs(path: Path) -> list[dict[str, Any]]:
    """The runs in a file, one of JSON on each line; none if there is no file yet."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def keep_run(path: Path, run: Mapping[str, Any]) -> None:
    """Add a run to a file as soon as it is made, so that a study that is stopped loses nothing."""
    with path.open("a") as file:
        file.write(json.dumps(_plain(run), allow_nan=False) + "\n")


class Identified(Protocol):
    """A run that may be made by another process."""

    @property
    def point(self) -> dict[str, Any]:
        """What identifies the run, a part of what is kept of it."""


class Task(NamedTuple):
    """A run of a study.

    Attributes:
        settings: of the study.
        point: what identifies the run, a part of what is kept of it.
        method: the name of its method for users, where it has one.
    """

    settings: Any
    point: dict[str, Any]
    method: str = ""


Some = TypeVar("Some", bound=Identified)


def make_missing(
    path: Path, tasks: Iterable[Some], run: Callable[[Some], dict[str, Any]], processes: int
) -> Iterator[dict[str, Any]]:
    """The runs that a file lacks, in the order in which they are done; each is added to the file first.

    Args:
        path: of the file, see `keep_run`.
        tasks: all that are wanted.
        run: a function of a module, which makes a run and gives what is to be kept, its point included.
        processes: that make runs at the same time, of one thread each.
    """
    kept = kept_runs(path)
    missing = [task for task in tasks if not any(task.point.items() <= each.items() for each in kept)]
    os.environ.setdefault("OPENMM_CPU_THREADS", "1")
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        for made in as_completed([pool.submit(run, task) for task in missing]):
            keep_run(path, made.result())
            yield made.result()


def pooled(runs: pd.DataFrame, names: Iterable[str]) -> dict[str, float]:
    """Means over runs of one kind, with errors; NaN where no run has a value."""
    found = {}
    for name in names:
        known = runs.reindex(columns=[name, f"{name}_error"]).dropna()
        estimates = [Estimate(*pair) for pair in known.to_numpy(dtype=float)]
        found[name], found[f"{name}_error"] = statistics.pooled(estimates)[:2] if estimates else (math.nan, math.nan)
    return found


def all_runs(
    settings: RunsSettings,
    name: str,
    tasks: Iterable[Task],
    run: Callable[[Task], dict[str, Any]],
    report: Report,
    form: str,
) -> pd.DataFrame:
    """All runs that `out` has of a study, after those were made that it lacks.

    Args:
        settings: of the study; those that are `SHARED` are noted beside the runs.
        name: of the study's files.
        tasks, run: see `make_missing`.
        report: gets a note of each run that is made.
        form: of the note, see `cell`; what has broken down has the reason.

    Raises:
        ValueError: the directory has runs of other settings.
    """
    claim(settings.out / f"{name}-settings.json", settings.shared())
    path = settings.out / f"{name}.jsonl"
    for made in make_missing(path, tasks, run, settings.processes):
        report.note(made.get("broken") or cell(form, made))
    return pd.DataFrame(kept_runs(path)).replace({None: math.nan})


# --- as text ---

#: Headings of what several studies have, by its name in their tables.
HEADINGS = {
    "label": "run",
    "fast": "fast forces",
    "step": "step/fs",
    "time": "ps",
    "length": "trial/fs",
    "percent": "rms(H)/rms(V)/%",
    "walk": "walk/%",
    "drift": "drift of the box/kJ/mol/ps",
    "spread": "sd/kT",
    "translation": "T_trans/K",
    "rotation": "T_rot/K",
    "difference": "T_rot - T_trans/K",
    "potential": "V/kJ/mol",
    "density": "g/cm³",
    "relative": "over Verlet at 2 fs",
}


def columns(*names: str) -> dict[str, str]:
    """Columns for `table`: values, with their errors where there are any; names that `HEADINGS` lacks are headings."""
    return {HEADINGS.get(name, name.replace("_", " ")): f"{{{name}_text}}" for name in names}


def table(title: str, frame: pd.DataFrame, columns: Mapping[str, str], left: int = 1, across: str = "") -> Table:
    """A table of text.

    Args:
        title: above the table.
        frame: of which each row becomes one.
        columns: for each heading what stands in its cells, see `cell`.
        left: number of leading columns that are aligned to the left, the others being numbers.
        across: a column of which each value becomes a column of the table. The last of `columns` is then what stands
            there, and the others tell the lines of the table; its heading, such as a unit, is added to the values
            unless it is "-".
    """
    rows = [[cell(form, row) for form in columns.values()] for row in frame.to_dict("records")]
    if not across:
        return Table(title, list(columns), rows, left)
    *leading, heading = columns
    values = list(dict.fromkeys(frame[across]))
    lines: dict[tuple[str, ...], dict[Any, str]] = {}
    for value, (*line, last) in zip(frame[across], rows, strict=True):
        lines.setdefault(tuple(line), {})[value] = last
    body = [[*line, *(cells.get(value, "-") for value in values)] for line, cells in lines.items()]
    return Table(title, [*leading, *(_heading(value, heading) for value in values)], body, len(leading))


def _heading(value: Any, unit: str) -> str:
    """The heading of a column for a value: a number has its unit after a space, a name after a comma."""
    number = isinstance(value, (int, float))
    name = f"{value:.6g}" if number else str(value)
    return name if unit == "-" else f"{name}{' ' if number else ', '}{unit}"


class _Known(dict[str, Any]):
    """A row in which `NAME_text` is a value with its error, and whatever else it does not have is not a number."""

    def __missing__(self, name: str) -> Any:
        of = name.removesuffix("_text")
        if of == name or of not in self:
            return math.nan
        value = self[of]
        if f"{of}_error" in self:
            return str(Estimate(value, self[f"{of}_error"]))
        if not isinstance(value, float):
            return str(value)
        return f"{value:.0f}" if value.is_integer() or abs(value) >= 1000 else f"{value:.3g}"


def cell(form: str, row: Mapping[str, Any]) -> str:
    """What stands in one cell.

    Args:
        form: such as "{rotation:.1f} ± {rotation_error:.1f}", or "{rotation_text}" for a value with its error as far as
            that is known.
        row: the numbers. What is not known, or not there, makes the cell "-".
    """
    text = form.format_map(_Known(row)).replace(" ± nan", "").replace("±nan", "")
    return "-" if "nan" in text else text


def markdown(made: Table) -> str:
    """A table for a page of documentation."""
    lines: Sequence[Sequence[str]] = [made.columns, ["---"] * len(made.columns), *made.rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
