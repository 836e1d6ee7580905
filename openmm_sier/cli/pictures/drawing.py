"""The picture of one run or of several: panels of what their logs have, whose titles say what is found."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from openmm_sier.analysis.observables import energy_error
from openmm_sier.analysis.statistics import (
    ENOUGH_RUNS,
    FEWEST,
    Estimate,
    mean_and_error,
    over_runs,
    rms,
    slope_and_error,
)
from openmm_sier.cli.logged_runs import SETTLES, Run, Runs, finding, listed, remarks
from openmm_sier.cli.pictures import canvas, series
from openmm_sier.cli.pictures.page import page_of
from openmm_sier.cli.pictures.series import BLUE, GREEN, PURPLE, VERMILION, Look
from openmm_sier.cli.results import DENSITY
from openmm_sier.observe.conservation import CONSERVED, POTENTIAL, TEMPERATURES

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Standard errors from which on a difference is significant.
SIGNIFICANT = 3.0

#: Letters in a line of a title.
LINE_OF_TITLE, LINE_OF_PANEL, LINE_OF_CAPTION = 62, 66, 105

ENERGY = Look(BLUE)
KINDS = {
    TEMPERATURES[0]: ("translation", Look(BLUE, "-", "o")),
    TEMPERATURES[1]: ("rotation", Look(VERMILION, "--", "s")),
    TEMPERATURES[2]: ("flexible molecules", Look(GREEN, "-.", "^")),
}


class Panel(NamedTuple):
    """A panel: its finding, the label of its axis, and what draws it."""

    finding: str
    label: str
    draw: Callable[[Axes], None]


def draw(runs: Runs, path: Path) -> None:
    """Draw what the logs of runs have.

    Args:
        runs: of one kind.
        path: of the picture, see `canvas.check`.

    Raises:
        OSError: it cannot be written.
    """
    found = panels(runs)
    caption = textwrap.fill(caption_of(runs, found), LINE_OF_CAPTION)
    page = partial(page_of, runs, finding(runs), [*(each.finding for each in found), *remarks(runs)])
    with canvas.panels(path, len(found), textwrap.fill(finding(runs), LINE_OF_TITLE), caption, page) as axes:
        for each, panel in zip(axes, found, strict=True):
            panel.draw(each)
            series.shade_unsettled(each, runs)
            each.set_title(textwrap.fill(typeset(panel.finding), LINE_OF_PANEL))
            each.set(ylabel=panel.label, xlim=(0, runs.length))
        axes[-1].set_xlabel("trials" if runs.unit == "trials" else "time (ps)")


def typeset(text: str) -> str:
    """Return a text in which no line ends within a number with its error and unit, and a minus is no hyphen."""
    joined = re.sub(r" (?=±|%|K\b|kT\b|ps\b|kJ/mol|g/ml)|(?<=±) ", "\N{NO-BREAK SPACE}", text)
    return re.sub(r"(?<=\s)-(?=[\d.])", "\N{MINUS SIGN}", joined)


def panels(runs: Runs) -> list[Panel]:
    """Return the panels of runs, by their ensemble."""
    ensemble = runs.first.ensemble
    counted = all(np.isfinite(run.log[CONSERVED]).all() for run in runs.runs)
    found = [conserved_energy(runs)] if ensemble == "nve" else []
    found.append(potential_energy(runs))
    if ensemble == "nvt" and counted:
        found.append(heat(runs))
    found.append(temperatures(runs))
    if runs.first.moves_volume:
        found.append(density(runs))
    if ensemble == "hmc":
        found.append(acceptance(runs))
    return found


def caption_of(runs: Runs, found: list[Panel]) -> str:
    """Say what was simulated, and what lines and bands are."""
    width, rows = series.width_of_means(runs)
    over = f"means over {width:.3g} {runs.unit}" if rows > 1 else "rows of the log"
    if len(runs.runs) > 1:
        band = ", with a band of ± its standard error" if len(runs.runs) >= ENOUGH_RUNS else ""
        drawn = f"Thin lines: {over} of each run; thick: their mean{band}. "
    else:
        drawn = f"Lines: {over}{'; bands: ± rms within' if rows >= series.FEWEST_IN_A_BAND else ''}. "
    dashed = "Black: mean with its standard error. "
    plan = runs.first.plan
    dotted = "Dotted: temperature of the bath. " if plan and plan.ensemble != "nve" else ""
    left_out = "Hatched: left out of means. " if runs.begin else ""
    few = f"≥: from fewer than {FEWEST} independent values. " if any("≥" in panel.finding for panel in found) else ""
    return f"{runs.title}. {drawn}{dashed}{dotted}{left_out}{few}"


def _over(runs: Runs, estimate: Callable[[Run, dict[str, np.ndarray]], Estimate | float]) -> Estimate:
    """Return an estimate over all runs, from the parts of their logs that had settled."""
    found = over_runs([estimate(run, run.after(runs.begin)) for run in runs.runs])
    return found if isinstance(found, Estimate) else Estimate(found, math.nan)


def _least_difference(found: Estimate) -> float:
    """Return the least difference that is significant for a value with this error."""
    # An error from few samples is as little as half of what it should be.
    return SIGNIFICANT * found.error * (2 if found.samples < FEWEST else 1)


def _is_significant(found: Estimate) -> bool:
    """Return whether a value is more than its error."""
    return abs(found.value) > _least_difference(found)


def _verb_of_mean(runs: Runs, column: str) -> str:
    """Return the verb of a mean, by whether its quantity had settled."""
    if SETTLES[column] in runs.drifting:
        return "still drifts, around"
    return "may still drift, around" if SETTLES[column] in runs.unclear else "is"


def conserved_energy(runs: Runs) -> Panel:
    """Draw the conserved energy about its mean, over the fluctuation of the potential energy if that has any."""
    drift = _over(runs, lambda run, log: slope_and_error(log["Time (ps)"], log[CONSERVED]))
    spread = float(np.mean([rms(run.log[POTENTIAL]) for run in runs.runs]))
    if spread:
        error = _over(runs, lambda run, log: 100 * energy_error(log[CONSERVED], log[POTENTIAL]))
        share, unit, factor = f"{error.value:.2g} % of rms(V)", "% of rms(V)", 100 / spread
    else:
        error = _over(runs, lambda run, log: rms(log[CONSERVED]))
        share, unit, factor = f"{error.value:.2g} kJ/mol", "kJ/mol", 1.0
    if not math.isfinite(drift.error):
        finding = f"The energy is held to {share}; the run is too short to tell a drift"
    elif _is_significant(drift):
        finding = f"The energy is held to {share}; it drifts by {drift} kJ/mol/ps"
    else:
        finding = f"The energy is held to {share}; no drift shows: {drift} kJ/mol/ps"

    def draw(axes: Axes) -> None:
        axes.axhline(0, color="0.35", lw=1)
        series.draw(axes, series.means_of(runs, CONSERVED, factor, about_mean=True), Look(PURPLE))

    return Panel(finding, f"H, from its mean\n({unit})", draw)


def potential_energy(runs: Runs) -> Panel:
    """Draw the potential energy with its mean."""
    found = _over(runs, _mean_of(POTENTIAL))

    def draw(axes: Axes) -> None:
        series.draw(axes, series.means_of(runs, POTENTIAL), ENERGY)
        series.draw_mean(axes, runs, found, ENERGY)

    return Panel(f"The potential energy {_verb_of_mean(runs, POTENTIAL)} {found} kJ/mol", "V (kJ/mol)", draw)


def heat(runs: Runs) -> Panel:
    """Draw the conserved energy in a bath, whose drift is the heat of the steps."""
    found = _over(runs, lambda run, log: slope_and_error(log["Time (ps)"], log[CONSERVED]))
    if not math.isfinite(found.error):
        finding = "The heat of the steps: the run is too short to tell"
    elif _is_significant(found):
        verb = "heat" if found.value > 0 else "cool"
        finding = f"The steps {verb} by {found.times(math.copysign(1, found.value))} kJ/mol/ps, which the bath balances"
    else:
        finding = f"No heat of the steps shows: {found} kJ/mol/ps"

    def draw(axes: Axes) -> None:
        axes.axhline(0, color="0.35", lw=1)
        series.draw(axes, series.means_of(runs, CONSERVED, about_mean=True), Look(PURPLE))

    return Panel(finding, "H, from its mean\n(kJ/mol)", draw)


def temperatures(runs: Runs) -> Panel:
    """Draw the temperatures by kind, with the bath's, or against that of translation."""
    present = [name for name in KINDS if np.isfinite(runs.first.log[name]).all()]
    found = {name: _over(runs, _mean_of(name)) for name in present}
    plan = runs.first.plan
    bath = plan.temperature if plan and plan.ensemble != "nve" else None

    def draw(axes: Axes) -> None:
        if bath is not None:
            axes.axhline(bath, color="0.2", lw=2, ls=":")
        for name in present:
            kind, look = KINDS[name]
            means = series.means_of(runs, name)
            series.draw(axes, means, look, f"{kind} {found[name]} K", scatter=False)
        # Above the lines there is room for the legend.
        least, most = axes.get_ylim()
        axes.set_ylim(least, most + (0.25 if len(present) < 3 else 0.45) * (most - least))
        axes.legend(loc="upper left", ncols=2, columnspacing=1.2, handlelength=2.6, borderaxespad=0.1)

    return Panel(_of_temperatures(runs, found, bath), "T (K)", draw)


def _of_temperatures(runs: Runs, found: dict[str, Estimate], bath: float | None) -> str:
    """Say what is found of temperatures: what is off most by its own error, from the bath or from translation."""
    if any(SETTLES[name] in runs.drifting for name in found):
        return "Temperatures have not settled"
    if bath is not None:
        off = {name: each._replace(value=each.value - bath) for name, each in found.items()}
        other = f"the bath of {bath:g} K"
    else:
        off = {name: _over(runs, _difference(name)) for name in list(found)[1:]}
        other = KINDS[next(iter(found))][0]
    if not off:
        return f"The temperature is {next(iter(found.values()))} K"
    if not all(math.isfinite(each.error) for each in off.values()):
        return "Temperatures: too short to tell them apart"
    worst = max(off, key=lambda name: abs(off[name].value) - _least_difference(off[name]))
    if not _is_significant(off[worst]):
        kinds = listed([KINDS[name][0] for name in off])
        within = max(map(_least_difference, off.values()))
        return f"{kinds[0].upper()}{kinds[1:]}: no difference from {other} shows within {within:.2g} K"
    warmer = "warmer" if off[worst].value > 0 else "colder"
    by = off[worst].times(math.copysign(1, off[worst].value))
    kind = KINDS[worst][0]
    verb = "is" if kind != "flexible molecules" else "are"
    return f"{kind[0].upper()}{kind[1:]} {verb} {by} K {warmer} than {other}"


def _mean_of(name: str) -> Callable[[Run, dict[str, np.ndarray]], Estimate]:
    """Return what gives the mean of a column."""

    def mean(run: Run, log: dict[str, np.ndarray]) -> Estimate:
        return mean_and_error(log[name])

    return mean


def _difference(name: str) -> Callable[[Run, dict[str, np.ndarray]], Estimate]:
    """Return what gives the mean of a temperature less that of the first kind there is."""

    def difference(run: Run, log: dict[str, np.ndarray]) -> Estimate:
        first = next(other for other in KINDS if np.isfinite(log[other]).all())
        return mean_and_error(log[name] - log[first])

    return difference


def density(runs: Runs) -> Panel:
    """Draw the density with its mean."""
    found = _over(runs, _mean_of(DENSITY))

    def draw(axes: Axes) -> None:
        series.draw(axes, series.means_of(runs, DENSITY), Look(GREEN))
        series.draw_mean(axes, runs, found, Look(GREEN))

    return Panel(f"The density {_verb_of_mean(runs, DENSITY)} {found} g/ml", "density (g/ml)", draw)


def acceptance(runs: Runs) -> Panel:
    """Draw the fraction of trials that were accepted up to each moment."""
    found = _over(runs, lambda run, log: 100 * float(log["Acceptance"][-1]))
    errors = _over(runs, lambda run, log: float(np.nanstd(log["Energy Error (kT)"])))
    share = f"{found.value:.1f}" if not math.isfinite(found.error) else str(found)

    def draw(axes: Axes) -> None:
        series.draw(axes, series.means_of(runs, "Acceptance", 100), Look(VERMILION), scatter=len(runs.runs) > 1)

    finding = f"{share} % of the trials are accepted; the sd of their energy errors is {errors.value:.2g} kT"
    return Panel(finding, "accepted so far (%)", draw)
