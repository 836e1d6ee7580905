"""The style of figures, and the figure of a liquid's properties. Figures need matplotlib, an extra."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from openmm_sier.measure.properties import mean_square_displacements, orientation_correlation
from openmm_sier.measure.report import Report

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from openmm_sier.measure.liquid_samples import LiquidSamples

RC: Any = {
    "font.size": 11,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "lines.markersize": 5,
    "legend.frameon": False,
    "savefig.dpi": 160,
}

#: Of the lines, that of SIER4G in all figures.
COLOUR = "#d6338a"


def can_draw(report: Report) -> bool:
    """Whether matplotlib is installed; where it is not, a note says how to get it."""
    if find_spec("matplotlib") is None:
        report.note("no figure: figures need matplotlib; install it with: pip install 'openmm-sier[plots]'")
        return False
    return True


def context() -> AbstractContextManager:
    """The style of all figures, for a with-statement."""
    import matplotlib as mpl

    return mpl.rc_context(RC)


def panels(columns: int, title: str = "", **options: Any) -> tuple[Figure, list[Axes]]:
    """A Figure with panels side by side, and the list of them.

    Args:
        columns: number of panels.
        title: above all of them.
        options: of `Figure.subplots`.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(1 + 5.6 * columns, 4.8), layout="constrained")
    if title:
        figure.suptitle(title, x=0.01, ha="left", fontsize=14, fontweight="bold")
    return figure, list(figure.subplots(1, columns, squeeze=False, **options)[0])


def property_figure(
    samples: Sequence[LiquidSamples],
    title: str,
    path: Path,
    viscosities: tuple[np.ndarray, np.ndarray] | None = None,
    moving: bool = True,
) -> None:
    """Pair distribution, displacements, the decay of orientations and the viscosity of a liquid, the mean of all runs.

    Args:
        samples: of runs with the same interval between frames.
        title: above the figure.
        path: PNG file to write.
        viscosities: times (k,), ps, and running Green-Kubo integrals (c, k), mPa s; None leaves their panel out.
        moving: whether frames follow each other by motion; otherwise displacements and orientations are left out.
    """
    with context():
        figure, (pairs, *further) = panels(1 + 2 * moving + (viscosities is not None), title)
        pairs.plot(samples[0].distances, np.mean([run.pairs for run in samples], axis=0), color=COLOUR)
        pairs.set_xlabel("distance (nm)")
        pairs.set_ylabel("pair distribution of first atoms")
        if moving:
            _draw_motion(further[0], further[1], samples)
        if viscosities is not None:
            _draw_integrals(further[-1], *viscosities)
        figure.savefig(path)


def _draw_motion(displacements: Axes, turning: Axes, samples: Sequence[LiquidSamples]) -> None:
    longest = min(len(run.centres) for run in samples) // 4
    times = np.arange(longest) * samples[0].interval
    squares = np.mean([mean_square_displacements(run.centres)[:longest] for run in samples], axis=0)
    displacements.plot(times, squares, color=COLOUR)
    displacements.set_xlabel("time (ps)")
    displacements.set_ylabel("mean square displacement (nm²)")
    decay = np.mean([orientation_correlation(run.directions, longest) for run in samples], axis=0)[:longest]
    shown = decay > 0.02
    turning.semilogy(times[shown], decay[shown], color=COLOUR)
    turning.set_xlabel("time (ps)")
    turning.set_ylabel(r"$\langle P_2 \rangle$ of orientations")


def _draw_integrals(axes: Axes, times: np.ndarray, integrals: np.ndarray) -> None:
    value, error = integrals.mean(axis=0), integrals.std(axis=0, ddof=1) / np.sqrt(len(integrals))
    axes.plot(times, value, color=COLOUR)
    axes.fill_between(times, value - error, value + error, color=COLOUR, alpha=0.25, lw=0)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("upper limit of the Green-Kubo integral (ps)")
    axes.set_ylabel("shear viscosity (mPa s)")
