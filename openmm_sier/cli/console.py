"""Output of the commands: tables, notes and a progress bar, with rich."""

import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table as RichTable

from openmm_sier.cli.streams import printable, show
from openmm_sier.inputs.report import Advance, Report

PS_PER_NS = 1000.0
SECONDS_PER_DAY = 86400.0

#: Time in seconds, from an arbitrary origin.
clock = time.perf_counter

#: Seconds until the first line about progress where there is no terminal, and the longest time between two lines.
LINE_AFTER, LONGEST_SILENCE = 30.0, 600.0


def note(message: str) -> None:
    """Print a line of progress information."""
    show(printable(message))


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1) -> None:
    """Print a table of text on standard output.

    Args:
        title: above the table.
        columns: headings; none are shown if all are empty.
        rows: cells, in each row one for each column.
        left: number of leading columns that are aligned to the left, the others being numbers.
    """
    rich_table = RichTable(title=printable(title), title_justify="left", show_header=any(columns))
    for i, heading in enumerate(columns):
        rich_table.add_column(heading, justify="left" if i < left else "right", overflow="fold")
    for row in rows:
        rich_table.add_row(*map(printable, row))
    # In a file, lines are as long as they need to be.
    console = Console(width=None if sys.stdout.isatty() else 160, highlight=False, markup=False)
    with console.capture() as captured:
        console.print(rich_table)
    show(captured.get(), end="")


@contextmanager
def progress_bar(description: str, total: float, ps: float | None = None, begun: int = 0) -> Iterator[Advance]:
    """Show a progress bar on standard error, or occasional lines where that is not a terminal.

    The value is a function of the progress so far and, optionally, a new description. A closed terminal does not stop
    the program.

    Args:
        description: in front of the bar.
        total: number of steps, or another measure of the whole.
        ps: length of a step; None if progress is not counted in steps.
        begun: progress before the bar is started, as after a restart.
    """
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[state]}"))
    bar = Progress(*columns, console=console, disable=not console.is_terminal)
    task = bar.add_task(description, total=total, completed=begun, state="")
    shown = description
    started = last = clock()

    def advance(completed: float, description: str | None = None) -> None:
        nonlocal shown, last
        shown = description or shown
        elapsed = clock() - started
        if completed <= begun or not elapsed:
            return
        state = _state(completed, total, (completed - begun) / elapsed, ps)
        with suppress(OSError):
            if not bar.disable:
                bar.update(task, completed=completed, description=shown, state=state)
            elif started + elapsed - last >= min(LONGEST_SILENCE, max(LINE_AFTER, elapsed / 20)):
                last = started + elapsed
                print(f"{shown}: {state}", file=sys.stderr, flush=True)

    with suppress(OSError):
        bar.start()
        # So that a killed process leaves the cursor visible.
        console.show_cursor()
    try:
        yield advance
    finally:
        with suppress(OSError):
            bar.stop()


def _state(completed: float, total: float, rate: float, ps: float | None) -> str:
    """Return progress, speed and remaining time, in words."""
    percent = f"{100 * completed / total:.0f} %"
    remaining = f"{timedelta(seconds=round((total - completed) / rate))} left"
    if ps is None:
        return f"{percent}, {remaining}"
    speed = f"{rate * ps / PS_PER_NS * SECONDS_PER_DAY:.2f} ns/day"
    return f"{completed:.0f}/{total:.0f} steps, {percent}, {speed}, {remaining}"


class ConsoleReport(Report):
    """Reports of the commands."""

    note, progress = staticmethod(note), staticmethod(progress_bar)


REPORT = ConsoleReport()
