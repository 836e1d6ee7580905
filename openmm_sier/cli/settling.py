"""The equilibrated part of runs: the time from which means are taken, and quantities that still drift."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from openmm_sier.analysis.statistics import FEWEST, settling
from openmm_sier.cli.errors import RunError
from openmm_sier.cli.logged_runs import Runs, read_logs
from openmm_sier.cli.results import DENSITY, TEMPERATURE_NAMES
from openmm_sier.observe.conservation import POTENTIAL

#: Number of bins of time in which the begin of the equilibrated part is searched for.
BINS = 400

#: Fraction of a run that has not settled, at its beginning, that means leave out.
LEFT_OUT = 0.5

#: Quantities that settle, in words, by their columns.
SETTLES = {POTENTIAL: "potential energy", **TEMPERATURE_NAMES, DENSITY: "density"}


def binned(clock: np.ndarray, values: np.ndarray, width: float, count: int) -> np.ndarray:
    """Return means (count,) of values in bins of a clock; NaN for an empty bin.

    Args:
        clock, values: (n,). Values after the last bin are left out.
        width: of a bin, which includes its end; the first includes 0 too.
        count: number of bins.
    """
    # The rounding of times, which are sums of steps, must not move a row into the next bin.
    places = np.maximum(np.ceil(np.round(clock / width, 6)).astype(int) - 1, 0)
    is_binned = (places < count) & np.isfinite(values)
    numbers = np.bincount(places[is_binned], minlength=count)
    sums = np.bincount(places[is_binned], values[is_binned], minlength=count)
    return np.divide(sums, numbers, out=np.full(count, math.nan), where=numbers > 0)


def read_runs(paths: Sequence[Path], skip: float | None = None) -> Runs:
    """Return runs of one kind with their equilibrated part, from their logs.

    Args:
        paths: of the logs, see `openmm_sier.cli.logged_runs.read_logs`.
        skip: time or number of trials to leave out at the beginning, ps or trials; None for the part before
            equilibrium.

    Raises:
        RunError: nothing is left.
        RunError, RecordError, OSError: the logs cannot be read together.
    """
    runs = read_logs(paths)
    if skip is not None and skip >= runs.length:
        raise RunError(f"--skip {skip:g} leaves nothing: the shortest run has {runs.length:g} {runs.unit}")
    return _with_settling(runs, skip)


def _with_settling(runs: Runs, skip: float | None) -> Runs:
    """Return runs with the begin of their common equilibrated part, and the quantities that have not settled.

    Args:
        runs: as `read_logs` returns them.
        skip: time of their clocks that is left out; None for the part before equilibrium.
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
        (indices,) = np.nonzero(np.isfinite(series))
        if not len(indices):
            continue
        equilibrated = settling(series[indices])
        if equilibrated.begin == len(indices):
            drifting.append(name)
            continue
        begins.append(float(indices[equilibrated.begin]) * width if equilibrated.begin else 0.0)
        if equilibrated.samples < FEWEST:
            unclear.append(name)
        elif equilibrated.begin:
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


def verdict(runs: Runs) -> str:
    """Return a sentence on whether the runs had settled, and on the part that means are taken from."""
    length, begin = (f"{value:.4g} {runs.unit}" for value in (runs.length - runs.skipped, runs.begin))
    left_out = f"Means leave out the first {begin}"
    if runs.drifting:
        state = f"Not settled in {length}: {', '.join(runs.drifting)}"
    elif runs.unclear:
        state = f"{length}: too short to tell a trend of {', '.join(runs.unclear)}"
    elif runs.moving:
        state = f"Settled after {begin}: {', '.join(runs.moving)}"
        left_out = "Means are of the rest"
    else:
        steady = "energy, temperatures or density" if runs.first.moves_volume else "energy or temperatures"
        state = f"{length} without a trend of {steady}"
    sentences = [state, left_out] if runs.begin else [state]
    if doubtful := sum(run.unsettled is not None for run in runs.runs):
        of_all = f": {doubtful} of {len(runs.runs)} runs" if len(runs.runs) > 1 else ""
        sentences.append(f"Not equilibrated at the start{of_all}")
    return ". ".join(sentences)
