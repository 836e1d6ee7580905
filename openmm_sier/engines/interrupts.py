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

_handlers: dict[int, Callable[[int, FrameType | None], Any]] = {}
_pending: list[tuple[int, FrameType | None]] = []


def handlers_in_use() -> dict[int, Any]:
    """Return the handlers of `SIGNALS` by number; none outside the main thread, where Python never calls them."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    handlers = {}
    for number in SIGNALS:
        handlers[number] = _signal.getsignal(number)
    return handlers


def defer() -> dict[int, Any] | None:
    """Let signals wait until `act_on_pending` or `release`.

    Only signals with a handler in Python wait, and in another thread than the main one nothing has to.

    Returns:
        The handlers, for `release`; None where signals wait already, or need not.
    """
    handlers = handlers_in_use()
    if _handlers or not handlers:
        return None
    try:
        for number, handler in handlers.items():
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
    if _pending:
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
    """Call the handlers of signals that came since `deferred`; that of Ctrl-C raises KeyboardInterrupt."""
    if _pending:
        _call_handlers(dict(_handlers))


def _wait(number: int, frame: FrameType | None) -> None:
    _pending.append((number, frame))


def _call_handlers(handlers: dict[int, Any]) -> None:
    while _pending:
        number, frame = _pending.pop(0)
        handlers[number](number, frame)
