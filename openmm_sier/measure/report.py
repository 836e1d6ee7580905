"""Reports of long computations: notes, tables and progress.

Nothing here prints. The command passes in an object that prints with rich; without one, computations are silent.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import NamedTuple, Protocol


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


class Advance(Protocol):
    """Takes the amount done so far, and a new description if that changes."""

    def __call__(self, done: float, description: str | None = None) -> None: ...


class Report(Protocol):
    """The receiver of reports."""

    def note(self, message: str) -> None:
        """Take a line of progress information."""

    def table(self, table: Table) -> None:
        """Take a table of results."""

    def progress(
        self, description: str, total: float = 1.0, ps: float | None = None
    ) -> AbstractContextManager[Advance]:
        """Progress of a computation, as a context manager.

        Args:
            description: what is being done.
            total: how much there is to do.
            ps: length of a step, if steps are counted.
        """


class Silent:
    """Reports nothing."""

    def note(self, message: str) -> None:
        pass

    def table(self, table: Table) -> None:
        pass

    def progress(
        self, description: str, total: float = 1.0, ps: float | None = None
    ) -> AbstractContextManager[Advance]:
        return nullcontext(lambda done, description=None: None)


SILENT = Silent()


def duration(seconds: float) -> str:
    """A duration as text, in ms or s."""
    return f"{seconds * 1e3:.3g} ms" if seconds < 1 else f"{seconds:.3g} s"
