"""What the commands show: tables, notes and a progress bar, with rich, and figures where matplotlib is installed."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta
from importlib import import_module
from importlib.util import find_spec

try:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn, TimeRemainingColumn
    from rich.table import Table
    from rich.text import Text
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("the command needs rich; install it with: pip install 'openmm-sier[cli]'") from error

PS_PER_NS = 1000.0

#: Seconds to the first line about progress where there is no terminal.
LINE_AFTER = 30.0
SECONDS_PER_DAY = 86400.0


@contextmanager
def _standard_output() -> Iterator[None]:
    """Errors name it, when it goes to a full disk for instance."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror, "standard output") from error


def note(message: str) -> None:
    """A line about what is being done."""
    with _standard_output():
        print(message, flush=True)


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1) -> None:
    """Print a table on standard output.

    Args:
        title: above the table.
        columns: headings; none are shown if all are empty.
        rows: cells, as many a row as there are columns.
        left: number of leading columns that are aligned to the left, the others being numbers.
    """
    made = Table(title=title, title_justify="left", show_header=any(columns))
    for i, heading in enumerate(columns):
        made.add_column(heading, justify="left" if i < left else "right", overflow="fold")
    for row in rows:
        made.add_row(*row)
    # Lines are as long as they have to be where they go to a file.
    with _standard_output():
        Console(width=None if sys.stdout.isatty() else 160, highlight=False, markup=False).print(made)


class Rate(ProgressColumn):
    """Simulated ns a day, from the time since the bar was started."""

    def render(self, task) -> Text:
        if not task.elapsed or not task.completed:
            return Text("")
        ps_done = (task.completed - task.fields["begun_at"]) * task.fields["ps"]
        return Text(f"{ps_done / PS_PER_NS / task.elapsed * SECONDS_PER_DAY:.2f} ns/day")


class StepProgress:
    """A progress bar on standard error for a number of steps, or lines now and then where that is no terminal.

    A context manager, whose value is a function that takes the number of steps done so far. A terminal that has been
    closed stops nothing.
    """

    def __init__(self, description: str, total: int, ps: float, done: int = 0):
        """
        Args:
            description: in front of the bar.
            total: number of steps.
            ps: length of one step.
            done: number of steps that were done before the bar is started, as after a restart.
        """
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.completed:.0f}/{task.total:.0f} steps"),
        )
        console = Console(stderr=True)
        self._progress = Progress(
            *columns, Rate(), TimeRemainingColumn(), console=console, disable=not console.is_terminal
        )
        self._task = self._progress.add_task(description, total=total, completed=done, ps=ps, begun_at=done)
        self._lines = None if console.is_terminal else _Lines(description, total, ps, done)

    def __enter__(self):
        with suppress(OSError):
            self._progress.start()
        return self._show

    def _show(self, done: int) -> None:
        with suppress(OSError):
            if self._lines is None:
                self._progress.update(self._task, completed=done)
            else:
                self._lines.show(done)

    def __exit__(self, *_):
        with suppress(OSError):
            self._progress.stop()


class _Lines:
    """Lines about the steps done so far: the first after `LINE_AFTER` s, later fewer, but one every ten minutes."""

    def __init__(self, description: str, total: int, ps: float, begun_at: int):
        self._description, self._total, self._ps, self._begun_at = description, total, ps, begun_at
        self._started = self._last = clock()

    def show(self, done: int) -> None:
        now = clock()
        elapsed = now - self._started
        if now - self._last < min(20 * LINE_AFTER, max(LINE_AFTER, elapsed / 20)) or done <= self._begun_at:
            return
        self._last = now
        rate = (done - self._begun_at) / elapsed if elapsed > 0 else math.inf
        days = f"{rate * self._ps / PS_PER_NS * SECONDS_PER_DAY:.2f} ns/day"
        left = timedelta(seconds=round((self._total - done) / rate))
        share = f"{100 * done / self._total:.0f} %"
        print(
            f"{self._description}: {done}/{self._total} steps, {share}, {days}, {left} left",
            file=sys.stderr,
            flush=True,
        )


def draw(figure: str, *arguments) -> None:
    """Draw a figure of `openmm_sier.studies.figures`, or say why there is none: matplotlib is an extra.

    Args:
        figure: name of the function.
        arguments: of it; the last one is the path of the PNG file.
    """
    if find_spec("matplotlib") is None:
        note("no figure: matplotlib is missing, install it with: pip install 'openmm-sier[plots]'")
        return
    getattr(import_module("openmm_sier.studies.figures"), figure)(*arguments)


def duration(value: float) -> str:
    """A duration with a unit that suits it."""
    return f"{value * 1e3:.3g} ms" if value < 1 else f"{value:.3g} s"


def clock() -> float:
    """Seconds, for differences."""
    return time.perf_counter()
