"""Progress reports of long computations.

Nothing here prints. The command passes an object that prints with rich; without one, computations are silent.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

#: Callback that receives the amount done so far, and a new description if it changes.
Advance = Callable[..., None]


class Report:
    """Receiver of reports, which ignores them; subclasses show them."""

    def note(self, message: str) -> None:
        """Receive a line of progress information."""

    def progress(self, description: str, total: float, ps: float | None = None) -> AbstractContextManager[Advance]:
        """Show the progress of a computation, as a context manager.

        Args:
            description: of the task.
            total: how much there is to do.
            ps: length of a step, if steps are counted.
        """
        return nullcontext(lambda done, description=None: None)


SILENT = Report()


def duration(seconds: float) -> str:
    """Return a duration as text, in ms or s."""
    return f"{seconds * 1e3:.3g} ms" if seconds < 1 else f"{seconds:.3g} s"
