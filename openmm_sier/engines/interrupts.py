"""Actions that Ctrl-C must not leave half done."""

from __future__ import annotations

from collections.abc import Callable


def whatever_interrupts(action: Callable[[], None]) -> None:
    """Run an action to its end: after a Ctrl-C it is run once more before the interrupt is passed on."""
    try:
        action()
    except KeyboardInterrupt:
        action()
        raise
