"""Reports of studies: the notes and the progress of the package's reports, and tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from openmm_sier.cli import console
from openmm_sier.inputs import report


class Table(NamedTuple):
    """A table of text.

    Attributes:
        title: above the table.
        columns: headings; none are shown if all are empty.
        rows: cells, in each row one for each column.
        left: number of leading columns that are aligned to the left, the others being numbers.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    left: int = 1


class Report(report.Report):
    """The receiver of a study's reports. This one ignores them."""

    def table(self, table: Table) -> None:
        """Take a table of results."""


class PrintedReport(console.ConsoleReport, Report):
    """Prints."""

    def table(self, table: Table) -> None:
        console.table(*table)


SILENT = Report()
