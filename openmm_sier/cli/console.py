"""Output of the commands: tables, notes and a progress bar, with rich."""

import sys
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, suppress
from datetime import timedelta

try:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn
    from rich.table import Table as RichTable
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("the command needs rich; install it with: pip install 'openmm-sier[cli]'") from error

from openmm_sier.measure.report import Advance, Report

PS_PER_NS = 1000.0
SECONDS_PER_DAY = 86400.0

#: Time in seconds, of which only differences mean anything.
clock = time.perf_counter

#: Seconds until the first line about progress where there is no terminal.
LINE_AFTER = 30.0


def note(message: str) -> None:
    """Print a line of progress information."""
    print(message, flush=True)


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1) -> None:
    """Print a table of text on standard output.

    Args:
        title: above the table.
        columns: headings; none are shown if all are empty.
        rows: cells, in each row one for each column.
        left: number of leading columns that are aligned to the left, the others being numbers.
    """
    made = RichTable(title=title, title_justify="left", show_header=any(columns))
    for i, heading in enumerate(columns):
        made.add_column(heading, justify="left" if i < left else "right", overflow="fold")
    for row in rows:
        made.add_row(*row)
    # In a file, lines are as long as they need to be.
    Console(width=None if sys.stdout.isatty() else 160, highlight=False, markup=False).print(made)


class ProgressBar(AbstractContextManager[Advance]):
    """A progress bar on standard error, or occasional lines where that is not a terminal.

    A context manager. Its value is a function that takes how much has been done in all and, optionally, a new
    description. The first line comes after `LINE_AFTER` s, later ones less often, but at least every ten minutes. A
    closed terminal does not stop the program.
    """

    def __init__(self, description: str, total: float = 1.0, ps: float | None = None, done: int = 0):
        """
        Args:
            description: in front of the bar.
            total: number of steps, or what counts as the whole.
            ps: length of a step; None where no steps are counted.
            done: how much was done before the bar is started, as after a restart.
        """
        console = Console(stderr=True)
        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[state]}"))
        self._bar = Progress(*columns, console=console, disable=not console.is_terminal)
        self._task = self._bar.add_task(description, total=total, completed=done, state="")
        self._description, self._total, self._ps, self._begun_at = description, total, ps, done
        self._started = self._last = clock()

    def __enter__(self) -> Advance:
        with suppress(OSError):
            self._bar.start()
            # Whatever ends the process then leaves a terminal as it was.
            self._bar.console.show_cursor()
        return self._advance

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):
            self._bar.stop()

    def _advance(self, done: float, description: str | None = None) -> None:
        self._description = description or self._description
        now = clock()
        elapsed = now - self._started
        if done <= self._begun_at or not elapsed:
            return
        with suppress(OSError):
            if not self._bar.disable:
                state = self._state(done, elapsed)
                self._bar.update(self._task, completed=done, description=self._description, state=state)
            elif now - self._last >= min(20 * LINE_AFTER, max(LINE_AFTER, elapsed / 20)):
                self._last = now
                print(f"{self._description}: {self._state(done, elapsed)}", file=sys.stderr, flush=True)

    def _state(self, done: float, elapsed: float) -> str:
        """How much is done, how fast and for how long still."""
        rate = (done - self._begun_at) / elapsed
        percent = f"{100 * done / self._total:.0f} %"
        left = f"{timedelta(seconds=round((self._total - done) / rate))} left"
        if self._ps is None:
            return f"{percent}, {left}"
        speed = f"{rate * self._ps / PS_PER_NS * SECONDS_PER_DAY:.2f} ns/day"
        return f"{done:.0f}/{self._total:.0f} steps, {percent}, {speed}, {left}"


class ConsoleReport(Report):
    """Reports of the commands."""

    def note(self, message: str) -> None:
        note(message)

    def progress(
        self, description: str, total: float = 1.0, ps: float | None = None
    ) -> AbstractContextManager[Advance]:
        return ProgressBar(description, total, ps)


REPORT = ConsoleReport()
