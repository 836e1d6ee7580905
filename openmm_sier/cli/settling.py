"""Where runs settled: from which time on their means are taken, and which quantities still drift."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from openmm_sier.analysis.statistics import FEWEST, settling
from openmm_sier.cli.errors import RunError
from openmm_sier.cli.logged_runs import Runs, read_logs
from openmm_sier.cli.results import DENSITY
from openmm_sier.observe.conservation import POTENTIAL, TEMPERATURES

#: Bins of time in which a run is searched for the moment from which on it is settled.
BINS = 400

#: Of a run that has not settled, the part that means leave out.
LEFT_OUT = 0.5

#: Quantities that settle, in words, by their columns.
SETTLES = {
    POTENTIAL: "potential energy",
    **dict(zip(TEMPERATURES, ("translation", "rotation", "temperature of flexible molecules"), strict=True)),
    DENSITY: "density",
}


def binned(clock: np.ndarray, values: np.ndarray, width: float, count: int) -> np.ndarray:
    """Means (count,) of values in bins of a clock; NaN where a bin has none. What comes after the last bin is left out.

    Args:
        clock, values: (n,).
        width: of a bin, which includes its end; the first includes 0 too.
        count: number of bins.
    """
    # Times are sums of steps, whose rounding must not move a row into the next bin.
    places = np.maximum(np.ceil(np.round(clock / width, 6)).astype(int) - 1, 0)
    kept = (places < count) & np.isfinite(values)
    numbers = np.bincount(places[kept], minlength=count)
    sums = np.bincount(places[kept], values[kept], minlength=count)
    return np.divide(sums, numbers, out=np.full(count, math.nan), where=numbers > 0)


def read_runs(paths: Sequence[Path], skip: float | None = None) -> Runs:
    """Runs of one kind, from their logs, and where they settled.

    Args:
        paths: of the logs, see `openmm_sier.cli.logged_runs.read_logs`.
        skip: what to leave out of each in any case, ps or trials; None for what had not settled.

    Raises:
        RunError: nothing is left.
        RunError, RecordError, OSError: the logs cannot be read together.
    """
    runs = read_logs(paths)
    if skip is not None and skip >= runs.length:
        raise RunError(f"--skip {skip:g} leaves nothing: the shortest run has {runs.length:g} {runs.unit}")
    return _with_settling(runs, skip)


def _with_settling(runs: Runs, skip: float | None) -> Runs:
    """Return runs with the time from which the means over all of them have settled, and the quantities that have not.

    Args:
        runs: none of whose quantities was looked at.
        skip: time of their clocks that is left out in any case; None leaves out what had not settled.
    """
    begin = skip or 0.0
    logs = [run.after(begin) for run in runs.runs]
    clocks = [run.clock[run.clock >= begin] - begin for run in runs.runs]
    count = max(1, min(*map(len, clocks), BINS + 1) - 1)
    width = (runs.length - begin) / count
    begins = [0.0]
    moving: list[str] = []
    drifting: list[str] = []
    unclear: list[str] = []
    for column, name in SETTLES.items():
        if column == DENSITY and not runs.first.moves_volume:
            continue
        series = np.mean([binned(c, log[column], width, count) for c, log in zip(clocks, logs, strict=True)], axis=0)
        (kept,) = np.nonzero(np.isfinite(series))
        if not len(kept):
            continue
        settled = settling(series[kept])
        if settled.begin == len(kept):
            drifting.append(name)
            continue
        begins.append(float(kept[settled.begin]) * width if settled.begin else 0.0)
        if settled.samples < FEWEST:
            unclear.append(name)
        elif settled.begin:
            moving.append(name)
    if skip is not None:
        # Quantities that settle later have a trend in the means.
        drifting += moving
        moving = []
        begins = [skip]
    elif drifting:
        begins.append(LEFT_OUT * runs.length)
    return runs._replace(
        begin=max(begins),
        skipped=begin,
        moving=tuple(moving),
        drifting=tuple(drifting),
        unclear=tuple(unclear),
    )
