"""Properties of a liquid against the step: the table and the figure of `openmm-sier study`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from openmm_sier.measure.statistics import Estimate
from studies import style

#: Properties by their keys in rows, with their names in the table and labels in the figure.
PROPERTIES = {
    "density": ("density, g/cm³", "density (g/cm³)"),
    "energy": ("potential energy, kJ/mol", "potential energy (kJ/mol)"),
    "dielectric": ("dielectric constant", "dielectric constant"),
    "diffusion": ("self-diffusion in the box, 10⁻⁹ m²/s", "self-diffusion (10⁻⁹ m²/s)"),
}

#: Columns of the table that follow from runs.
COLUMNS = {"translation": "T_trans, K", "rotation": "T_rot, K"} | {key: name for key, (name, _) in PROPERTIES.items()}

#: fs by which the points of different methods are shifted apart.
APART = 0.03


class StepRow(NamedTuple):
    """One method in one box at one step.

    Attributes:
        box: name of it.
        method: name of it.
        step: fs.
        fs_per_force: step over its number of force evaluations.
        runs: their number.
        time: simulated time of all runs, without what is skipped, ps.
        found: by the keys of `COLUMNS`; properties that the runs do not give are missing.
    """

    box: str
    method: str
    step: float
    fs_per_force: float
    runs: int
    time: float
    found: Mapping[str, Estimate]


def with_shared_errors(rows: Sequence[StepRow]) -> list[StepRow]:
    """Rows whose errors fall as the root of their length, with one factor for each box, method and property.

    A run of a few correlation times underestimates the correlation, and so its own error. Liquids relax alike at all
    steps, except by hybrid Monte Carlo with shorter trials. So the square of the factor is the mean over rows of one
    box and method, weighted by their lengths.
    """
    shared = []
    for row in rows:
        alike = [other for other in rows if (other.box, other.method) == (row.box, row.method)]
        found = {}
        for key, estimate in row.found.items():
            known = [(r.time, r.found[key].error) for r in alike if key in r.found]
            times, errors = np.array([pair for pair in known if math.isfinite(pair[1])]).reshape(-1, 2).T
            if len(times):
                factor = math.sqrt(np.average(times * errors**2, weights=times))
                estimate = estimate._replace(error=factor / math.sqrt(row.time))
            found[key] = estimate
        shared.append(row._replace(found=found))
    return shared


def step_table(rows: Sequence[StepRow]) -> tuple[list[str], list[list[str]]]:
    """Header and cells of the table, boxes and methods in the order of their first rows."""
    head = ["box", "method", "step, fs", "fs per force", "runs", "ps", *COLUMNS.values()]
    cells = [
        [row.box, row.method, f"{row.step:g}", f"{row.fs_per_force:g}", str(row.runs), f"{row.time:.4g}"]
        + [str(row.found[key]) if key in row.found else "-" for key in COLUMNS]
        for row in in_order(rows)
    ]
    return head, cells


def markdown(rows: Sequence[StepRow]) -> str:
    """The table for a page of documentation."""
    head, cells = step_table(rows)
    lines = [head, ["---"] * len(head), *cells]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def in_order(rows: Sequence[StepRow]) -> list[StepRow]:
    """Rows by box and method, in the order in which these first appear, and by step."""
    boxes, methods = (list(dict.fromkeys(getattr(row, name) for row in rows)) for name in ("box", "method"))
    return sorted(rows, key=lambda row: (boxes.index(row.box), methods.index(row.method), row.fs_per_force))


def step_figure(rows: Sequence[StepRow], title: str, path: Path) -> None:
    """A row of panels for each box: properties against simulated time per force evaluation, with standard errors.

    Args:
        rows: of all boxes, methods and steps.
        title: above the figure.
        path: PNG file to write.
    """
    from matplotlib.figure import Figure

    boxes = list(dict.fromkeys(row.box for row in rows))
    with style.context():
        figure = Figure(figsize=(4.2 * len(PROPERTIES), 0.7 + 3.3 * len(boxes)), layout="constrained")
        figure.suptitle(title, x=0.01, ha="left", fontsize=14, fontweight="bold")
        grid = figure.subplots(len(boxes), len(PROPERTIES), squeeze=False, sharex=True)
        for box, line in zip(boxes, grid, strict=True):
            mine = in_order([row for row in rows if row.box == box])
            for key, axes in zip(PROPERTIES, line, strict=True):
                _draw(axes, mine, key)
                axes.set_title(box if key == "density" else "")
        for axes in grid[-1]:
            axes.set_xlabel("simulated time per force evaluation (fs)")
        handles, labels = grid[0][0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper right", ncols=max(1, len(labels)), fontsize=10)
        figure.savefig(path)


def _draw(axes: Any, rows: Sequence[StepRow], key: str) -> None:
    """One property in one box."""
    methods = list(dict.fromkeys(row.method for row in rows))
    for i, method in enumerate(methods):
        points = [(row.fs_per_force, row.found[key]) for row in rows if row.method == method and key in row.found]
        if not points:
            continue
        h = np.array([h for h, _ in points]) + APART * (i - (len(methods) - 1) / 2)
        value = [found.value for _, found in points]
        error = [found.error if math.isfinite(found.error) else 0.0 for _, found in points]
        axes.errorbar(h, value, error, capsize=3, label=method, **_style(method))
    axes.set_xlim(left=0)
    axes.set_ylabel(PROPERTIES[key][1])


def _style(method: str) -> dict[str, Any]:
    """The style of a method; hybrid Monte Carlo has the colour of its scheme."""
    if method.endswith(" HMC"):
        return style.of_method(method.removesuffix(" HMC")) | {"marker": "*", "ms": 9, "ls": ":"}
    return style.of_method(method)
