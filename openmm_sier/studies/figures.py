"""Figures of the comparisons of integrators. Needs matplotlib, an extra."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from openmm_sier.studies import scheme_comparison

COLOURS = dict(zip(range(8), mpl.color_sequences["petroff8"], strict=True))
STYLE: dict = {
    "font.size": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.3,
}


def equipartition_figure(rows, ensemble: str, path: Path) -> None:
    """T_rot - T_trans against the step per force evaluation, one line a method, and what is predicted for SIER2.

    Args:
        rows: of `openmm_sier.studies.equipartition.compare`.
        ensemble: for the title.
        path: PNG file to write.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7, 4.5), layout="constrained")
        axes = figure.add_subplot()
        for i, method in enumerate(dict.fromkeys(row.method for row in rows)):
            mine = [row for row in rows if row.method == method and not row.broken]
            if not mine:
                continue
            h = np.array([row.fs_per_force for row in mine])
            value, error = np.array([row.difference for row in mine]).T
            offset = 0.02 * i
            axes.errorbar(h + offset, value, error, fmt="o-", capsize=3, color=COLOURS[i % 8], label=method)
        if known := [row for row in rows if row.predicted < 0]:
            h = np.linspace(0, max(row.fs_per_force for row in known), 100)
            law = np.mean([row.predicted / row.fs_per_force**2 for row in known]) * h**2
            axes.plot(h, law, color="0.3", lw=1, ls="--", label="SIER2, predicted", zorder=0)
        axes.axhline(0, color="0.3", lw=1)
        axes.set_xlabel("simulated time per force evaluation (fs)")
        axes.set_ylabel(r"$T_\mathrm{rot} - T_\mathrm{trans}$ (K)")
        axes.set_title(f"Equipartition in liquid water, {ensemble.upper()}", loc="left")
        axes.legend(frameon=False)
        figure.savefig(path, dpi=160)


def schemes_figure(rows, path: Path) -> None:
    """Energy error and drift against force evaluations per picosecond, one line a scheme.

    Lines are broken for schemes that are not in the catalogue.

    Args:
        rows: of `openmm_sier.studies.scheme_comparison.compare`.
        path: PNG file to write.
    """
    others = [scheme.name for scheme in scheme_comparison.OTHERS.values()]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(11, 4.8), layout="constrained")
        error, drift = figure.subplots(1, 2)
        for i, scheme in enumerate(dict.fromkeys(row.scheme for row in rows)):
            mine = sorted((r for r in rows if r.scheme == scheme and not r.broken), key=lambda r: r.fs_per_force)
            if not mine:
                continue
            style: dict = {"color": COLOURS[i % 8], "marker": "os^D"[i // 8 % 4], "ms": 5, "ls": "-"}
            if scheme in others:
                style |= {"ls": "--", "lw": 1.2, "mfc": "white"}
            forces = np.array([row.forces_per_ps for row in mine])
            error.plot(forces, [100 * row.error for row in mine], label=scheme, **style)
            slope, uncertainty = np.abs(np.array([row.drift for row in mine])).T
            drift.errorbar(forces, slope, uncertainty, capsize=3, **style)
        error.set_yscale("log")
        error.set_ylabel("rms(H)/rms(V) (%)")
        error.set_title("Energy error", loc="left")
        # Linear where a drift is below what a run of some ps resolves.
        drift.set_yscale("symlog", linthresh=0.1)
        drift.set_ylim(bottom=0)
        drift.set_ylabel("size of the drift of the box (kJ/mol/ps)")
        drift.set_title("Drift", loc="left")
        for axes in (error, drift):
            axes.yaxis.set_major_formatter("{x:g}")
            axes.set_xlabel("force evaluations per picosecond")
        figure.legend(*error.get_legend_handles_labels(), loc="outside right upper", frameon=False)
        figure.savefig(path, dpi=160)


def cost_figure(points, path: Path) -> None:
    """Energy error against force evaluations per picosecond, and speed against energy error, one line a method.

    Lines are broken for methods that are not of this package.

    Args:
        points: of `openmm_sier.studies.bench.accuracy.measure`.
        path: PNG file to write.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(12.5, 4.8), layout="constrained")
        cost, speed = figure.subplots(1, 2)
        for i, method in enumerate(dict.fromkeys(point.method for point in points)):
            mine = sorted((p for p in points if p.method == method), key=lambda p: p.fs_per_force)
            style: dict = {"color": COLOURS[i % 8], "marker": "os^Dv<>P"[i % 8], "ms": 5}
            if not method.startswith("SIER"):
                style |= {"ls": "--", "mfc": "white"}
            error = 100 * np.array([p.error for p in mine])
            cost.plot([1000 / p.fs_per_force for p in mine], error, label=method, **style)
            speed.plot(error, [p.fs_per_second for p in mine], **style)
        cost.set_xlabel("force evaluations per picosecond")
        cost.set_ylabel("rms(H)/rms(V) (%)")
        cost.set_title("Accuracy for a number of forces", loc="left")
        speed.set_xlabel("rms(H)/rms(V) (%)")
        speed.set_ylabel("simulated fs per second of wall time")
        speed.set_title("Speed for an accuracy", loc="left")
        for axes in (cost, speed):
            axes.set_xscale("log")
            axes.set_yscale("log")
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
                axis.set_major_formatter("{x:g}")
                axis.set_minor_formatter("")
        figure.legend(*cost.get_legend_handles_labels(), loc="outside right upper", frameon=False)
        figure.savefig(path, dpi=160)
