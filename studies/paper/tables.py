"""Tables with the paper's values beside ours. Every function gives (title, columns, rows) of text."""

from __future__ import annotations

import math
from typing import Any

from openmm_sier.measure.report import Table
from studies.paper import published
from studies.paper.dipole import Dipole
from studies.paper.free_rotation import FreeRotation
from studies.paper.water import Water

PS_UNITS = ((1e12, "s"), (1e9, "ms"), (1e6, "µs"), (1e3, "ns"), (1.0, "ps"))


def picoseconds(value: float, like: float | None = None) -> str:
    """A time, given in ps, in a unit that suits it, or that suits the time `like` that it is compared with."""
    if not math.isfinite(value):
        return "-"
    scale, unit = unit_of(value if like is None else like)
    return f"{value / scale:.3g} {unit}"


def unit_of(value: float) -> tuple[float, str]:
    """A unit that suits a time in ps: its size in ps and its name."""
    return next(((scale, unit) for scale, unit in PS_UNITS if value >= scale), PS_UNITS[-1])


def number(value: float, error: float | None = None) -> str:
    """A value with its error: two digits of the error."""
    if not math.isfinite(value):
        return "-"
    if error is None or not math.isfinite(error) or error <= 0:
        return f"{value:.3g}"
    if not 1e-3 <= abs(value) < 1e4:
        exponent = math.floor(math.log10(abs(value)))
        return f"({number(value / 10**exponent, error / 10**exponent)})e{exponent}"
    places = max(0, 1 - math.floor(math.log10(error)))
    return f"{value:.{places}f} ± {error:.{places}f}"


def ratio(ours: float, paper: float | None) -> str:
    """Ours over the paper's."""
    if paper is None or not math.isfinite(ours):
        return "-"
    value = ours / paper
    return f"{value:.2f}" if value >= 0.1 else f"{value:.0e}"


def tau_table(result: FreeRotation) -> Table:
    """tau, the time at which the attitude is off by 10 %."""
    rows = []
    for curve in result.curves:
        paper = published.TAU.get((curve.method, curve.step_fs))
        scale, unit = unit_of(curve.tau)
        rows.append(
            (
                f"{curve.step_fs:g}",
                curve.method,
                "as SIER2" if paper is None else picoseconds(paper, like=curve.tau),
                f"{number(curve.tau / scale, curve.tau_error / scale)} {unit}",
                ratio(curve.tau, paper),
                picoseconds(curve.tau_median),
                f"{curve.exponent:.2f}",
                picoseconds(curve.tau_power),
                f"{100 * curve.energy:.1e}",
            )
        )
    span = result.settings.span
    return Table(
        f"Free rotation of water, {result.settings.temperature:g} K: tau from delta = t/(10 tau), runs of {span:g} ps",
        ("h (fs)", "method", "paper", "tau", "ratio", "median body", "growth t^", "10 % by that power", "dE/E (%)"),
        rows,
        left=2,
    )


def cost_table(result: FreeRotation) -> Table:
    """Time of a step of each free-rotation map."""
    rows = []
    for cost in result.costs:
        low, high = published.COST[cost.method]
        rows.append(
            (
                f"{cost.step_fs:g}",
                cost.method,
                f"{cost.nanoseconds:.0f}",
                f"{low:g}" if low == high else f"{low:g} - {high:g}",
                f"{cost.ratio:.2f}",
                f"{cost.ratio_low:.2f} - {cost.ratio_high:.2f}",
            )
        )
    return Table(
        "Cost of the free-rotation maps, NumPy",
        ("h (fs)", "method", "ns a body", "paper, over MRDL", "over MRDL", "quartiles"),
        rows,
        left=2,
    )


def dipole_energy_table(result: Dipole) -> Table:
    """Table 1, energy."""
    rows = []
    for entry in result.entries:
        paper = published.ENERGY.get((entry.method, entry.force_step_fs))
        rows.append(
            (
                f"{entry.force_step_fs:g}",
                entry.method,
                "-" if paper is None else number(*paper),
                number(100 * entry.energy, 100 * entry.energy_error),
                ratio(100 * entry.energy, None if paper is None else paper[0]),
                f"{100 * entry.energy_of_means:.3g}",
                f"{100 * entry.energy_median:.3g}",
            )
        )
    s = result.settings
    return Table(
        f"Table 1, energy: rms(H)/rms(V) in %, {s.dipole:g} D in {s.field:g} MV/m, {s.bodies} runs of {s.span:g} ps",
        ("h/f (fs)", "method", "paper", "mean of ratios", "ratio", "ratio of means", "median"),
        rows,
        left=2,
    )


def dipole_momentum_table(result: Dipole) -> Table:
    """Table 1, angular momentum along the field."""
    rows = []
    for entry in result.entries:
        paper = published.MOMENTUM.get((entry.method, entry.force_step_fs))
        rows.append(
            (
                f"{entry.force_step_fs:g}",
                entry.method,
                "-" if paper is None else f"{paper[0]:.2g}",
                f"{entry.momentum:.2g}",
                ratio(entry.momentum, None if paper is None else paper[0]),
                f"{entry.momentum_of_means:.2g}",
                f"{entry.momentum_median:.2g}",
            )
        )
    return Table(
        "Table 1, angular momentum along the field: rms(L_z)/<|L_z|>",
        ("h/f (fs)", "method", "paper", "root mean square", "ratio", "mean rms", "median ratio"),
        rows,
        left=2,
    )


def water_table(result: Water, kind: str) -> Table:
    """rms(H)/rms(V) of liquid water, methods side by side."""
    points = {(p.method, p.force_step_fs): p for p in result.points if p.kind == kind}
    methods = list(dict.fromkeys(p.method for p in result.points))
    rows = []
    for step in sorted({p.force_step_fs for p in result.points if p.kind == kind}):
        cells = [points.get((method, step)) for method in methods]
        rows.append((f"{step:g}", *(_percent(p) for p in cells)))
    s = result.settings
    fewer = "" if s.molecules == published.WATER_MOLECULES else f" (the paper: {published.WATER_MOLECULES})"
    return Table(
        f"Liquid water, {kind}, {s.molecules} molecules{fewer}: rms(H)/rms(V) in %, {s.runs} runs of {s.span:g} ps",
        ("h/f (fs)", *methods),
        rows,
    )


def _percent(point: Any) -> str:
    if point is None:
        return ""
    return "breaks" if point.runs == 0 else number(100 * point.energy, 100 * point.energy_error)


def crossing_table(result: Water) -> Table:
    """Where SIER4 stops being better, and the orders."""
    rows = [
        (
            crossing.kind,
            f"{published.CROSSING:g}",
            number(crossing.force_step_fs, crossing.error),
            ratio(crossing.force_step_fs, published.CROSSING),
            *(f"{crossing.slopes[name]:.2f}" if name in crossing.slopes else "-" for name in ("SIER2", "SIER4")),
        )
        for crossing in result.crossings
    ]
    return Table(
        "h/f in fs below which SIER4 conserves energy better than SIER2, and slopes of the curves",
        ("system", "paper", "ours", "ratio", "slope SIER2", "slope SIER4"),
        rows,
    )
