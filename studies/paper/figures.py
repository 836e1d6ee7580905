"""The figures of the experiments. Needs matplotlib, an extra."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from studies import style
from studies.paper import published
from studies.paper.dipole import Dipole
from studies.paper.free_rotation import MODERATE, Curve, FreeRotation
from studies.paper.liquids import PME
from studies.paper.methods import METHODS
from studies.paper.tables import picoseconds
from studies.paper.water import Crossing, Water

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.container import ErrorbarContainer

NAMES = [method.name for method in METHODS]


def free_rotation(result: FreeRotation, path: Path) -> None:
    """delta against t for each step, continued to the 10 % that define tau, with the paper's tau there."""
    steps = list(dict.fromkeys(curve.step_fs for curve in result.curves))
    with style.context():
        title = "Free rotation of a water molecule: error of the attitude"
        figure, panels = style.panels(len(steps), title, sharey=True)
        for axes, step in zip(panels, steps, strict=True):
            axes.axhline(MODERATE, color=style.GREY, lw=1, zorder=0)
            curves = [c for c in result.curves if c.step_fs == step]
            for i, curve in enumerate(curves):
                _error_curve(axes, curve)
                text = _tau_label(curve)
                place = (0.98, 0.045 + 0.06 * (len(curves) - 1 - i))
                colour = style.of_method(curve.method)["color"]
                axes.text(*place, text, transform=axes.transAxes, ha="right", color=colour, fontsize=10)
            axes.set(xscale="log", yscale="log", ylim=(3e-17, 3), xlim=(6e-3, 2e12), xlabel="time")
            _time_ticks(axes)
            axes.set_title(f"step {step:g} fs")
        panels[0].set_ylabel(r"$\delta$ = rms deviation from the exact attitude")
        notes = "solid: measured      dashed: on by $\\delta = t/10\\tau$      dotted: on by the power found"
        figure.supxlabel(notes + "      open, at 10 %: the paper's $\\tau$", color=style.GREY, fontsize=10)
        figure.savefig(path)


def _time_ticks(axes: Axes) -> None:
    """From fs to s."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullLocator

    axes.xaxis.set_major_locator(FixedLocator([1e-2, 1, 1e3, 1e6, 1e9, 1e12]))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: picoseconds(value) if value >= 1 else "10 fs"))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_locator(LogLocator(numticks=9))


def _error_curve(axes: Axes, curve: Curve) -> None:
    look = style.of_method(curve.method)
    colour, marker = look["color"], look["marker"]
    times, delta = np.array(curve.times), np.array(curve.delta)
    axes.errorbar(times, delta, curve.delta_error, capsize=2, **look)
    last = np.flatnonzero(delta <= MODERATE)[-1:]
    for end, line in ((curve.tau, "--"), (curve.tau_power, ":")):
        axes.plot([*times[last], end], [*delta[last], MODERATE], line, color=colour, lw=1.4, zorder=1)
    tau = published.TAU.get((curve.method, curve.step_fs))
    if tau is not None:
        axes.plot(tau, MODERATE, marker, mfc="white", mew=1.8, color=colour, ms=9, zorder=4, clip_on=False)


def _tau_label(curve: Curve) -> str:
    tau = published.TAU.get((curve.method, curve.step_fs))
    paper = "" if tau is None else f" (paper: {picoseconds(tau, like=curve.tau)})"
    return rf"{curve.method}: $\tau$ = {picoseconds(curve.tau)}{paper}"


def dipole(result: Dipole, path: Path) -> None:
    """Table 1 as two panels, the paper's values as open symbols."""
    panels_of = (
        ("energy", 100, published.ENERGY, "rms(H) / rms(V)  (%)", "energy"),
        ("momentum", 1, published.MOMENTUM, r"rms($L_z$) / $\langle|L_z|\rangle$", "angular momentum"),
    )
    steps = sorted({entry.force_step_fs for entry in result.entries})
    with style.context():
        figure, panels = style.panels(2, "Water molecule in an electric field: what is conserved")
        for axes, (field, scale, paper, label, title) in zip(panels, panels_of, strict=True):
            for i, name in enumerate(NAMES):
                shift = 1.025 ** (i - 1.5)
                mine = [entry for entry in result.entries if entry.method == name]
                x = np.array([entry.force_step_fs for entry in mine])
                y, error = np.array([(getattr(e, field), getattr(e, field + "_error")) for e in mine]).T * scale
                look = style.of_method(name)
                axes.errorbar(x * shift, y, error, capsize=2, label=name, **look)
                theirs = [(s, *paper[name, s]) for s in steps if (name, s) in paper]
                if theirs:
                    px, py, pe = np.array(theirs).T
                    pe = np.minimum(pe, 0.9 * py)
                    theirs_look = look | {"ls": "none", "mfc": "white", "mew": 1.8}
                    axes.errorbar(px * shift, py, pe, capsize=2, zorder=3, **theirs_look)
            axes.set(xscale="log", yscale="log", xlabel="time step per force evaluation, h/f (fs)", ylabel=label)
            axes.set_title(title)
            style.plain_ticks(axes.xaxis, steps)
        axes = panels[0]
        axes.errorbar([], [], [], fmt="o", mfc="white", mew=1.8, color=style.GREY, label="open: the paper")
        axes.legend(loc="lower right", fontsize=10)
        panels[1].text(0.5, 0.12, "rounding", transform=panels[1].transAxes, ha="center", color=style.GREY)
        figure.savefig(path)


def water(result: Water, path: Path) -> None:
    """Fig. 1, one panel a system, with the crossing marked."""
    kinds = list(dict.fromkeys(point.kind for point in result.points))
    s = result.settings
    with style.context():
        fewer = "" if s.molecules == published.WATER_MOLECULES else f" (the paper: {published.WATER_MOLECULES})"
        title = f"Liquid water, {s.molecules} molecules{fewer}, {s.temperature:g} K: energy error for the same work"
        figure, panels = style.panels(len(kinds), title, sharey=True)
        for axes, kind in zip(panels, kinds, strict=True):
            crossing = next(c for c in result.crossings if c.kind == kind)
            for name in NAMES:
                mine = [p for p in result.points if p.kind == kind and p.method == name and p.runs > 0]
                _water_curve(axes, mine, name, crossing.slopes.get(name))
            _mark_crossing(axes, crossing)
            axes.set(xscale="log", yscale="log", xlabel="time step per force evaluation, h/f (fs)")
            axes.set_title(kind + (", forces in single precision" if kind == PME else ""))
            steps = sorted({point.force_step_fs for point in result.points if point.kind == kind})
            round_steps = [t for t in (0.1, 0.2, 0.5, 1, 2, 3, 5, 7) if steps[0] <= t <= steps[-1]]
            style.plain_ticks(axes.xaxis, steps if len(steps) < 6 else round_steps)
            handles, labels = axes.get_legend_handles_labels()
            axes.legend(
                [bar[0] for bar in cast("list[ErrorbarContainer]", handles)], labels, loc="upper left", fontsize=10
            )
        panels[0].set_ylabel("rms(H) / rms(V)  (%)")
        figure.savefig(path)


def _water_curve(axes: Axes, points: Sequence[Any], name: str, slope: float | None) -> None:
    if not points:
        return
    x, y, error = np.array([(p.force_step_fs, 100 * p.energy, 100 * p.energy_error) for p in points]).T
    label = name if slope is None or not np.isfinite(slope) else f"{name}, slope {slope:.2f}"
    # Methods that the paper found to coincide with SIER2 are drawn around the points of SIER2.
    around = {"ls": "none", "mfc": "none", "ms": 11, "mew": 1.6, "zorder": 1}
    special = around if name in ("MRDL", "SEJ4") else {"zorder": 3}
    axes.errorbar(x, y, error, capsize=2, label=label, **(style.of_method(name) | special))


def _mark_crossing(axes: Axes, crossing: Crossing) -> None:
    axes.axvline(published.CROSSING, color=style.GREY, lw=1, ls=":")
    text = f"dotted: the paper's crossing, {published.CROSSING:g} fs"
    if np.isfinite(crossing.force_step_fs):
        axes.axvline(crossing.force_step_fs, color=style.GREY, lw=1)
        text = f"line: crossing at {crossing.force_step_fs:.2f} fs\n{text}"
    axes.text(0.98, 0.03, text, transform=axes.transAxes, ha="right", color=style.GREY, fontsize=10,
              bbox={"fc": "white", "ec": "none", "alpha": 0.95})  # fmt: skip
