"""The style of all figures, with one colour and marker for each method. Figures need matplotlib, an extra."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from openmm_sier.measure.report import Report

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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

GREY = "0.35"

#: Colour and marker of every method. Methods of this package have saturated colours; one with a heat bath looks as
#: without it.
METHODS = {
    "SIER2": ("#0072b2", "o"),
    "SIER4": ("#d55e00", "D"),
    "SIER4V": ("#7b3294", "v"),
    "SIER4G": ("#d6338a", "^"),
    "SIER4P": ("#007f5f", "P"),
    "MRDL": ("#e69f00", "s"),
    "SEJ4": ("#56b4e9", "<"),
    "OpenMM Verlet": ("#4d4d4d", "s"),
    "Verlet, RATTLE": ("#7f7f7f", "s"),
    "OpenMM LangevinMiddle": ("#4d4d4d", "X"),
    "LAMMPS rigid/nve/small": ("#8c6d31", "d"),
    "GROMACS md-vv, mixed": ("#9c9ede", ">"),
    "GROMACS md-vv, double": ("#5254a3", "p"),
    "Blanes-Moan S6": ("#bcbd22", "h"),
    "Blanes-Moan SRKN6b": ("#8ca252", "8"),
    "PEFRL": ("#c49c94", "*"),
    "OMF, 3 forces and 2 gradients": ("#17becf", "H"),
}

UNKNOWN = ("#000000", "x")

#: Methods of this package, drawn with full lines and markers; others have broken lines and open markers.
OWN = ("SIER", "MRDL", "SEJ4")


def of_method(name: str) -> dict[str, Any]:
    """Keyword arguments of `Axes.plot` for a method; one that is not in the table is black."""
    colour, marker = METHODS.get(name.removesuffix(" Langevin"), UNKNOWN)
    style: dict[str, Any] = {"color": colour, "marker": marker, "ls": "-"}
    return style if name.startswith(OWN) else style | {"ls": "--", "mfc": "white"}


def require() -> None:
    """Say early that figures cannot be drawn.

    Raises:
        ModuleNotFoundError: matplotlib is missing.
    """
    if find_spec("matplotlib") is None:
        raise ModuleNotFoundError("figures need matplotlib; install it with: pip install 'openmm-sier[plots]'")


def can_draw(report: Report) -> bool:
    """Whether matplotlib is installed; where it is not, a note says how to get it."""
    try:
        require()
    except ModuleNotFoundError as error:
        report.note(f"no figure: {error}")
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


def plain_ticks(axis: Any, values: Sequence[float]) -> None:
    """Ticks of a logarithmic axis at given values, written out."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter

    axis.set_major_locator(FixedLocator(list(values)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())
