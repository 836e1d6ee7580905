"""The picture of one run or of several: panels of the columns of their logs."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from openmm_sier.analysis.statistics import ENOUGH_RUNS, Estimate, mean_and_error, over_runs, rms
from openmm_sier.cli.findings import MOTIONS
from openmm_sier.cli.logged_runs import Runs
from openmm_sier.cli.pictures import canvas, series
from openmm_sier.cli.pictures.page import page_of
from openmm_sier.cli.pictures.series import BLUE, GREEN, PURPLE, VERMILION, Look
from openmm_sier.cli.results import ACCEPTANCE, DENSITY
from openmm_sier.observe.conservation import CONSERVED, POTENTIAL, TEMPERATURES

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Letters in a line of the title and of the caption.
LINE_OF_TITLE, LINE_OF_CAPTION = 62, 105

ENERGY = Look(BLUE)
TEMPERATURE_LOOKS = dict(
    zip(TEMPERATURES, (Look(BLUE, "-", "o"), Look(VERMILION, "--", "s"), Look(GREEN, "-.", "^")), strict=True)
)


class Panel(NamedTuple):
    """A panel: its title, the label of its axis, and the function that draws it."""

    title: str
    label: str
    draw: Callable[[Axes], None]


def draw(runs: Runs, path: Path) -> None:
    """Draw the logs of runs.

    Args:
        runs: of one kind.
        path: of the picture, see `canvas.check`.

    Raises:
        OSError: it cannot be written.
    """
    drawn = panels(runs)
    caption = textwrap.fill(caption_of(runs), LINE_OF_CAPTION)
    title = textwrap.fill(runs.title, LINE_OF_TITLE)
    with canvas.panels(path, len(drawn), title, caption, partial(page_of, runs)) as all_axes:
        for axes, panel in zip(all_axes, drawn, strict=True):
            panel.draw(axes)
            series.shade_unsettled(axes, runs)
            axes.set_title(panel.title)
            axes.set(ylabel=panel.label, xlim=(0, runs.length))
        all_axes[-1].set_xlabel("trials" if runs.unit == "trials" else "time (ps)")


def panels(runs: Runs) -> list[Panel]:
    """Return the panels of runs, by their ensemble."""
    drawn = [potential_energy(runs)]
    is_counted = all(np.isfinite(run.log[CONSERVED]).all() for run in runs.runs)
    if runs.ensemble != "hmc" and is_counted:
        drawn.append(conserved_energy(runs))
    if runs.ensemble == "nve":
        drawn.reverse()
    drawn.append(temperatures(runs))
    if runs.first.moves_volume:
        drawn.append(density(runs))
    if runs.ensemble == "hmc":
        drawn.append(acceptance(runs))
    return drawn


def caption_of(runs: Runs) -> str:
    """Return the caption, which explains lines and bands."""
    width, rows = series.width_of_means(runs)
    over = f"means over {width:.3g} {runs.unit}" if rows > 1 else "rows of the log"
    if len(runs.runs) > 1:
        band = ", with a band of ± its standard error" if len(runs.runs) >= ENOUGH_RUNS else ""
        lines = f"Thin lines: {over} of each run; thick: their mean{band}. "
    else:
        lines = f"Lines: {over}{'; bands: ± rms within' if rows >= series.FEWEST_IN_A_BAND else ''}. "
    dashed = "Black: mean with its standard error. "
    dotted = "Dotted: temperature of the bath. " if _bath(runs) is not None else ""
    left_out = "Hatched: left out of means. " if runs.begin else ""
    return f"{lines}{dashed}{dotted}{left_out}"


def conserved_energy(runs: Runs) -> Panel:
    """Draw the conserved energy about its mean; its drift is the error of the steps, or in a bath their heat.

    At constant energy it is drawn over the fluctuation of the potential energy, if that has any.
    """
    spread = float(np.mean([rms(run.log[POTENTIAL]) for run in runs.runs])) if runs.ensemble == "nve" else 0.0
    unit, factor = ("% of rms(V)", 100 / spread) if spread else ("kJ/mol", 1.0)

    def draw(axes: Axes) -> None:
        axes.axhline(0, color="0.35", lw=1)
        series.draw(axes, series.means_of(runs, CONSERVED, factor, about_mean=True), Look(PURPLE))

    return Panel("Conserved energy H", f"H, from its mean\n({unit})", draw)


def potential_energy(runs: Runs) -> Panel:
    """Draw the potential energy with its mean."""

    def draw(axes: Axes) -> None:
        series.draw(axes, series.means_of(runs, POTENTIAL), ENERGY)
        series.draw_mean(axes, runs, _mean(runs, POTENTIAL), ENERGY)

    return Panel("Potential energy V", "V (kJ/mol)", draw)


def temperatures(runs: Runs) -> Panel:
    """Draw the temperatures of all motions, and that of the bath."""
    present = [column for column in MOTIONS if np.isfinite(runs.first.log[column]).all()]
    bath = _bath(runs)

    def draw(axes: Axes) -> None:
        if bath is not None:
            axes.axhline(bath, color="0.2", lw=2, ls=":")
        for column in present:
            look, means = TEMPERATURE_LOOKS[column], series.means_of(runs, column)
            series.draw(axes, means, look, MOTIONS[column], scatter=False)
        # Room for the legend above the lines.
        least, most = axes.get_ylim()
        axes.set_ylim(least, most + 0.25 * (most - least))
        axes.legend(loc="upper left", ncols=3, columnspacing=1.2, handlelength=2.6, borderaxespad=0.1)

    return Panel("Temperatures", "T (K)", draw)


def density(runs: Runs) -> Panel:
    """Draw the density with its mean."""

    def draw(axes: Axes) -> None:
        series.draw(axes, series.means_of(runs, DENSITY), Look(GREEN))
        series.draw_mean(axes, runs, _mean(runs, DENSITY), Look(GREEN))

    return Panel("Density", "density (g/ml)", draw)


def acceptance(runs: Runs) -> Panel:
    """Draw the fraction of accepted trials up to each moment."""

    def draw(axes: Axes) -> None:
        series.draw(axes, series.means_of(runs, ACCEPTANCE, 100), Look(VERMILION), scatter=len(runs.runs) > 1)

    return Panel("Accepted trials", "accepted so far (%)", draw)


def _bath(runs: Runs) -> float | None:
    """Return the temperature of the bath, K; None without a bath or a checkpoint."""
    plan = runs.first.plan
    return plan.temperature if plan and plan.ensemble != "nve" else None


def _mean(runs: Runs, column: str) -> Estimate:
    """Return the mean of a column over all runs, from the parts of their logs that had settled."""
    mean = over_runs([mean_and_error(run.after(runs.begin)[column]) for run in runs.runs])
    assert isinstance(mean, Estimate)
    return mean
