"""The record of water against the step: differences from exact averages, and their figure.

The study itself is archived (`studies.archive`); `studies.heat_bath` has all but its diffusion.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from studies import style, text
from studies.records import Record

#: Properties by their keys in rows, with labels of the figure.
PROPERTIES = {
    "density": "density (g/cm³)",
    "energy": "potential energy (kJ/mol)",
    "diffusion": "self-diffusion (10⁻⁹ m²/s)",
}

#: What the figure says.
TITLE = "Verlet with AndersenThermostat leaves the exact averages;\nthe others stay near them (grey: two errors)"

#: What ends the name of a method whose averages have no error of the step.
EXACT = " HMC"

#: Left out of the reference: its bath heats the liquid at any step (`tests/system/test_openmm_heat_baths.py`).
HEATED = "OpenMM Verlet"

#: fs by which the points of different methods are shifted apart.
APART = 0.06


def deviations(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the differences of properties from the exact averages, by box.

    Hybrid Monte Carlo has no error of the step, so that the mean over its rows is exact. It has no dynamics: the
    diffusion is compared with the mean over the rows of the shortest step at which it is known, without those whose
    bath heats the liquid. Rows of a reference are chosen by their method and step, not by their results, and weighted
    by the inverse squares of their errors. What has no reference is left out.

    Returns:
        For each property, box, method and step the `reference` and its error, and the `difference` from it with that of
        the row alone; rows of which the reference is made have their own difference too.
    """
    tables = []
    for key in PROPERTIES:
        for _, of_box in rows.dropna(subset=[key]).groupby("box", sort=False):
            of = _reference(of_box[np.isfinite(of_box[f"{key}_error"])])
            if of.empty:
                continue
            weights = of[f"{key}_error"] ** -2
            mean, doubt = np.average(of[key], weights=weights), weights.sum() ** -0.5
            compared = of_box[["box", "method", "fs_per_force"]].assign(
                property=key, reference=mean, reference_error=doubt
            )
            tables.append(compared.assign(difference=of_box[key] - mean, difference_error=of_box[f"{key}_error"]))
    return pd.concat(tables, ignore_index=True)


def _reference(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of one box and property of which the reference is the mean."""
    exact = rows[rows["method"].str.endswith(EXACT)]
    cold = rows[rows["method"] != HEATED]
    return exact if len(exact) else cold[cold["fs_per_force"] == cold["fs_per_force"].min()]


def beside_reference(differences: pd.DataFrame, key: str) -> pd.DataFrame:
    """Return a table of text of the `deviations` of one property, with a line for each method and step.

    Errors have that of the reference in them.
    """
    differences = differences[differences["property"] == key]
    error = np.hypot(differences["difference_error"], differences["reference_error"])
    own_rows = differences.assign(
        box=differences["box"].replace(style.MODELS), value=differences["difference"], value_error=error
    )
    reference = own_rows.drop_duplicates("box").assign(method="reference", fs_per_force=text.UNKNOWN)
    reference = reference.assign(value=reference["reference"], value_error=reference["reference_error"])
    columns = text.columns("method", "fs_per_force") | {"{box}": "{value_text}"}
    return text.table(pd.concat([reference, own_rows]), columns)


def figure(record: Record, path: Path) -> None:
    """Draw a row of panels for each property and one for each box: differences from the exact averages, by step.

    The band is two errors of the reference, and so are the bars.
    """
    from matplotlib.figure import Figure

    differences = deviations(record.tables["rows"])
    differences = differences[~differences["method"].str.endswith(EXACT)].assign(
        difference_error=2 * differences["difference_error"]
    )
    boxes = list(differences["box"].unique())
    with style.context():
        picture = Figure(figsize=(3.1 * len(boxes) + 1, 0.9 + 2.4 * len(PROPERTIES)), layout="constrained")
        picture.suptitle(TITLE, x=0.01, ha="left", fontsize=16, fontweight="bold")
        grid = picture.subplots(len(PROPERTIES), len(boxes), squeeze=False, sharex=True, sharey="row")
        for key, line in zip(PROPERTIES, grid, strict=True):
            line[0].set_ylabel(f"Δ {PROPERTIES[key]}")
            for box, axes in zip(boxes, line, strict=True):
                of_box = differences[(differences["box"] == box) & (differences["property"] == key)]
                for doubt in of_box["reference_error"][:1]:
                    axes.axhspan(-2 * doubt, 2 * doubt, color="0.85", zorder=0)
                axes.axhline(0, color=style.GREY, lw=1)
                style.curves(axes, of_box, "fs_per_force", "difference", apart=APART, lw=1, capsize=0)
        for box, axes in zip(boxes, grid[0], strict=True):
            axes.set_title(style.MODELS.get(box, box))
        for axes in grid[-1]:
            axes.set_xlabel("fs per force")
        handles, labels = grid[0][0].get_legend_handles_labels()
        picture.legend(handles, labels, loc="outside lower center", ncols=max(1, len(labels)), fontsize=12)
        picture.savefig(path)
