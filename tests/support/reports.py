"""A report that records its calls."""

from contextlib import contextmanager

import pandas as pd


class RecordingReport:
    """A report with its notes and tables, and with description and fractions of each task."""

    def __init__(self):
        self.notes: list[str] = []
        self.tables: dict[str, pd.DataFrame] = {}
        self.runs: list[tuple[str, list[float]]] = []

    def note(self, message: str) -> None:
        self.notes.append(message)

    def table(self, title: str, rows: pd.DataFrame) -> None:
        self.tables[title] = rows

    @contextmanager
    def progress(self, description: str, total: float = 1.0, ps: float | None = None):
        fractions: list[float] = []
        self.runs.append((description, fractions))
        yield lambda done, what=None: fractions.append(done / total)
