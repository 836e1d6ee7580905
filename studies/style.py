"""The style of all figures, with one colour and marker for each method. Figures need matplotlib, an extra."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from openmm_sier.measure.figures import can_draw, context, panels, require

__all__ = ["can_draw", "context", "of_method", "panels", "plain_ticks", "require"]

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


def plain_ticks(axis: Any, values: Sequence[float]) -> None:
    """Ticks of a logarithmic axis at given values, written out."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter

    axis.set_major_locator(FixedLocator(list(values)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())
