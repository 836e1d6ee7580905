"""Signals that Python handles wait while a Context is between two steps."""

# What `signal` is made of. `signal` looks each handler up in an enumeration, which takes ten times as long.
import _signal  # type: ignore[import-not-found]
import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any, ClassVar

Handler = Callable[[int, FrameType | None], Any]

#: Handlers by the numbers of their signals.
Handlers = dict[int, Handler]

#: Signals that do not wait: those of errors in compiled code, after which nothing can go on, and two that have no
#: handlers.
_ERRORS = ("SIGABRT", "SIGBUS", "SIGFPE", "SIGILL", "SIGSEGV", "SIGSYS", "SIGTRAP", "SIGKILL", "SIGSTOP")

#: The numbers of signals that wait: all others but those of real time, which are half of all and would make `defer`
#: take twice as long. What their handlers find between two steps cannot be saved (`Session.refuse_between_steps`).
_END = getattr(signal, "SIGRTMIN", 65)
NUMBERS = tuple(
    sorted(
        {int(number) for number in signal.valid_signals() if number < _END}
        - {getattr(signal, name, 0) for name in _ERRORS}
    )
)

#: Signals that came since they were deferred, in this order, each with its handler.
pending: list[tuple[Handler, int, FrameType | None]] = []

#: The handlers of the signals that wait now, by number.
_deferred: Handlers = {}


class _Found:
    """What was found when handlers were last looked for, since they seldom change."""

    entries: ClassVar[list[Any]] = []
    handlers: ClassVar[Handlers] = {}


def defer() -> Handlers | None:
    """Let all signals with a handler in Python wait until `release`.

    Returns:
        The handlers, for `release`; None within a block where signals wait already, and in other threads than the main
        one, where Python calls no handlers. Only who gets handlers may call `release` when signals are pending.
    """
    if _deferred or threading.get_ident() != threading.main_thread().ident:
        return None
    entries = [*map(_signal.getsignal, NUMBERS)]
    if entries != _Found.entries:
        found = zip(NUMBERS, entries, strict=True)
        _Found.handlers = {number: handler for number, handler in found if callable(handler)}
        _Found.entries = entries
    handlers = _Found.handlers
    try:
        for number, handler in handlers.items():
            _deferred[number] = handler
            _signal.signal(number, _wait)
    except BaseException:
        release(handlers)
        raise
    return handlers


def release(handlers: Handlers | None) -> None:
    """Put back handlers that `defer` returned, and call those of all signals that came since, even if one raises."""
    if handlers is None:
        return
    try:
        for number, handler in handlers.items():
            _signal.signal(number, handler)
        # Last, so that a block within a handler that is called before does not defer to `_wait`.
        _deferred.clear()
    except BaseException:
        # A handler that is back already may raise at any moment. To put back what is back changes nothing.
        release(handlers)
        raise
    if pending:
        _call_handlers()


def _wait(number: int, frame: FrameType | None) -> None:
    pending.append((_deferred[number], number, frame))


def _call_handlers() -> None:
    while pending:
        handler, number, frame = pending.pop(0)
        try:
            handler(number, frame)
        except BaseException:
            # As without a wait, one that raises takes no signal from the others.
            _call_handlers()
            raise
