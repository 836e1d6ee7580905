"""Output of the commands: tables, notes and a progress bar, with rich."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from datetime import timedelta

try:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
    from rich.table import Table as RichTable
    from rich.text import Text
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("the command needs rich; install it with: pip install 'openmm-sier[cli]'") from error

from openmm_sier.measure.report import Advance, Table

PS_PER_NS = 1000.0
SECONDS_PER_DAY = 86400.0

#: Seconds until the first line about progress where there is no terminal.
LINE_AFTER = 30.0


@contextmanager
def _standard_output() -> Iterator[None]:
    """Make write errors name standard output, for example when it goes to a full disk."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror, "standard output") from error


def note(message: str) -> None:
    """Print a line of progress information."""
    with _standard_output():
        print(message, flush=True)


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1) -> None:
    """Print a table on standard output; the arguments are those of `openmm_sier.measure.report.Table`."""
    made = RichTable(title=title, title_justify="left", show_header=any(columns))
    for i, heading in enumerate(columns):
        made.add_column(heading, justify="left" if i < left else "right", overflow="fold")
    for row in rows:
        made.add_row(*row)
    # In a file, lines are as long as they need to be.
    with _standard_output():
        Console(width=None if sys.stdout.isatty() else 160, highlight=False, markup=False).print(made)


class _Amount(ProgressColumn):
    """Steps done, or the fraction done where no steps are counted."""

    def render(self, task: Task) -> Text:
        if task.fields["ps"] is None:
            return Text(f"{task.percentage:.0f} %")
        return Text(f"{task.completed:.0f}/{task.total:.0f} steps")


class _Rate(ProgressColumn):
    """Simulated ns a day, from the time since the bar was started."""

    def render(self, task: Task) -> Text:
        if task.fields["ps"] is None or not task.elapsed or not task.completed:
            return Text("")
        ps_done = (task.completed - task.fields["begun_at"]) * task.fields["ps"]
        return Text(f"{ps_done / PS_PER_NS / task.elapsed * SECONDS_PER_DAY:.2f} ns/day")


class ProgressBar(AbstractContextManager[Advance]):
    """A progress bar on standard error, or occasional lines where that is not a terminal.

    A context manager. Its value is a function that takes how much has been done in all and, optionally, a new
    description. A closed terminal does not stop the program.
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
        columns = (TextColumn("{task.description}"), BarColumn(), _Amount(), _Rate(), TimeRemainingColumn())
        self._progress = Progress(*columns, console=console, disable=not console.is_terminal)
        self._task = self._progress.add_task(description, total=total, completed=done, ps=ps, begun_at=done)
        self._lines = None if console.is_terminal else _Lines(description, total, ps, done)

    def __enter__(self) -> Advance:
        with suppress(OSError):
            self._progress.start()
        return self._advance

    def _advance(self, done: float, description: str | None = None) -> None:
        with suppress(OSError):
            if self._lines is None:
                self._progress.update(self._task, completed=done, description=description)
            else:
                self._lines.show(done, description)

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):
            self._progress.stop()


class _Lines:
    """Lines about progress: the first after `LINE_AFTER` s, then less often, but at least every ten minutes."""

    def __init__(self, description: str, total: float, ps: float | None, begun_at: float):
        self._description, self._total, self._ps, self._begun_at = description, total, ps, begun_at
        self._started = self._last = clock()

    def show(self, done: float, description: str | None) -> None:
        now = clock()
        elapsed = now - self._started
        self._description = description or self._description
        if now - self._last < min(20 * LINE_AFTER, max(LINE_AFTER, elapsed / 20)) or done <= self._begun_at:
            return
        self._last = now
        rate = (done - self._begun_at) / elapsed
        parts = [f"{100 * done / self._total:.0f} %", f"{timedelta(seconds=round((self._total - done) / rate))} left"]
        if self._ps is not None:
            speed = f"{rate * self._ps / PS_PER_NS * SECONDS_PER_DAY:.2f} ns/day"
            parts = [f"{done:.0f}/{self._total:.0f} steps", parts[0], speed, parts[1]]
        print(f"{self._description}: {', '.join(parts)}", file=sys.stderr, flush=True)


class ConsoleReport:
    """The `openmm_sier.measure.report.Report` of the commands."""

    def note(self, message: str) -> None:
        note(message)

    def table(self, table_: Table) -> None:
        table(*table_)

    def progress(self, description: str, total: float = 1.0, ps: float | None = None) -> ProgressBar:
        return ProgressBar(description, total, ps)


REPORT = ConsoleReport()


def clock() -> float:
    """Time in seconds, of which only differences mean anything."""
    return time.perf_counter()
