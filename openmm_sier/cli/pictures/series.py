"""Series of means over equal times, drawn with the scatter of one run or the error of several."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from openmm_sier.analysis.statistics import ENOUGH_RUNS, Estimate
from openmm_sier.cli.logged_runs import Runs
from openmm_sier.cli.settling import binned

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Largest number of means of a series.
MOST_MEANS = 60

#: Fewest rows whose scatter is drawn as a band.
FEWEST_IN_A_BAND = 4

#: Lengths over which means are taken, times powers of ten.
ROUND = (1.0, 2.0, 5.0)


class Look(NamedTuple):
    """Style of a series, recognizable without colours too."""

    colour: str
    line: str = "-"
    marker: str = "o"


#: Colours of Okabe and Ito for the colour-blind.
BLUE, VERMILION, GREEN, PURPLE, BLACK = "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#000000"


class Means(NamedTuple):
    """Means of a series of runs over equal times.

    Attributes:
        middles: of these times, (n,).
        values: of each run, (runs, n).
        scatter: standard deviation within each time, (runs, n); None where there are too few rows.
    """

    middles: np.ndarray
    values: np.ndarray
    scatter: np.ndarray | None

    @property
    def mean(self) -> np.ndarray:
        """Means over runs (n,)."""
        return self.values.mean(axis=0)

    @property
    def error(self) -> np.ndarray | None:
        """Standard errors of the mean over runs (n,), from their scatter; None for too few runs."""
        number = len(self.values)
        return self.values.std(axis=0, ddof=1) / math.sqrt(number) if number >= ENOUGH_RUNS else None


def width_of_means(runs: Runs) -> tuple[float, int]:
    """Return the length over which means are taken, and its number of rows in the log with the fewest rows.

    It is a whole number of rows near a round time, with about `MOST_MEANS` means at most.
    """
    interval = max(float(np.diff(run.clock).max()) for run in runs.runs)
    if runs.length <= MOST_MEANS * interval:
        return interval, 1
    least = runs.length / MOST_MEANS
    power = 10.0 ** math.floor(math.log10(least))
    width = next(power * step for step in (*ROUND, 10.0) if power * step >= least)
    rows = round(width / interval)
    return rows * interval, rows


def means_of(runs: Runs, column: str, factor: float = 1.0, about_mean: bool = False) -> Means:
    """Return means of a column of the log.

    Args:
        runs: of one kind.
        column: of their logs.
        factor: by which values are multiplied.
        about_mean: whether the mean of each run is subtracted.
    """
    width, rows = width_of_means(runs)
    count = max(1, math.floor(runs.length / width * (1 + 1e-6)))
    values, squares = [], []
    for run in runs.runs:
        series = run.log[column] - (np.nanmean(run.after(runs.begin)[column]) if about_mean else 0.0)
        # Relative to the mean, so that squares do not lose the scatter to rounding.
        middle = np.nanmean(series)
        means = binned(run.clock, series - middle, width, count)
        values.append(factor * (means + middle))
        variance = binned(run.clock, (series - middle) ** 2, width, count) - means**2
        squares.append(factor * np.sqrt(np.maximum(variance, 0)))
    scatter = np.array(squares) if rows >= FEWEST_IN_A_BAND else None
    return Means(width * (np.arange(count) + 0.5), np.array(values), scatter)


def draw(axes: Axes, means: Means, look: Look, label: str = "", scatter: bool = True) -> None:
    """Draw a series.

    One run is a line with a band of its scatter. Several are thin lines, and their mean is a thick one, with a band of
    its standard error if there are enough runs.

    Args:
        axes: to draw on.
        means: of the series.
        look: style of the series.
        label: in a legend.
        scatter: whether to draw the band of one run, or the thin lines of several.
    """
    at, has_several_runs = means.middles, len(means.values) > 1
    if has_several_runs and scatter:
        axes.plot(at, means.values.T, color=look.colour, lw=0.8, alpha=0.4)
    error = means.error
    if not has_several_runs and scatter and means.scatter is not None:
        error = means.scatter[0]
    if error is not None:
        axes.fill_between(at, means.mean - error, means.mean + error, color=look.colour, alpha=0.3, lw=0)
    every = max(1, len(at) // 15)
    axes.plot(
        at,
        means.mean,
        look.line,
        color=look.colour,
        lw=2.2,
        marker=look.marker,
        markevery=every,
        ms=6,
        label=label or None,
    )


def draw_mean(axes: Axes, runs: Runs, mean: Estimate, look: Look) -> None:
    """Draw a mean with its standard error, over the part of the run that it is taken from."""
    if not math.isfinite(mean.value):
        return
    error = mean.error if math.isfinite(mean.error) else 0.0
    ends = [runs.begin, runs.length]
    axes.fill_between(ends, mean.value - error, mean.value + error, color=BLACK, alpha=0.22, lw=0)
    axes.plot(ends, [mean.value] * 2, color=BLACK, lw=1.3, ls="--")


def shade_unsettled(axes: Axes, runs: Runs) -> None:
    """Shade the beginning of the runs, which is left out of means."""
    if runs.begin:
        axes.axvspan(0, runs.begin, facecolor="0.94", edgecolor="0.8", hatch="//", lw=0, zorder=0)
