"""Acceptance of hybrid Monte Carlo against the number of molecules.

    python -m studies.acceptance [BOX.pdb] [--sizes 64 512] [--schemes verlet sier4g]

All schemes follow trajectories of the same length from the same boxes, Verlet among them: kick, drift, kick with a
step of RATTLE that is solved to rounding, so that it is reversible and can be accepted or rejected exactly. Boxes and
trials are kept in --out as soon as they are done: a stopped study goes on where it was, and one with further sizes,
schemes or steps adds to them. Writes acceptance.json and acceptance.png. The default takes an hour or two of one core.
"""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from openmm_sier.dynamics.metropolis import spread_at
from openmm_sier.dynamics.schemes import SIER4G
from studies import acceptance_trials as trials
from studies import boxes, records, style
from studies.acceptance_trials import AcceptanceSettings
from studies.command import chosen, claim, command
from studies.methods import REVERSIBLE
from studies.records import Record
from studies.report import SILENT, Report

#: The directory of intermediate results.
KEPT = "trials"

#: Settings in which the trials of a directory may differ.
FREE = ("sizes", "schemes", "dt", "trials")

#: Spreads of boxes below this size are not pooled with those of larger ones, since cut-offs are shorter in boxes that
#: are narrower than twice the usual cut-off.
SMALLEST_POOLED = 512

#: Factor by which the points of one method are beside those of the one before, in the figure, and the relative
#: difference of two laws below which one line would hide the other.
APART, ALIKE = 1.12, 0.03

#: Number of molecules up to which lines of acceptance are drawn.
LARGEST_DRAWN = 262144

COLUMNS = {
    "molecules": "{molecules}",
    "scheme": "{method}",
    "fs per force": "{fs_per_force:g}",
    "trajectory/fs": "{length:g}",
    "trials": "{trials}",
    "acceptance": "{acceptance:.3f} ± {acceptance_error:.3f}",
    "sd/kT": "{spread:.4f} ± {spread_error:.4f}",
    "mean/kT": "{mean:.4f} ± {mean_error:.4f}",
    "noise of the energy/kT": "{noise:.1g}",
}

LIMITS = {
    "scheme": "{method}",
    "fs per force": "{fs_per_force:g}",
    "sd for one molecule/kT": "{spread:.5f} ± {spread_error:.5f}",
    "largest box measured": "{measured}",
    "by sd ~ sqrt(N)": "{largest:.0f} ± {largest_error:.0f}",
}


def row_of(member: dict[str, Any]) -> dict[str, Any]:
    """The row for trials, see `acceptance_trials.measure`.

    Returns:
        Besides what tells the trials: their number; `acceptance`, the mean of min(1, exp(-error)); `spread`, the
        standard deviation of the energy error; `mean` of the error, half the square of the spread if errors are normal,
        each with its standard error; `noise`, the standard deviation of the energy from rounding, which enters each
        trial twice. Energies are in kT.
    """
    errors = np.array([math.inf if error is None else error for error in member["errors"]])
    followed = errors[np.isfinite(errors)]
    unknown = ("acceptance", "acceptance_error", "spread", "spread_error", "mean", "mean_error")
    row = {key: value for key, value in member.items() if key not in ("errors", "reversal")}
    row |= {"trials": len(errors)} | dict.fromkeys(unknown, math.nan)
    if len(errors) > 1:
        chances = np.exp(-np.maximum(errors, 0))
        row["acceptance"], row["acceptance_error"] = chances.mean(), chances.std(ddof=1) / math.sqrt(len(errors))
    if len(followed) > 1:
        sd = followed.std(ddof=1)
        row["spread"], row["spread_error"] = sd, sd / math.sqrt(2 * (len(followed) - 1))
        row["mean"], row["mean_error"] = followed.mean(), sd / math.sqrt(len(followed))
    return row


def measure(settings: AcceptanceSettings, report: Report = SILENT) -> pd.DataFrame:
    """Make the trials that the directory lacks; all of its results are returned, see `row_of`.

    Raises:
        ValueError: a scheme is unknown, a size does not fit the box, or the directory has results of other settings.
    """
    methods = dict(zip(settings.schemes or REVERSIBLE, chosen(settings.schemes, REVERSIBLE, "scheme"), strict=True))
    if len(settings.trials) not in (0, 1, len(settings.sizes)):
        raise ValueError(f"trials must be one number or one for each of {len(settings.sizes)} sizes")
    if settings.trials and min(settings.trials) < 2:
        raise ValueError(f"trials must be at least 2, got {min(settings.trials)}")
    box = boxes.read(settings)
    kept = settings.out / KEPT
    kept.mkdir(parents=True, exist_ok=True)
    claim(kept / "settings.json", {key: value for key, value in settings.recorded().items() if key not in FREE})
    for molecules in settings.sizes:
        replica, begun = boxes.of_size(box, settings.box.parent, molecules), None
        for (name, method), dt in itertools.product(methods.items(), settings.dt):
            path, wanted = kept / f"{molecules}-{name}-{dt:g}.json", settings.trials_of(molecules)
            if (member := _known(path, wanted)) is None:
                # A cropped box has new faces, so it is equilibrated until it has settled.
                time = None if molecules < box.topology.getNumResidues() else settings.equilibrate
                begun = begun or trials.start(replica, kept / f"{molecules}.npy", settings, time, report)
                member = trials.measure(begun, method, dt, wanted, settings, report)
                records.replace_file(path, json.dumps(member, indent=1))
            form = "acceptance {acceptance:.3f} ± {acceptance_error:.3f}, sd {spread:.4f} ± {spread_error:.4f} kT"
            told = member["broken"] or records.cell(form, row_of(member))
            report.note(f"{method.name} at {dt:g} fs per force, {molecules} molecules: {told}")
    found = [row_of(json.loads(path.read_text())) for path in sorted(kept.glob("[0-9]*.json"))]
    order = [method.name for method in REVERSIBLE.values()]
    rows = pd.DataFrame(found).sort_values("method", key=lambda names: names.map(order.index))
    return rows.sort_values(["molecules", "fs_per_force"], kind="stable", ignore_index=True)


def _known(path: Path, wanted: int) -> dict[str, Any] | None:
    """Trials that are on disk, if they are enough."""
    member = json.loads(path.read_text()) if path.exists() else None
    return member if member and (member["broken"] or len(member["errors"]) >= wanted) else None


# --- how large a box may be ---


def limits(rows: pd.DataFrame, accepted: float = 0.5) -> pd.DataFrame:
    """How large a box may be, for each method and step with trials in boxes of `SMALLEST_POOLED` molecules or more.

    Molecules that are far from each other contribute to the energy error independently, so its variance is proportional
    to their number; `openmm_sier.dynamics.metropolis` computes the acceptance that follows.

    Returns:
        For each method and step the `spread` of the energy error for one molecule in kT; `measured`, the largest box
        that was measured with an acceptance above the one asked for, 0 if there is none; `largest`, the number of
        molecules with that acceptance by this law; and standard errors.
    """
    found = []
    for (method, dt), mine in rows[rows["spread"] > 0].groupby(["method", "fs_per_force"], sort=False):
        large = mine[mine["molecules"] >= SMALLEST_POOLED]
        if large.empty:
            continue
        spread, error = pooled_spread(large)
        largest = (spread_at(accepted) / spread) ** 2
        row = {"method": method, "fs_per_force": dt, "spread": spread, "spread_error": error}
        row["measured"] = max(mine.loc[mine["acceptance"] > accepted, "molecules"], default=0)
        found.append(row | {"largest": largest, "largest_error": 2 * largest * error / spread})
    return pd.DataFrame(found)


def expected_acceptance(spread: float) -> float:
    """Mean of min(1, exp(-error)) for normally distributed energy errors with this standard deviation in kT."""
    return math.erfc(spread / math.sqrt(8))


def pooled_spread(rows: pd.DataFrame) -> tuple[float, float]:
    """The spread for one molecule and its standard error, from boxes of several sizes, weighted by their trials.

    For n molecules it is sqrt(n) times as large.
    """
    freedom = rows["trials"] - 1
    value = math.sqrt((freedom * rows["spread"] ** 2 / rows["molecules"]).sum() / freedom.sum())
    return value, value / math.sqrt(2 * freedom.sum())


# --- the study ---


def study(settings: AcceptanceSettings, report: Report = SILENT) -> Record:
    """Measure, and write acceptance.json and acceptance.png."""
    rows = measure(settings, report)
    found = limits(rows)
    report.table(records.table("Energy error of trajectories, and acceptance", rows, COLUMNS, left=2))
    report.table(records.table("Largest box with an acceptance above 0.5", found, LIMITS))
    record = Record(settings.recorded(), {"rows": rows, "limits": found}, {})
    record.write(settings.out / "acceptance.json")
    figure(record, settings.out / "acceptance.png")
    return record


def figure(record: Record, path: Path) -> None:
    """Acceptance and spread of the energy error against the number of molecules, one line per method and step."""
    rows = record.tables["rows"]
    steps, limits = sorted(rows["fs_per_force"].unique()), record.tables["limits"].to_dict("records")
    with style.figure(path, 2, _title(record.tables["limits"])) as (made, (accepted, spread)):
        for i, limit in enumerate(limits):
            method, dt = limit["method"], limit["fs_per_force"]
            mine = rows[(rows["method"] == method) & (rows["fs_per_force"] == dt)]
            look = style.of_method(method) | {"ls": ("-", "--", ":", "-.")[steps.index(dt) % 4]}
            if any(abs(limit["spread"] / earlier["spread"] - 1) < ALIKE for earlier in limits[:i]):
                look |= {"ls": (0, (5, 5))}  # so that the line below shows between the dashes
            beside = mine.assign(molecules=mine["molecules"] * APART ** (i - (len(limits) - 1) / 2))
            style.curves(accepted, beside, "molecules", "acceptance", ls="", label="_", zorder=3)
            style.curves(spread, beside, "molecules", "spread", ls="", label="_", zorder=3)
            along = np.geomspace(mine["molecules"].min(), max(LARGEST_DRAWN, mine["molecules"].max()), 200)
            spreads = limit["spread"] * np.sqrt(along)
            spread.plot(along, spreads, **look | {"marker": ""})
            accepted.plot(along, [expected_acceptance(each) for each in spreads], **look | {"marker": ""})
            accepted.plot([], [], label=method if len(steps) == 1 else f"{method}, {dt:g} fs per force", **look)
        accepted.axhline(0.5, color=style.GREY, lw=1, zorder=0)
        accepted.set(xscale="log", ylim=(0, 1.03), ylabel="acceptance", title="Acceptance, and erfc(sd/√8)")
        style.logarithmic(spread)
        spread.set(ylabel="standard deviation of the energy error (kT)", title="Energy error, and sd ~ √N")
        for axes in (accepted, spread):
            axes.set_xlabel("molecules of water")
            style.plain_ticks(axes.xaxis, [8**n for n in range(2, 8)])
        style.shared_legend(made, accepted)


def _title(limits: pd.DataFrame) -> str:
    """How much larger boxes may be with SIER4G than with Verlet, at their first steps that were measured."""
    largest = limits.drop_duplicates("method").set_index("method")["largest"]
    names = SIER4G.name, REVERSIBLE["verlet"].name
    if not set(names) <= set(largest.index):
        return "Hybrid Monte Carlo by the size of the box"
    times = largest[names[0]] / largest[names[1]]
    return f"Half of the trials are accepted in boxes {times:.0f} times as large with SIER4G as with Verlet"


main = command(AcceptanceSettings, study, __doc__, __name__)
