"""Time spent in evaluations of forces."""

from collections.abc import Callable
from time import perf_counter
from typing import Any

import openmm

from openmm_sier.integrators.integrator import SIERIntegrator


class ForceClock:
    """Measures the time of the calls in which an exact engine asks OpenMM for forces and energies, or sets positions.

    It counts nothing for other engines and integrators, whose steps are made by OpenMM.

    Attributes:
        seconds: spent in these calls, those for fast forces included.
        calls: number of evaluations of all forces, or of those in the kicks where there are fast ones.
    """

    def __init__(self, context: openmm.Context, now: Callable[[], float] = perf_counter) -> None:
        """
        Args:
            context: openmm.Context.
            now: clock in seconds; `time.process_time` counts processor time, which other programs hardly affect.
        """
        self.seconds, self.calls = 0.0, 0

        def timed(call: Callable[..., Any], counts: bool) -> Callable[..., Any]:
            def measured(*args: Any, **kwargs: Any) -> Any:
                self.calls += counts and "forces" in kwargs
                start = now()
                try:
                    return call(*args, **kwargs)
                finally:
                    self.seconds += now() - start

            return measured

        integrator = context.getIntegrator()
        callers = integrator.binding.engine.callers if isinstance(integrator, SIERIntegrator) else ()
        for number, caller in enumerate(callers):
            caller.get_state = timed(caller.get_state, number == 0)
            caller.set_positions = timed(caller.set_positions, False)
