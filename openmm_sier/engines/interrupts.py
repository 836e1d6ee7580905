"""Ctrl-C and other signals, which must not leave a Context between two steps."""

# What `signal` is made of. `signal` looks each handler up in an enumeration, which takes ten times as long.
import _signal  # type: ignore[import-not-found]
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

#: Signals that usually end a program: Ctrl-C, and those of batch systems and of closing terminals.
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

#: Signals that came since they were deferred.
pending: list[tuple[int, FrameType | None]] = []

_handlers: dict[int, Callable[[int, FrameType | None], Any]] = {}


def defer() -> dict[int, Any] | None:
    """Let signals wait until `act_on_pending` or `release`.

    Only signals with a handler in Python wait, and in another thread than the main one nothing has to.

    Returns:
        The handlers, for `release`; None where signals wait already, or need not.
    """
    # Python calls handlers in the main thread alone.
    if _handlers or threading.current_thread() is not threading.main_thread():
        return None
    handlers = {}
    try:
        for number in SIGNALS:
            handler = _signal.getsignal(number)
            handlers[number] = handler
            if callable(handler):
                _handlers[number] = handler
                _signal.signal(number, _wait)
    except BaseException:
        release(handlers)
        raise
    return handlers


def release(handlers: dict[int, Any] | None) -> None:
    """Put back handlers that `defer` returned, and call those of signals that came since."""
    if handlers is None:
        return
    # A handler that is back may raise at once. That of Ctrl-C comes last, and has no entry any more: what is left of an
    # entry would make the next block take itself for a nested one.
    while _handlers:
        _signal.signal(*_handlers.popitem())
    if pending:
        _call_handlers(handlers)


@contextmanager
def deferred() -> Iterator[None]:
    """Let signals wait until `act_on_pending` or the end of the block; of nested blocks the outermost defers."""
    handlers = None
    try:
        handlers = defer()
        yield
    finally:
        release(handlers)


def act_on_pending() -> None:
    """Call the handlers of signals that came since `defer`; that of Ctrl-C raises KeyboardInterrupt."""
    if pending:
        _call_handlers(dict(_handlers))


def _wait(number: int, frame: FrameType | None) -> None:
    pending.append((number, frame))


def _call_handlers(handlers: dict[int, Any]) -> None:
    while pending:
        number, frame = pending.pop(0)
        handlers[number](number, frame)
