"""Style of all figures: one colour and marker for each method, and lines with standard errors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

GREY = "0.35"

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

#: Colour and marker of every method. Methods of this package have saturated colours; one with a heat bath looks as
#: without it.
METHODS = {
    "SIER2": ("#0072b2", "o"),
    "SIER2V2": ("#00a6d6", ">"),
    "SIER2P3": ("#1b3a93", "*"),
    "SIER4": ("#d55e00", "D"),
    "SIER4V": ("#7b3294", "v"),
    "SIER4G": ("#d6338a", "^"),
    "SIER4P": ("#007f5f", "P"),
    "MRDL": ("#e69f00", "s"),
    "SEJ4": ("#56b4e9", "<"),
    "OpenMM Verlet": ("#4d4d4d", "s"),
    "Verlet, RATTLE": ("#7f7f7f", "s"),
    "OpenMM LangevinMiddle": ("#b5651d", "X"),
    "OpenMM MTSLangevin": ("#8a4b08", "P"),
}

UNKNOWN = ("#000000", "x")

#: Boxes of the repository by their names, as titles name them.
MODELS = {"spce-512": "SPC/E", "tip3p-512": "TIP3P", "tip4p2005-512": "TIP4P/2005"}

#: Methods of this package, drawn with full lines and markers; others have broken lines and open markers.
OWN = ("SIER", "MRDL", "SEJ4")


def of_method(name: str) -> dict[str, Any]:
    """Return keyword arguments of `Axes.plot` for a method; one that is not in the table is black.

    Hybrid Monte Carlo has the colour of its scheme. What stands after a comma, such as a step, does not matter, and
    "OpenMM" before the name of an integrator may be missing.
    """
    name = name.partition(",")[0] if name not in METHODS else name
    name = f"OpenMM {name}" if f"OpenMM {name}" in METHODS else name
    if name.endswith(" HMC"):
        return of_method(name.removesuffix(" HMC")) | {"marker": "*", "markersize": 9, "ls": ":"}
    colour, marker = METHODS.get(name.removesuffix(" Langevin"), UNKNOWN)
    style: dict[str, Any] = {"color": colour, "marker": marker, "ls": "-"}
    return style if name.startswith(OWN) else style | {"ls": "--", "mfc": "white"}


def context() -> AbstractContextManager:
    """Return the style of all figures, for a with-statement."""
    import matplotlib as mpl

    return mpl.rc_context(RC)


@contextmanager
def one_message(path: Path, title: str, height: float = 4.9) -> Iterator[Axes]:
    """Make a figure of one panel with type that can be read at half its size, and a title with the finding.

    Args:
        path: PNG file to write.
        title: the finding; a line break divides it.
        height: inches, of a width of 9.
    """
    from matplotlib.figure import Figure

    with context():
        picture = Figure(figsize=(9, height), layout="constrained")
        picture.suptitle(title, x=0.01, ha="left", fontsize=16, fontweight="bold")
        axes = picture.subplots()
        axes.tick_params(labelsize=13)
        axes.xaxis.label.set_fontsize(14)
        axes.yaxis.label.set_fontsize(14)
        yield axes
        picture.savefig(path)


@contextmanager
def figure(path: Path, columns: int, title: str = "", **options: Any) -> Iterator[tuple[Figure, list[Axes]]]:
    """Make a figure of panels side by side, which is written to a file after they were drawn.

    Args:
        path: PNG file to write.
        columns: number of panels.
        title: above all of them.
        options: of `Figure.subplots`.
    """
    from matplotlib.figure import Figure

    with context():
        picture = Figure(figsize=(1 + 5.6 * columns, 4.8), layout="constrained")
        if title:
            picture.suptitle(title, x=0.01, ha="left", fontsize=14, fontweight="bold")
        yield picture, list(picture.subplots(1, columns, squeeze=False, **options).flat)
        picture.savefig(path)


def curves(axes: Axes, frame: pd.DataFrame, x: str, y: str, apart: float = 0.0, **look: Any) -> None:
    """Draw one line for each method, with standard errors where they are known.

    Args:
        axes: to draw on.
        frame: with a column `method`; rows without a value of `y` are left out.
        x, y: columns.
        apart: by which the points of each method are shifted along x from those of the one before.
        look: keyword arguments of `Axes.errorbar` in place of those of the method.
    """
    groups = frame.groupby("method", sort=False)
    for i, (method, selected) in enumerate(groups):
        selected = selected.dropna(subset=[y]).sort_values(x)
        if selected.empty:
            continue
        error = selected[f"{y}_error"].fillna(0) if f"{y}_error" in selected else None
        drawn = {"capsize": 3, "label": method} | of_method(method) | look
        shift = apart * (i - (len(groups) - 1) / 2)
        axes.errorbar(selected[x] + shift, selected[y], error, **drawn)


def shared_legend(picture: Figure, axes: Axes) -> None:
    """Draw one legend for all panels, next to them, with the labels of one."""
    picture.legend(*axes.get_legend_handles_labels(), loc="outside right upper")


def plain_ticks(axis: Any, values: Sequence[float]) -> None:
    """Put ticks of a logarithmic axis at given values, written out."""
    axis.set_ticks(list(values), labels=[f"{value:g}" for value in values])
    axis.set_ticks([], minor=True)
