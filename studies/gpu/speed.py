"""Wall time of steps, by turns."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import openmm

from studies.gpu import calls
from studies.gpu.settings import GpuSettings
from studies.timing import median_and_error, turns


def run(context: openmm.Context, steps: int) -> None:
    """Make steps as `Simulation` does, and wait for the GPU."""
    calls.advance(context.getIntegrator(), steps)
    context.getState(positions=True)


def speeds(
    contexts: Mapping[str, openmm.Context], durations: Mapping[str, float], reference: str, settings: GpuSettings
) -> list[dict[str, Any]]:
    """Return a row for each method.

    Args:
        contexts: by the names of methods.
        durations: simulated fs of one step, by the same names.
        reference: the method that `over` is a ratio to.
        settings: of the study.
    """
    counts = {name: _steps_of_turn(context, settings.turn) for name, context in contexts.items()}

    def seconds(name: str) -> float:
        begin = time.perf_counter()
        run(contexts[name], counts[name])
        return (time.perf_counter() - begin) / counts[name]

    times = turns({name: partial(seconds, name) for name in contexts}, settings.rounds)
    rates = {name: durations[name] / each for name, each in times.items()}
    rows = []
    for name, each in times.items():
        over, error, _ = median_and_error(rates[name] / rates[reference])
        middle = float(np.median(each))
        rows.append(
            {
                "method": name,
                "engine": getattr(contexts[name].getIntegrator(), "engine", ""),
                "microseconds": 1e6 * middle,
                # 86400 s a day, 1e6 fs a ns.
                "ns_per_day": 0.0864 * durations[name] / middle,
                "over": over,
                "over_error": 0.0 if name == reference else error,
            }
        )
    return rows


def _steps_of_turn(context: openmm.Context, seconds: float) -> int:
    run(context, calls.CALL)
    begin = time.perf_counter()
    run(context, calls.CALL)
    return calls.CALL * max(1, math.ceil(seconds / (time.perf_counter() - begin)))
