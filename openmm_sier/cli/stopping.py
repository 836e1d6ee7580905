"""Signals that ask a run to stop: Ctrl-C, and those of batch systems and of closing terminals."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

#: The signals handled. One that the parent process ignores stays ignored, which `nohup` and background jobs rely on.
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

#: Added to a signal's number, this is the exit code, as in shells.
SIGNALLED = 128

#: Signals within this time in s count as one. `timeout` sends SIGTERM twice at once, a closing terminal SIGHUP.
SAME = 0.5

#: Seconds that OpenMM may take to return, for example from a minimization, before a program with nothing to save ends.
PATIENCE = 2.0


class Stopped(KeyboardInterrupt):
    """A signal asked the program to stop.

    Attributes:
        signum: its number.
    """

    def __init__(self, signum: int, message: str = ""):
        super().__init__(message)
        self.signum = signum


class StopRequests:
    """Signals that arrive inside this context manager.

    Until `defer` is called, the first signal raises `Stopped` at once. After that it is only noted in `received`, so
    that the step can be completed and the files written. A second signal ends the process at once, even from within
    OpenMM.

    Attributes:
        received: number of the first signal; None before it.
    """

    def __init__(self, at_once: Callable[[], None] = lambda: None) -> None:
        """`at_once` is done in another thread before the process is ended at once."""
        self.received: int | None = None
        self._at_once = at_once
        self._deferred = False
        self._previous: dict[int, Any] = {}
        self._leaving = False

    def defer(self) -> None:
        """From now on note the first signal instead of raising.

        Raises:
            Stopped: a signal has arrived already.
        """
        if self.received is not None:
            raise Stopped(self.received)
        self._deferred = True

    @property
    def interrupted(self) -> int | None:
        """Number of a signal that was raised; None before it, and if it was only noted.

        `Stopped` need not be what arrives: from within OpenMM's wrappers it comes as a SystemError, or not at all.
        """
        return None if self._deferred else self.received

    def __enter__(self) -> StopRequests:
        # Python handles signals in the main thread only.
        if threading.current_thread() is not threading.main_thread():
            return self
        handled = [signum for signum in SIGNALS if signal.getsignal(signum) not in (signal.SIG_IGN, None)]
        if not handled:
            return self
        self._previous = {signum: signal.signal(signum, self._handle) for signum in handled}
        # Python runs handlers only between its own instructions, but the numbers of signals reach this socket at once.
        self._reader, self._writer = socket.socketpair()
        self._writer.setblocking(False)
        self._old_descriptor = signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
        self._watcher = threading.Thread(target=self._watch, daemon=True)
        self._watcher.start()
        return self

    def __exit__(self, *_: object) -> None:
        if not self._previous:
            return
        self._leaving = True
        for signum, handler in self._previous.items():
            # The process is about to end by a signal. The same one once more must not end it sooner: `timeout` sends
            # it to a process and to its group.
            is_ending = self.received is not None and handler == signal.SIG_DFL
            signal.signal(signum, signal.SIG_IGN if is_ending else handler)
        signal.set_wakeup_fd(self._old_descriptor)
        self._writer.close()
        self._watcher.join()
        self._reader.close()

    def _handle(self, signum: int, _frame: object) -> None:
        if self.received is None:
            self.received = signum
            if not self._deferred:
                raise Stopped(signum)

    def _watch(self) -> None:
        """End the process if the main thread does not; runs in a thread of its own."""
        first = None
        while True:
            waits = first is not None and not self._deferred
            ready, _, _ = select.select([self._reader], [], [], PATIENCE if waits else None)
            if not ready:
                self._exit_now(first, "stopped before the first step; nothing was written")
            data = self._reader.recv(64)
            if not data or self._leaving:
                return
            for signum in data:
                if signum not in self._previous:
                    continue
                if first is None:
                    first, since = signum, time.monotonic()
                elif time.monotonic() - since > SAME:
                    self._exit_now(signum, "ended at once by a second signal; go on from the last checkpoint")

    def _exit_now(self, signum: int | None, message: str) -> None:
        number = signum or 0
        with contextlib.suppress(Exception):
            self._at_once()
            os.write(sys.stderr.fileno(), f"openmm-sier: {signal_name(number)}: {message}\n".encode())
        os._exit(SIGNALLED + number)


def interrupt_behind(error: BaseException | None) -> KeyboardInterrupt | None:
    """The Ctrl-C of which Python has made an error, or None.

    Python runs the handlers of signals also within calls of OpenMM's wrappers. These are made by SWIG, and return as if
    nothing had been raised; Python then raises a SystemError, whose cause is what the handler had raised.
    """
    while isinstance(error, SystemError):
        error = error.__cause__ or error.__context__
    return error if isinstance(error, KeyboardInterrupt) else None


def signal_name(signum: int) -> str:
    """The name of a signal."""
    return signal.Signals(signum).name
