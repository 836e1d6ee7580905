"""Figures of the comparisons of integrators. Needs matplotlib, an extra."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from openmm_sier.dynamics.metropolis import expected_acceptance
from openmm_sier.measure.acceptance import Spread
from studies import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Number of molecules up to which lines of acceptance are drawn.
LARGEST_DRAWN = 262144


def equipartition_figure(rows: Sequence[Any], ensemble: str, path: Path) -> None:
    """T_rot - T_trans against the step per force evaluation, one line per method, and the prediction for SIER2.

    Args:
        rows: of `studies.equipartition.compare`.
        ensemble: for the title.
        path: PNG file to write.
    """
    with style.context():
        figure, (axes,) = style.panels(1)
        for i, method in enumerate(dict.fromkeys(row.method for row in rows)):
            mine = [row for row in rows if row.method == method and not row.broken]
            if not mine:
                continue
            h = np.array([row.fs_per_force for row in mine])
            value, error = np.array([row.difference for row in mine]).T
            axes.errorbar(h + 0.02 * i, value, error, capsize=3, label=method, **style.of_method(method))
        if known := [row for row in rows if row.predicted < 0]:
            h = np.linspace(0, max(row.fs_per_force for row in known), 100)
            law = np.mean([row.predicted / row.fs_per_force**2 for row in known]) * h**2
            axes.plot(h, law, color=style.GREY, lw=1, ls=":", label="SIER2, predicted", zorder=0)
        axes.axhline(0, color=style.GREY, lw=1)
        axes.set_xlabel("simulated time per force evaluation (fs)")
        axes.set_ylabel(r"$T_\mathrm{rot} - T_\mathrm{trans}$ (K)")
        axes.set_title(f"Equipartition in liquid water, {ensemble.upper()}")
        axes.legend()
        figure.savefig(path)


def schemes_figure(rows: Sequence[Any], path: Path) -> None:
    """Energy error and drift against force evaluations per picosecond, one line per scheme.

    Args:
        rows: of `studies.schemes.compare`.
        path: PNG file to write.
    """
    with style.context():
        figure, (error, drift) = style.panels(2)
        for scheme in dict.fromkeys(row.scheme for row in rows):
            mine = sorted((r for r in rows if r.scheme == scheme and not r.broken), key=lambda r: r.fs_per_force)
            if not mine:
                continue
            look = style.of_method(scheme)
            forces = np.array([row.forces_per_ps for row in mine])
            error.plot(forces, [100 * row.error for row in mine], label=scheme, **look)
            slope, uncertainty = np.abs(np.array([row.drift for row in mine])).T
            drift.errorbar(forces, slope, uncertainty, capsize=3, **look)
        error.set_yscale("log")
        error.set_ylabel("rms(H)/rms(V) (%)")
        error.set_title("Energy error")
        # Linear where a drift is below what a run of some ps resolves.
        drift.set_yscale("symlog", linthresh=0.1)
        drift.set_ylim(bottom=0)
        drift.set_ylabel("size of the energy drift of the box (kJ/mol/ps)")
        drift.set_title("Energy drift")
        for axes in (error, drift):
            axes.yaxis.set_major_formatter("{x:g}")
            axes.set_xlabel("force evaluations per picosecond")
        figure.legend(*error.get_legend_handles_labels(), loc="outside right upper")
        figure.savefig(path)


def cost_figure(points: Sequence[Any], path: Path) -> None:
    """Energy error against force evaluations per picosecond, and speed against energy error, one line per method.

    Args:
        points: of `studies.bench.accuracy.compare_accuracy`.
        path: PNG file to write.
    """
    with style.context():
        figure, (cost, speed) = style.panels(2)
        for method in dict.fromkeys(point.method for point in points):
            mine = sorted((p for p in points if p.method == method), key=lambda p: p.fs_per_force)
            look = style.of_method(method)
            error = 100 * np.array([p.error for p in mine])
            cost.plot([1000 / p.fs_per_force for p in mine], error, label=method, **look)
            speed.plot(error, [p.fs_per_second for p in mine], **look)
        cost.set_xlabel("force evaluations per picosecond")
        cost.set_ylabel("rms(H)/rms(V) (%)")
        cost.set_title("Accuracy for a number of forces")
        speed.set_xlabel("rms(H)/rms(V) (%)")
        speed.set_ylabel("simulated fs per second of wall time")
        speed.set_title("Speed for an accuracy")
        for axes in (cost, speed):
            _logarithmic(axes)
        figure.legend(*cost.get_legend_handles_labels(), loc="outside right upper")
        figure.savefig(path)


def acceptance_figure(rows: Sequence[Any], spreads: Sequence[tuple[str, float, Spread]], path: Path) -> None:
    """Acceptance and spread of the energy error against the number of molecules, one line per method and step.

    Args:
        rows: of `studies.acceptance.run`.
        spreads: method, time per force evaluation in fs, and spread of the energy error for one molecule, kT, from
            which lines are drawn.
        path: PNG file to write.
    """
    with style.context():
        figure, (accepted, spread) = style.panels(2)
        steps = sorted({row.fs_per_force for row in rows})
        for method, dt, of_one in spreads:
            mine = [r for r in rows if (r.method, r.fs_per_force) == (method, dt) and not r.broken]
            look = style.of_method(method) | {"ls": ("-", "--", ":", "-.")[steps.index(dt) % 4]}
            points = look | {"ls": "", "capsize": 3}
            label = method if len(steps) == 1 else f"{method}, {dt:g} fs per force"
            n = np.array([row.molecules for row in mine])
            accepted.errorbar(n, *np.array([row.acceptance for row in mine]).T, **points)
            spread.errorbar(n, *np.array([row.spread for row in mine]).T, **points)
            along = np.geomspace(n.min(), max(LARGEST_DRAWN, n.max()), 200)
            spread.plot(along, of_one.value * np.sqrt(along), **look | {"marker": ""})
            accepted.plot(along, [expected_acceptance(of_one.value * x**0.5) for x in along], **look | {"marker": ""})
            accepted.plot([], [], label=label, **look)
        accepted.axhline(0.5, color=style.GREY, lw=1, zorder=0)
        accepted.set_xscale("log")
        accepted.set_ylim(0, 1.03)
        accepted.set_ylabel("acceptance")
        accepted.set_title("Acceptance, and erfc(sd/√8)")
        _logarithmic(spread)
        spread.set_ylabel("standard deviation of the energy error (kT)")
        spread.set_title("Energy error, and sd ~ √N")
        for axes in (accepted, spread):
            axes.set_xlabel("molecules of water")
            style.plain_ticks(axes.xaxis, [8**n for n in range(2, 8)])
        figure.legend(*accepted.get_legend_handles_labels(), loc="outside right upper")
        figure.savefig(path)


def _logarithmic(axes: Axes) -> None:
    from matplotlib.ticker import LogLocator

    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")
