"""Time spent in evaluations of forces."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter
from typing import Any

import openmm


class ForceClock:
    """Measures the time of the calls in which an exact engine asks OpenMM for forces and energies, or sets positions.

    It counts nothing for other engines and integrators, whose steps are made by OpenMM, nor for fast forces.

    Attributes:
        seconds: spent in these calls.
        calls: number of evaluations of forces.
    """

    def __init__(self, context: openmm.Context, now: Callable[[], float] = perf_counter) -> None:
        """
        Args:
            context: openmm.Context.
            now: clock in seconds; `time.process_time` counts processor time, which other programs hardly affect.
        """
        self.seconds, self.calls = 0.0, 0
        forces = getattr(getattr(context.getIntegrator(), "_engine", None), "forces", None)
        if forces is None:
            return

        def timed(call: Callable[..., Any]) -> Callable[..., Any]:
            def measured(*args: Any, **kwargs: Any) -> Any:
                self.calls += "forces" in kwargs
                start = now()
                try:
                    return call(*args, **kwargs)
                finally:
                    self.seconds += now() - start

            return measured

        forces.get_state, forces.set_positions = timed(forces.get_state), timed(forces.set_positions)
