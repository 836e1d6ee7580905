"""Signals that ask a run to stop: Ctrl-C, and those of batch systems and of closing terminals."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, NoReturn

#: The signals handled. One that the parent process ignores stays ignored, which `nohup` and background jobs rely on.
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

#: Added to a signal's number, this is the exit code, as in shells.
SIGNALLED = 128

#: Signals within this time in s count as one. `timeout` sends SIGTERM twice at once, a closing terminal SIGHUP.
SAME = 0.5


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

    Until `defer` is called, the first signal ends the process at once, from within OpenMM too. After that it is only
    noted in `received`, so that the step can be completed and the files written, and a second signal ends the process
    at once.

    Nothing is raised where a signal arrives: from within OpenMM's wrappers that would come as a SystemError, or not at
    all.

    Attributes:
        received: number of the first signal; None before it.
    """

    def __init__(self, at_once: Callable[[], None] = lambda: None) -> None:
        """`at_once` is done in another thread before the process is ended at once."""
        self.received: int | None = None
        self._at_once = at_once
        self._deferred = False
        self._deciding = threading.Lock()
        self._previous: dict[int, Any] = {}
        self._leaving = False

    def defer(self) -> None:
        """From now on note the first signal instead of ending the process."""
        # Not while the watcher is ending it: whoever gets past this changes files.
        with self._deciding:
            self._deferred = True

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

    def _watch(self) -> None:
        """End the process where it is not to go on; runs in a thread of its own."""
        first = None
        while (data := self._reader.recv(64)) and not self._leaving:
            for signum in filter(self._previous.__contains__, data):
                if first is None:
                    with self._deciding:
                        if not self._deferred:
                            name = signal_name(signum)
                            self._exit_now(signum, f"stopped by {name} before the first step; nothing was written")
                    first, since = signum, time.monotonic()
                elif time.monotonic() - since > SAME:
                    message = f"{signal_name(signum)}: ended at once by a second signal; go on from the last checkpoint"
                    self._exit_now(signum, message)

    def _exit_now(self, signum: int, message: str) -> NoReturn:
        with contextlib.suppress(Exception):
            self._at_once()
            os.write(sys.stderr.fileno(), f"openmm-sier: {message}\n".encode())
        os._exit(SIGNALLED + signum)


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
