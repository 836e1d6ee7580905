"""An experiment: runs of contestants in boxes from starts, each kept, and the tables and the figure made of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from studies import records, text
from studies.command import RunsSettings
from studies.records import Record, Task
from studies.report import SILENT, Report

#: Tables of a record by name, and further numbers.
Made = tuple[Mapping[str, pd.DataFrame], Mapping[str, Any]]


@dataclass(frozen=True)
class Experiment:
    """The study of an experiment, a function of settings and a report.

    Attributes:
        name: of its files.
        tasks: settings -> all runs that they ask for.
        run: makes one of them, and returns what is kept of it.
        form: of the note on a run, see `text.cell`.
        made: settings, all runs -> the tables and notes of the record.
        shown: the name of a table, its title and its columns, in order.
        figure: draws a record into a file; None: no figure.
    """

    name: str
    tasks: Callable[[Any], Iterable[Task]]
    run: Callable[[Task], dict[str, Any]]
    form: str
    made: Callable[[Any, pd.DataFrame], Made]
    shown: tuple[tuple[str, str, Mapping[str, str]], ...]
    figure: Callable[[Record, Path], None] | None = None

    def __call__(self, settings: RunsSettings, report: Report = SILENT) -> Record:
        """Make the runs that are missing in the directory `out`, and write NAME.json and NAME.png from all there.

        Raises:
            ValueError: a name in the settings is unknown, or the directory has runs of other settings.
        """
        runs = records.all_runs(settings, self.name, self.tasks(settings), self.run, report, self.form)
        tables, notes = self.made(settings, runs)
        record = Record(settings.shared(), tables, notes)
        for name, title, columns in self.shown:
            report.table(title, text.table(tables[name], columns))
        record.write(settings.out / f"{self.name}.json")
        if self.figure is not None:
            self.figure(record, settings.out / f"{self.name}.png")
        return record
