"""Figures of the documentation, drawn from the numbers in `studies/data`.

    python -m studies.figures [--names energy walk]

The site draws them when it is built. README shows files, which this command draws into `docs`, and these figures alone
if no names are given.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from openmm_sier.dynamics.schemes import SIER2
from studies import records, scale, style, water_steps, whole_run
from studies.command import Settings, chosen, command
from studies.domains import drawing
from studies.paper import water
from studies.records import DATA, Record
from studies.report import SILENT, Report

DOCS = Path(__file__).parents[1] / "docs"

#: Figures that README shows.
KEPT = ("energy",)

#: The box of which `bath` tells, and what is in the name of a method whose averages are exact.
BATH_BOX, EXACT = "peptide", " HMC"


def bath(record: Record, path: Path) -> None:
    """Draw the error of the potential energy against speed, by integrator and step."""
    rows = record.tables["rows"]
    rows = rows[rows["box"] == BATH_BOX].dropna(subset=["over"])
    # At constant volume or pressure: energies of one of them can be compared.
    rows = rows[rows["at"] == rows["at"].iloc[0]]
    exact = rows[rows["method"].str.contains(EXACT)]
    off = rows["potential"] - exact["potential"].mean()
    rows = rows.assign(off=off, off_error=rows["potential_error"])
    with style.figure(path, 1, bath_title(rows, exact.iloc[0])) as (_, (energies,)):
        _against_speed(energies, rows, "off")
        energies.set(ylabel="V, less that of hybrid Monte Carlo (kJ/mol)")
        energies.legend(loc="lower left")


def bath_title(rows: pd.DataFrame, exact: pd.Series) -> str:
    """Return the result at the usual step of SIER2 with heavy hydrogens, or at the nearest measured one.

    Args:
        rows: of all methods.
        exact: of hybrid Monte Carlo.
    """
    ours = rows[rows["method"].str.startswith(f"{SIER2.name},") & ~rows["method"].str.endswith("light")]
    steps = ours["method"].str.extract(r"([\d.]+) fs")[0].astype(float)
    best = ours.loc[(steps - 1e3 * (SIER2.heavy_bath_step or 0)).abs().idxmin()]
    off, error = records.percent_off(best, exact, "potential")
    return f"{best['method']}: V is off by {off:+.2f} ± {error:.2f} %"


def _against_speed(axes: Any, rows: pd.DataFrame, key: str) -> None:
    """Draw a point with two errors for each method and step, with a label of the step."""
    families = rows.assign(method=rows["method"].str.partition(",")[0])
    style.curves(
        axes,
        families.assign(**{f"{key}_error": 2 * rows[f"{key}_error"]}),
        "over",
        key,
        ls="none",
        lw=1.5,
        markersize=9,
    )
    for row in rows.to_dict("records"):
        step = row["method"].partition(", ")[2]
        axes.annotate(step, (row["over"], row[key]), (7, 4), textcoords="offset points", fontsize=10)
    axes.axhline(0, color=style.GREY, lw=1)
    axes.set(xlabel="speed over LangevinMiddle's at 4 fs")
    axes.margins(x=0.15)


def equipartition(record: Record, path: Path) -> None:
    """Draw T_rot - T_trans against the step per force evaluation, one line per method, and the prediction for SIER2."""
    rows = record.tables["rows"]
    with style.figure(path, 1) as (_, (axes,)):
        style.curves(axes, rows, "fs_per_force", "difference", apart=0.05)
        measured = rows[rows["predicted"] < 0]
        if len(measured):
            h = np.linspace(0, measured["fs_per_force"].max(), 100)
            law = (measured["predicted"] / measured["fs_per_force"] ** 2).mean() * h**2
            axes.plot(h, law, color=style.GREY, lw=1, ls=":", label="SIER2, predicted", zorder=0)
        axes.axhline(0, color=style.GREY, lw=1)
        axes.set(xlabel="simulated time per force evaluation (fs)", ylabel=r"$T_\mathrm{rot} - T_\mathrm{trans}$ (K)")
        ensemble = record.settings["ensemble"].upper()
        title = f"Rotations are too cold at second order, not at fourth\n(liquid water, {ensemble})"
        axes.set_title(title, fontweight="bold")
        axes.legend()


class Drawn(NamedTuple):
    """A figure of the documentation: what draws it, and from which file of `DATA`."""

    figure: Callable[[Record, Path], None]
    data: str


FIGURES = {
    "bath": Drawn(bath, "heat-bath.json"),
    "domains": Drawn(drawing.figure, "domains.json"),
    "energy": Drawn(whole_run.energies, "whole-run.json"),
    "equipartition": Drawn(equipartition, "equipartition.json"),
    "paper-water": Drawn(water.figure, "paper-water.json"),
    "scale": Drawn(scale.figure, "scale.json"),
    "step-study": Drawn(water_steps.figure, "step-study.json"),
    "walk": Drawn(whole_run.figure, "whole-run.json"),
}


@dataclass(frozen=True, kw_only=True)
class FigureSettings(Settings):
    """Settings of the figures.

    Attributes:
        names: of figures; those that README shows unless given.
    """

    names: tuple[str, ...] = ()
    out: Path = DOCS


def study(settings: FigureSettings, report: Report = SILENT) -> None:
    """Draw figures.

    Raises:
        ValueError: there is no such figure.
    """
    chosen(settings.names, FIGURES, "figure")
    for name in settings.names or KEPT:
        drawn = FIGURES[name]
        path = settings.out / f"{name}.png"
        drawn.figure(records.read(DATA / drawn.data), path)
        report.note(f"{path}, from studies/data/{drawn.data}")


main = command(FigureSettings, study, __doc__, __name__)
