"""Signals that ask a run to stop: Ctrl-C, and those of batch systems and of closing terminals."""

from __future__ import annotations

import signal
from typing import Any

#: Signals that usually end a program: Ctrl-C, and those of batch systems and of closing terminals.
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


class Stopped(KeyboardInterrupt):
    """The end of a program by a signal.

    Attributes:
        signum: its number.
    """

    def __init__(self, signum: int, message: str = ""):
        super().__init__(message)
        self.signum = signum


class StopRequests:
    """Signals that arrive inside this context manager.

    Until `defer` is called, a signal ends the process at once, also within OpenMM. After that the first one is only
    stored in `received`, so that the step can be completed and the files written. SIGQUIT and SIGKILL do not wait.

    Handlers raise nothing: within OpenMM's wrappers an exception would become a SystemError, or be lost.

    Attributes:
        received: number of the first signal; None before it.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._previous: dict[int, Any] = {}

    def defer(self) -> None:
        """Store the first signal from now on, instead of ending the process."""
        for signum in self._previous:
            signal.signal(signum, self._handle)

    def __enter__(self) -> StopRequests:
        # A signal that the parent process ignores stays ignored, which `nohup` and background jobs rely on.
        handlers = {signum: signal.getsignal(signum) for signum in SIGNALS}
        self._previous = {n: handler for n, handler in handlers.items() if handler not in (signal.SIG_IGN, None)}
        for signum in self._previous:
            signal.signal(signum, signal.SIG_DFL)
        return self

    def __exit__(self, *_: object) -> None:
        for signum, handler in self._previous.items():
            # A process that ends by a signal ignores a second one, which would end it sooner: `timeout` sends two, to
            # the process and to its group.
            is_ending = self.received is not None and handler == signal.SIG_DFL
            signal.signal(signum, signal.SIG_IGN if is_ending else handler)

    def _handle(self, signum: int, _frame: object) -> None:
        # `timeout` sends a signal twice, a closing terminal SIGHUP.
        self.received = self.received or signum


def interrupt_behind(error: BaseException | None) -> KeyboardInterrupt | None:
    """Return the KeyboardInterrupt that caused an error, or None.

    Python runs the handlers of signals also within calls of OpenMM's wrappers. These are made by SWIG, and return as if
    nothing had been raised; Python then raises a SystemError, whose cause is the exception of the handler.
    """
    while isinstance(error, SystemError):
        error = error.__cause__ or error.__context__
    return error if isinstance(error, KeyboardInterrupt) else None
