"""A progress bar for experiments. Needs rich, an extra."""

from __future__ import annotations

try:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("the command needs rich; install it with: pip install 'openmm-sier[cli]'") from error


class Bar:
    """A bar on standard error with what is being done; nothing is shown where that is no terminal.

    A context manager, whose value is a function of what is being done and the fraction of the whole that is done.
    """

    def __init__(self, description: str):
        """
        Args:
            description: shown until there is something to say.
        """
        console = Console(stderr=True)
        columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
        self._progress = Progress(*columns, TimeRemainingColumn(), console=console, disable=not console.is_terminal)
        self._task = self._progress.add_task(description, total=1.0)

    def __enter__(self):
        self._progress.start()
        return lambda what, fraction: self._progress.update(self._task, description=what, completed=fraction)

    def __exit__(self, *_):
        self._progress.stop()
