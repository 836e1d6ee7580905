"""Liquid water: energy error against simulated time per force evaluation (van Zon and Schofield 2007, Fig. 1).

Every method runs from the same phase points, which are taken from a thermostatted run of the same system. Along each
run of 1 ps rms(H) and rms(V) are taken about the run's own means, and the figure shows the mean of the former over the
mean of the latter.
"""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pandas as pd

from openmm_sier.analysis.statistics import jackknife
from studies import style, text
from studies.methods import PAPER
from studies.paper import liquids, published
from studies.paper.water_runs import PhasePoint, WaterSettings
from studies.records import Record

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.container import ErrorbarContainer

#: Ranges of h/f in fs in which the order is read off. Above, higher orders contribute; below, rounding limits SIER4.
#: With PME, whose single-precision forces leave an error of 0.005 %, no range is left for SIER4.
SLOPE_RANGES = {
    liquids.MOLECULAR: {"SIER2": (0.3, 2.5), "SIER4": (0.3, 1.2)},
    liquids.PME: {"SIER2": (0.3, 2.5)},
}


CROSSINGS = {
    "system": "{kind}",
    "paper": f"{published.CROSSING:g}",
    "ours": "{force_step_fs_text}",
    "ratio": "{ratio}",
    "slope SIER2": "{slope_SIER2:.2f}",
    "slope SIER4": "{slope_SIER4:.2f}",
}


def evaluate(settings: WaterSettings, edge: float, results: list[dict[str, Any]]) -> Record:
    """What follows from the runs.

    Args:
        settings: of the experiment.
        edge: of the box, nm.
        results: runs from all phase points, see `water_runs.run`.

    Returns:
        `points`: for each kind, method and `force_step_fs` the mean rms(H) over the mean rms(V) in per cent with its
        standard error over the runs, means of rms(H), rms(V) and the drift, and the number of runs that finished.
        `crossings`: for each kind the h/f in fs above which SIER4 is no longer better than SIER2, and the slopes of the
        curves in `SLOPE_RANGES`, the orders of their methods.
    """
    runs = pd.DataFrame(results).astype({"rms_H": float, "rms_V": float, "drift": float})
    points = [
        _point(runs, kind, method.name, step)
        for kind in settings.kinds
        for method in PAPER
        for step in settings.steps_of(method, PhasePoint(kind, 1))
    ]
    crossings = [_crossing(runs[runs["kind"] == kind], kind) for kind in settings.kinds]
    tables = {"points": pd.DataFrame(points), "crossings": pd.DataFrame(crossings), "runs": runs}
    return Record(asdict(settings), tables, {"edge": edge})


def _percent(runs: pd.DataFrame) -> float:
    return float(100 * runs["rms_H"].mean() / runs["rms_V"].mean())


def _point(runs: pd.DataFrame, kind: str, method: str, step: float) -> dict[str, Any]:
    chosen = (runs["kind"] == kind) & (runs["method"] == method) & (runs["force_step_fs"] == step)
    complete = runs[chosen].dropna(subset=["rms_H"])
    value, error = math.nan, math.nan
    if len(complete):
        value, error, _ = jackknife(lambda sample: _percent(complete.iloc[sample]), len(complete))
    point = {"kind": kind, "method": method, "force_step_fs": step, "percent": value, "percent_error": error}
    return point | complete[["rms_H", "rms_V", "drift"]].mean().to_dict() | {"runs": len(complete)}


def _crossing(runs: pd.DataFrame, kind: str) -> dict[str, Any]:
    numbers = np.sort(runs["number"].unique())

    def crossing_of(chosen: np.ndarray) -> float:
        return intersection(*(_curve(runs, name, numbers[chosen]) for name in ("SIER2", "SIER4")))

    value, error, _ = jackknife(crossing_of, len(numbers))
    slopes = {
        f"slope_{name}": _slope(_curve(runs, name, numbers), SLOPE_RANGES[kind].get(name, (math.inf, math.inf)))
        for name in ("SIER2", "SIER4")
    }
    return {"kind": kind, "force_step_fs": value, "force_step_fs_error": error} | slopes


def _curve(runs: pd.DataFrame, method: str, chosen: np.ndarray) -> dict[float, float]:
    """h/f to rms(H)/rms(V), from the phase points `chosen`; from all where none of these have runs."""
    curve = {}
    for step, of_step in runs[runs["method"] == method].dropna(subset=["rms_H"]).groupby("force_step_fs"):
        usable = of_step[of_step["number"].isin(chosen)]
        curve[step] = _percent(of_step if usable.empty else usable)
    return curve


def intersection(second: dict[float, float], fourth: dict[float, float]) -> float:
    """Where two curves cross for the last time, by interpolation in logarithms; NaN if they do not."""
    steps = sorted(set(second) & set(fourth))
    difference = np.array([np.log(fourth[s] / second[s]) for s in steps])
    changes = np.flatnonzero((difference[:-1] < 0) & (difference[1:] >= 0))
    if not changes.size:
        return math.nan
    i = int(changes[-1])
    fraction = -difference[i] / (difference[i + 1] - difference[i])
    return float(np.exp(np.log(steps[i]) + fraction * np.log(steps[i + 1] / steps[i])))


def _slope(curve: dict[float, float], limits: tuple[float, float]) -> float:
    steps = np.array(sorted(s for s in curve if limits[0] <= s <= limits[1]))
    if steps.size < 2:
        return math.nan
    return float(np.polyfit(np.log(steps), np.log([curve[s] for s in steps]), 1)[0])


# --- as text and figure ---


def tables(record: Record) -> dict[str, pd.DataFrame]:
    """Return rms(H)/rms(V), methods side by side, and where SIER4 stops being better, as text by their titles."""
    settings, points = record.settings, record.tables["points"]
    caption = f"{_molecules(settings)}: rms(H)/rms(V) in %, {settings['runs']} runs of {settings['span']:g} ps"
    results = {}
    columns = {"h/f (fs)": "{force_step_fs:g}", "{method}": "{shown}"}
    for kind in settings["kinds"]:
        of_kind = points[points["kind"] == kind].sort_values("force_step_fs", kind="stable")
        shown = [text.cell("{percent_text}", row) if row["runs"] else "breaks" for row in of_kind.to_dict("records")]
        results[f"Liquid water, {kind}, {caption}"] = text.table(of_kind.assign(shown=shown), columns)
    ratios = [published.ratio(value, published.CROSSING) for value in record.tables["crossings"]["force_step_fs"]]
    crossings = record.tables["crossings"].assign(ratio=ratios)
    title = "h/f in fs below which SIER4 conserves energy better than SIER2, and slopes of the curves"
    return results | {title: text.table(crossings, CROSSINGS)}


def _molecules(settings: Any) -> str:
    fewer = "" if settings["molecules"] == published.WATER_MOLECULES else f" (the paper: {published.WATER_MOLECULES})"
    return f"{settings['molecules']} molecules{fewer}"


def figure(record: Record, path: Path) -> None:
    """Fig. 1, one panel a system, with the crossing marked."""
    settings, points = record.settings, record.tables["points"]
    title = f"Liquid water, {_molecules(settings)}, {settings['temperature']:g} K: energy error for the same work"
    with style.figure(path, len(settings["kinds"]), title, sharey=True) as (_, panels):
        for axes, crossing in zip(panels, record.tables["crossings"].to_dict("records"), strict=True):
            kind = crossing["kind"]
            of_kind = points[(points["kind"] == kind) & (points["runs"] > 0)]
            for method in PAPER:
                _draw(
                    axes, of_kind[of_kind["method"] == method.name], method.name, crossing.get(f"slope_{method.name}")
                )
            _mark_crossing(axes, crossing["force_step_fs"])
            axes.set(xscale="log", yscale="log", xlabel="time step per force evaluation, h/f (fs)")
            axes.set_title(kind + (", forces in single precision" if kind == liquids.PME else ""))
            steps = sorted(of_kind["force_step_fs"].unique())
            round_steps = [t for t in (0.1, 0.2, 0.5, 1, 2, 3, 5, 7) if steps[0] <= t <= steps[-1]]
            style.plain_ticks(axes.xaxis, steps if len(steps) < 6 else round_steps)
            handles, labels = axes.get_legend_handles_labels()
            symbols = [bar[0] for bar in cast("list[ErrorbarContainer]", handles)]
            axes.legend(symbols, labels, loc="upper left", fontsize=10)
        panels[0].set_ylabel("rms(H) / rms(V)  (%)")


def _draw(axes: Axes, points: pd.DataFrame, method: str, slope: float | None) -> None:
    label = method if slope is None or not math.isfinite(slope) else f"{method}, slope {slope:.2f}"
    # Methods that the paper found to coincide with SIER2 are drawn around the points of SIER2.
    around = {"ls": "none", "mfc": "none", "ms": 11, "mew": 1.6, "zorder": 1}
    special = around if method in ("MRDL", "SEJ4") else {"zorder": 3}
    style.curves(axes, points, "force_step_fs", "percent", label=label, **special)


def _mark_crossing(axes: Axes, ours: float) -> None:
    axes.axvline(published.CROSSING, color=style.GREY, lw=1, ls=":")
    text = f"dotted: the paper's crossing, {published.CROSSING:g} fs"
    if math.isfinite(ours):
        axes.axvline(ours, color=style.GREY, lw=1)
        text = f"line: crossing at {ours:.2f} fs\n{text}"
    box = {"fc": "white", "ec": "none", "alpha": 0.95}
    axes.text(0.98, 0.03, text, transform=axes.transAxes, ha="right", color=style.GREY, fontsize=10, bbox=box)
