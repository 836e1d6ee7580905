"""Time spent in evaluations of forces."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from time import perf_counter
from typing import Any

import openmm


class ForceClock:
    """Measures from outside the time for evaluating forces and energies, and for setting positions.

    It wraps `Context.getState` and `Context.setPositions`.

    Attributes:
        seconds: spent in them.
        calls: number of evaluations of forces.
    """

    def __init__(self, context: openmm.Context, now: Callable[[], float] = perf_counter) -> None:
        """
        Args:
            context: openmm.Context.
            now: clock in seconds; `time.process_time` counts processor time, which other programs hardly affect.
        """
        self.seconds, self.calls = 0.0, 0
        ask, place = context.getState, context.setPositions

        def timed(call: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            start = now()
            try:
                return call(*args, **kwargs)
            finally:
                self.seconds += now() - start

        def timed_ask(*args: Any, **kwargs: Any) -> Any:
            if not (kwargs.get("forces") or kwargs.get("energy")):
                return ask(*args, **kwargs)
            self.calls += bool(kwargs.get("forces"))
            return timed(ask, *args, **kwargs)

        context.getState, context.setPositions = timed_ask, partial(timed, place)
