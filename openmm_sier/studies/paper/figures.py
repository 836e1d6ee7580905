"""The figures of the experiments. Needs matplotlib, an extra."""

from __future__ import annotations

from pathlib import Path

import numpy as np

try:
    import matplotlib as mpl
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, NullFormatter
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("figures need matplotlib; install it with: pip install 'openmm-sier[plots]'") from error

from openmm_sier.studies.paper import published
from openmm_sier.studies.paper.dipole import Dipole
from openmm_sier.studies.paper.free_rotation import MODERATE, FreeRotation
from openmm_sier.studies.paper.liquids import PME
from openmm_sier.studies.paper.methods import METHODS
from openmm_sier.studies.paper.tables import picoseconds
from openmm_sier.studies.paper.water import Crossing, Water

#: Colours that can be told apart by everyone (Okabe and Ito), one for each method, and its marker.
COLOURS = {"MRDL": "#E69F00", "SEJ4": "#009E73", "SIER2": "#0072B2", "SIER4": "#D55E00"}
MARKERS = {"MRDL": "s", "SEJ4": "^", "SIER2": "o", "SIER4": "D"}
NAMES = [method.name for method in METHODS]

STYLE: dict = {
    "font.size": 13,
    "axes.titlesize": 14,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "lines.linewidth": 2,
    "lines.markersize": 7,
    "legend.frameon": False,
    "savefig.dpi": 160,
}
GREY = "0.35"


def _panels(columns: int, title: str, **options):
    figure = Figure(figsize=(6.4 * columns, 5.6), layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=17, fontweight="bold")
    return figure, figure.subplots(1, columns, squeeze=False, **options)[0]


def _plain_ticks(axis, values) -> None:
    """Ticks of a logarithmic axis at given values, written out."""
    axis.set_major_locator(mpl.ticker.FixedLocator(list(values)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def free_rotation(result: FreeRotation, path: Path) -> None:
    """delta against t for each step, continued to the 10 % that define tau, with the paper's tau there."""
    steps = list(dict.fromkeys(curve.step_fs for curve in result.curves))
    with mpl.rc_context(STYLE):
        figure, panels = _panels(len(steps), "Free rotation of a water molecule: error of the attitude", sharey=True)
        for axes, step in zip(panels, steps, strict=True):
            axes.axhline(MODERATE, color=GREY, lw=1, zorder=0)
            curves = [c for c in result.curves if c.step_fs == step]
            for i, curve in enumerate(curves):
                _error_curve(axes, curve)
                text = _tau_label(curve)
                axes.text(0.98, 0.045 + 0.06 * (len(curves) - 1 - i), text, transform=axes.transAxes, ha="right",
                          color=COLOURS[curve.method], fontsize=12)  # fmt: skip
            axes.set(xscale="log", yscale="log", ylim=(3e-17, 3), xlim=(6e-3, 2e12), xlabel="time")
            axes.xaxis.set_major_locator(mpl.ticker.FixedLocator([1e-2, 1, 1e3, 1e6, 1e9, 1e12]))
            axes.xaxis.set_major_formatter(
                FuncFormatter(lambda value, _: picoseconds(value) if value >= 1 else "10 fs")
            )
            axes.xaxis.set_minor_locator(mpl.ticker.NullLocator())
            axes.yaxis.set_major_locator(mpl.ticker.LogLocator(numticks=9))
            axes.set_title(f"step {step:g} fs", loc="left")
        panels[0].set_ylabel(r"$\delta$ = rms deviation from the exact attitude")
        notes = "solid: measured      dashed: on by $\\delta = t/10\\tau$      dotted: on by the power found"
        figure.supxlabel(notes + "      open, at 10 %: the paper's $\\tau$", color=GREY, fontsize=12)
        figure.savefig(path)


def _error_curve(axes, curve) -> None:
    colour, marker = COLOURS[curve.method], MARKERS[curve.method]
    times, delta = np.array(curve.times), np.array(curve.delta)
    axes.errorbar(times, delta, curve.delta_error, fmt=marker + "-", color=colour, capsize=2, ms=5)
    last = np.flatnonzero(delta <= MODERATE)[-1:]
    for end, style in ((curve.tau, "--"), (curve.tau_power, ":")):
        axes.plot([*times[last], end], [*delta[last], MODERATE], style, color=colour, lw=1.4, zorder=1)
    tau = published.TAU.get((curve.method, curve.step_fs))
    if tau is not None:
        axes.plot(tau, MODERATE, marker, mfc="white", mew=1.8, color=colour, ms=9, zorder=4, clip_on=False)


def _tau_label(curve) -> str:
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
    with mpl.rc_context(STYLE):
        figure, panels = _panels(2, "Water molecule in an electric field: what is conserved")
        for axes, (field, scale, paper, label, title) in zip(panels, panels_of, strict=True):
            for i, name in enumerate(NAMES):
                shift = 1.025 ** (i - 1.5)
                mine = [entry for entry in result.entries if entry.method == name]
                x = np.array([entry.force_step_fs for entry in mine])
                y, error = np.array([(getattr(e, field), getattr(e, field + "_error")) for e in mine]).T * scale
                axes.errorbar(x * shift, y, error, fmt=MARKERS[name] + "-", color=COLOURS[name], capsize=2, label=name)
                theirs = [(s, *paper[name, s]) for s in steps if (name, s) in paper]
                if theirs:
                    px, py, pe = np.array(theirs).T
                    pe = np.minimum(pe, 0.9 * py)
                    axes.errorbar(px * shift, py, pe, fmt=MARKERS[name], mfc="white", mew=1.8, color=COLOURS[name],
                                  capsize=2, zorder=3)  # fmt: skip
            axes.set(xscale="log", yscale="log", xlabel="time step per force evaluation, h/f (fs)", ylabel=label)
            axes.set_title(title, loc="left")
            _plain_ticks(axes.xaxis, steps)
        axes = panels[0]
        axes.errorbar([], [], [], fmt="o", mfc="white", mew=1.8, color=GREY, label="open: the paper")
        axes.legend(loc="lower right", fontsize=12)
        panels[1].text(0.5, 0.12, "rounding", transform=panels[1].transAxes, ha="center", color=GREY)
        figure.savefig(path)


def water(result: Water, path: Path) -> None:
    """Fig. 1, one panel a system, with the crossing marked."""
    kinds = list(dict.fromkeys(point.kind for point in result.points))
    s = result.settings
    with mpl.rc_context(STYLE):
        fewer = "" if s.molecules == published.WATER_MOLECULES else f" (the paper: {published.WATER_MOLECULES})"
        title = f"Liquid water, {s.molecules} molecules{fewer}, {s.temperature:g} K: energy error for the same work"
        figure, panels = _panels(len(kinds), title, sharey=True)
        for axes, kind in zip(panels, kinds, strict=True):
            crossing = next(c for c in result.crossings if c.kind == kind)
            for name in NAMES:
                mine = [p for p in result.points if p.kind == kind and p.method == name and p.runs > 0]
                _water_curve(axes, mine, name, crossing.slopes.get(name))
            _mark_crossing(axes, crossing)
            axes.set(xscale="log", yscale="log", xlabel="time step per force evaluation, h/f (fs)")
            axes.set_title(kind + (", forces in single precision" if kind == PME else ""), loc="left")
            steps = sorted({point.force_step_fs for point in result.points if point.kind == kind})
            round_steps = [t for t in (0.1, 0.2, 0.5, 1, 2, 3, 5, 7) if steps[0] <= t <= steps[-1]]
            _plain_ticks(axes.xaxis, steps if len(steps) < 6 else round_steps)
            handles, labels = axes.get_legend_handles_labels()
            axes.legend([handle[0] for handle in handles], labels, loc="upper left", fontsize=12)
        panels[0].set_ylabel("rms(H) / rms(V)  (%)")
        figure.savefig(path)


def _water_curve(axes, points, name: str, slope: float | None) -> None:
    if not points:
        return
    x, y, error = np.array([(p.force_step_fs, 100 * p.energy, 100 * p.energy_error) for p in points]).T
    label = name if slope is None or not np.isfinite(slope) else f"{name}, slope {slope:.2f}"
    # What the paper found to lie on SIER2 is drawn around its points.
    around = {"fmt": MARKERS[name], "mfc": "none", "ms": 13, "mew": 1.6, "zorder": 1}
    style = around if name in ("MRDL", "SEJ4") else {"fmt": MARKERS[name] + "-", "zorder": 3}
    axes.errorbar(x, y, error, color=COLOURS[name], capsize=2, label=label, **style)


def _mark_crossing(axes, crossing: Crossing) -> None:
    axes.axvline(published.CROSSING, color=GREY, lw=1, ls=":")
    text = f"dotted: the paper's crossing, {published.CROSSING:g} fs"
    if np.isfinite(crossing.force_step_fs):
        axes.axvline(crossing.force_step_fs, color=GREY, lw=1)
        text = f"line: crossing at {crossing.force_step_fs:.2f} fs\n{text}"
    axes.text(0.98, 0.03, text, transform=axes.transAxes, ha="right", color=GREY, fontsize=12,
              bbox={"fc": "white", "ec": "none", "alpha": 0.95})  # fmt: skip
