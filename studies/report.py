"""Reports of studies: notes, progress and tables."""

from __future__ import annotations

import pandas as pd

from openmm_sier.cli import console
from openmm_sier.inputs import report


class Report(report.Report):
    """The receiver of a study's reports. This one ignores them."""

    def table(self, title: str, rows: pd.DataFrame) -> None:
        """Take a table of text, see `studies.text`."""


class PrintedReport(console.ConsoleReport, Report):
    """Prints."""

    def table(self, title: str, rows: pd.DataFrame) -> None:
        print(f"{title}\n{rows.to_string(index=False)}\n", flush=True)


SILENT = Report()
