"""The style of figures, and the figure of a liquid's properties. Figures need matplotlib, an extra."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

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


def panels(columns: int, title: str = "", rows: int = 1, **options: Any) -> tuple[Figure, list[Axes]]:
    """A Figure with panels side by side, and the list of them.

    Args:
        columns: number of panels side by side.
        title: above all of them.
        rows: of panels; the list goes through one after the other.
        options: of `Figure.subplots`.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(1 + 5.6 * columns, 4.8 * rows), layout="constrained")
    if title:
        figure.suptitle(title, x=0.01, ha="left", fontsize=14, fontweight="bold")
    return figure, list(figure.subplots(rows, columns, squeeze=False, **options).flat)


class Curve(NamedTuple):
    """What a panel shows.

    Attributes:
        x: (k,), in the unit that its label says.
        y: (k,) likewise.
        error: (k,), standard errors of y; None where they are not known.
    """

    x: np.ndarray
    y: np.ndarray
    error: np.ndarray | None = None


#: Labels of the axes of each curve of a liquid, in the order of their panels.
LABELS = {
    "pairs": ("distance (nm)", "pair distribution of first atoms"),
    "displacements": ("time (ps)", "mean square displacement (nm²)"),
    "orientations": ("time (ps)", r"$\langle P_2 \rangle$ of orientations"),
    "viscosity": ("upper limit of the Green-Kubo integral (ps)", "shear viscosity (mPa s)"),
}


def property_curves(
    samples: Sequence[LiquidSamples], viscosities: tuple[np.ndarray, np.ndarray] | None = None, moving: bool = True
) -> dict[str, Curve]:
    """Curves of a liquid by the keys of `LABELS`, the mean of all runs.

    Args:
        samples: of runs with the same interval between frames; none where the box is no liquid.
        viscosities: times (k,), ps, and running Green-Kubo integrals (c, k), mPa s; None leaves them out.
        moving: whether frames follow each other by motion; otherwise displacements and orientations are left out.
    """
    found = {}
    if samples:
        found["pairs"] = Curve(samples[0].distances, np.mean([run.pairs for run in samples], axis=0))
    if samples and moving:
        longest = min(len(run.centres) for run in samples) // 4
        times = np.arange(longest) * samples[0].interval
        squares = np.mean([mean_square_displacements(run.centres)[:longest] for run in samples], axis=0)
        decay = np.mean([orientation_correlation(run.directions, longest) for run in samples], axis=0)[:longest]
        # What remains after this is noise, which a logarithm would magnify.
        shown = decay > 0.02
        found |= {"displacements": Curve(times, squares), "orientations": Curve(times[shown], decay[shown])}
    if viscosities is not None:
        times, integrals = viscosities
        error = integrals.std(axis=0, ddof=1) / np.sqrt(len(integrals))
        found["viscosity"] = Curve(times, integrals.mean(axis=0), error)
    return found


def property_figure(curves: Mapping[str, Curve], title: str, path: Path) -> None:
    """Pair distribution, displacements, orientations and viscosity of a liquid, as far as they are known.

    Args:
        curves: see `property_curves`.
        title: above the figure.
        path: PNG file to write.
    """
    columns = min(2, len(curves))
    with context():
        figure, axes = panels(columns, title, rows=math.ceil(len(curves) / columns))
        for empty in axes[len(curves) :]:
            empty.remove()
        for panel, (name, curve) in zip(axes, curves.items(), strict=False):
            panel.plot(curve.x, curve.y, color=COLOUR)
            if curve.error is not None:
                band = (curve.y - curve.error, curve.y + curve.error)
                panel.fill_between(curve.x, *band, color=COLOUR, alpha=0.25, lw=0)
            panel.set_xlabel(LABELS[name][0])
            panel.set_ylabel(LABELS[name][1])
            if name == "orientations":
                panel.set_yscale("log")
            else:
                panel.set_ylim(bottom=0)
        figure.savefig(path)
