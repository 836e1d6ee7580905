"""The picture of one run or of several: panels of the columns of their logs."""

from __future__ import annotations

import hashlib
import io
import math
import os
import textwrap
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from openmm_sier.analysis.statistics import ENOUGH_RUNS, Estimate, mean_and_error, over_runs, rms
from openmm_sier.cli.errors import Misused
from openmm_sier.cli.files import records
from openmm_sier.cli.files.places import check_place, refuse_to_replace
from openmm_sier.cli.logged_runs import Runs
from openmm_sier.cli.results import ACCEPTANCE, DENSITY, TEMPERATURE_NAMES
from openmm_sier.cli.settling import binned
from openmm_sier.inputs.source_files import FilePath
from openmm_sier.observe.conservation import CONSERVED, POTENTIAL, TEMPERATURES
from openmm_sier.system.untrusted_files import open_regular

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Metadata that matplotlib writes, by the ending of the name: no date, so that equal logs give equal files.
ENDINGS: dict[str, dict[str, Any]] = {".png": {}, ".svg": {"Date": None}}

#: Bytes at the beginning of a picture that hold its metadata.
METADATA = 2**13

#: Largest number of means over equal times in a line.
MOST_MEANS = 60

#: Colours of Okabe and Ito for the colour-blind, and styles by which lines are recognized without colours too.
BLUE, VERMILION, GREEN, PURPLE = "#0072b2", "#d55e00", "#009e73", "#cc79a7"
STYLES = "-", "--", "-."

#: Inches, and letters in a line of the title.
WIDTH, HEIGHT_OF_PANEL, HEIGHT_OF_TITLE, LETTERS = 9.0, 2.6, 0.9, 62

#: A legend with four entries, beside a title.
LEGEND: Any = {"borderaxespad": 0, "fontsize": 11, "handlelength": 1.9, "columnspacing": 1.2}

RC: Any = {
    "font.size": 13,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.formatter.useoffset": False,
    "grid.alpha": 0.3,
    "legend.frameon": False,
    "savefig.dpi": 160,
    "svg.hashsalt": "openmm-sier",
}


class Panel(NamedTuple):
    """A panel of a picture.

    Attributes:
        title, label: the title, and the label of its vertical axis.
        colours: of each drawn column of the log.
        factor: by which values are multiplied.
        about_mean: whether the mean of each run is subtracted.
        has_mean: whether the mean over all runs is drawn with its error.
    """

    title: str
    label: str
    colours: dict[str, str]
    factor: float = 1.0
    about_mean: bool = False
    has_mean: bool = False


def check(
    path: Path,
    inputs: Collection[FilePath],
    overwrite: bool,
    outputs: Collection[Path] = (),
    log: Path | None = None,
) -> None:
    """Refuse a picture that cannot be drawn, or would overwrite another file.

    Args:
        path: of the picture.
        inputs, outputs: other files that the command reads and writes.
        overwrite: whether any existing file is replaced.
        log: the first log of an earlier picture that is replaced too; None for none.

    Raises:
        Misused: its name has a wrong ending.
        RunError: naming the file that is in the way.
        ModuleNotFoundError: there is no matplotlib; the message says how to install it.
    """
    if path.suffix.lower() not in ENDINGS:
        raise Misused(f"the name of a picture must end in {' or '.join(ENDINGS)}, got {path}")
    check_place(path, inputs, outputs)
    if not overwrite and not (log is not None and path.is_file() and _is_of(path, log)):
        refuse_to_replace(path)
    try:
        import matplotlib.figure  # noqa: F401
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "pictures need matplotlib; install it with: pip install 'openmm-sier[plot]'"
        ) from error


def _mark(path: Path, log: Path) -> str:
    """Return the text in a picture by which a later command recognizes it as that of a log."""
    name = os.path.relpath(os.path.realpath(log), os.path.dirname(os.path.realpath(path)))
    return f"openmm-sier {hashlib.blake2b(os.fsencode(name), digest_size=16).hexdigest()}"


def _is_of(path: Path, log: Path) -> bool:
    """Return whether a file is the picture of a log, or of several of which this is the first."""
    with open_regular(path) as file:
        return _mark(path, log).encode() in file.read(METADATA)


def draw(runs: Runs, path: Path) -> None:
    """Draw the logs of runs of one kind.

    Raises:
        OSError: the picture cannot be written. An earlier one still exists.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    drawn = panels(runs)
    with mpl.rc_context(RC):
        size = WIDTH, HEIGHT_OF_PANEL * len(drawn) + HEIGHT_OF_TITLE
        figure = Figure(figsize=size, layout="constrained")
        # Lines end at commas, so that a number stays with its unit.
        title = runs.title.replace(" ", "\N{NO-BREAK SPACE}").replace(",\N{NO-BREAK SPACE}", ", ")
        figure.suptitle(textwrap.fill(title, LETTERS), x=0.01, ha="left", fontsize=17, fontweight="bold")
        axes = figure.subplots(len(drawn), 1, squeeze=False, sharex=True)[:, 0]
        for panel, place in zip(drawn, axes, strict=True):
            _draw_panel(place, runs, panel)
        axes[-1].set_xlabel("trials" if runs.unit == "trials" else "time (ps)")
        figure.align_ylabels(axes)
        content, ending = io.BytesIO(), path.suffix.lower()
        metadata = ENDINGS[ending] | {"Description": _mark(path, runs.first.path)}
        figure.savefig(content, format=ending[1:], metadata=metadata)
    records.replace(path, content.getbuffer())


def panels(runs: Runs) -> list[Panel]:
    """Return the panels of runs, by their ensemble."""
    drawn = [Panel("Potential energy V", "V (kJ/mol)", {POTENTIAL: BLUE}, has_mean=True)]
    if runs.ensemble != "hmc" and all(np.isfinite(run.log[CONSERVED]).all() for run in runs.runs):
        drawn.append(_conserved_energy(runs))
    if runs.ensemble == "nve":
        drawn.reverse()
    colours = dict(zip(TEMPERATURES, (BLUE, VERMILION, GREEN), strict=True))
    present = {column: colour for column, colour in colours.items() if np.isfinite(runs.first.log[column]).all()}
    drawn.append(Panel("Temperatures", "T (K)", present))
    if runs.first.moves_volume:
        drawn.append(Panel("Density", "density (g/ml)", {DENSITY: GREEN}, has_mean=True))
    if runs.ensemble == "hmc":
        drawn.append(Panel("Accepted trials", "accepted so far (%)", {ACCEPTANCE: VERMILION}, factor=100))
    return drawn


def _conserved_energy(runs: Runs) -> Panel:
    """Return the panel of the conserved energy, at constant energy relative to the scatter of the potential energy."""
    spread = float(np.mean([rms(run.log[POTENTIAL]) for run in runs.runs])) if runs.ensemble == "nve" else 0.0
    unit, factor = ("% of rms(V)", 100 / spread) if spread else ("kJ/mol", 1.0)
    return Panel("Conserved energy H", f"H, from its mean\n({unit})", {CONSERVED: PURPLE}, factor, about_mean=True)


def means_of(runs: Runs, column: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the middles of equal times (n,), and the means of a column over these times in each run (runs, n)."""
    count = min(MOST_MEANS, *(len(run.clock) - 1 for run in runs.runs))
    width = runs.length / count
    means = [binned(run.clock, run.log[column], width, count) for run in runs.runs]
    return width * (np.arange(count) + 0.5), np.array(means)


def _draw_panel(axes: Axes, runs: Runs, panel: Panel) -> None:
    for (column, colour), style in zip(panel.colours.items(), STYLES, strict=False):
        _draw_column(axes, runs, panel, column, colour, style)
    if len(panel.colours) > 1:
        plan = runs.first.plan
        if plan and plan.ensemble != "nve":
            axes.axhline(plan.temperature, color="0.2", lw=2, ls=":", label="bath")
        # Above the panel, right of its title, where no line runs through it.
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=len(panel.colours) + 1, **LEGEND)
    if runs.begin:
        # Left out of means.
        axes.axvspan(0, runs.begin, facecolor="0.94", edgecolor="0.8", hatch="//", lw=0, zorder=0)
    axes.set_title(panel.title)
    axes.set(ylabel=panel.label, xlim=(0, runs.length))


def _draw_column(axes: Axes, runs: Runs, panel: Panel, column: str, colour: str, style: str) -> None:
    """Draw each run; the mean of several is a thick line, with a band of its standard error if they are enough."""
    times, values = means_of(runs, column)
    if panel.about_mean:
        values -= np.array([[np.nanmean(run.after(runs.begin)[column])] for run in runs.runs])
    values *= panel.factor
    mean = values.mean(axis=0)
    axes.plot(times, mean, style, color=colour, lw=2.2, label=TEMPERATURE_NAMES.get(column))
    if len(values) > 1 and len(panel.colours) == 1:
        axes.plot(times, values.T, color=colour, lw=0.8, alpha=0.4)
    if len(values) >= ENOUGH_RUNS:
        error = values.std(axis=0, ddof=1) / math.sqrt(len(values))
        axes.fill_between(times, mean - error, mean + error, color=colour, alpha=0.3, lw=0)
    if panel.has_mean:
        over_all = over_runs([mean_and_error(run.after(runs.begin)[column]) for run in runs.runs])
        assert isinstance(over_all, Estimate)
        _draw_mean(axes, over_all, [runs.begin, runs.length])


def _draw_mean(axes: Axes, mean: Estimate, ends: list[float]) -> None:
    """Draw a mean with its standard error, if it is known, over the time that it is taken from."""
    axes.plot(ends, [mean.value] * 2, color="black", lw=1.3, ls="--")
    if math.isfinite(mean.error):
        axes.fill_between(ends, mean.value - mean.error, mean.value + mean.error, color="black", alpha=0.22, lw=0)
