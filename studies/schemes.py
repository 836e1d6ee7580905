"""Energy conservation of the schemes for a given number of forces.

    python -m studies.schemes [BOX.pdb] [--schemes verlet sier4g] [--dt 1 2]

compares energy error and long-run drift of every scheme and of OpenMM's Verlet against force evaluations per ps, and
writes schemes.json and schemes.png.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from openmm_sier.measure.observables import energy_drift, energy_error
from openmm_sier.measure.report import SILENT, Report
from studies import records, style
from studies.command import BoxSettings, chosen, execute
from studies.methods import CONSTANT_ENERGY, OTHERS, Method, of_scheme
from studies.records import Record
from studies.sampling import Liquid, Unstable, equilibrated_liquid, follow

#: Everything that can be compared, by the names that users give.
KNOWN: dict[str, Method] = CONSTANT_ENERGY | {name: of_scheme(scheme) for name, scheme in OTHERS.items()}

COLUMNS = {
    "scheme": "{method}",
    "order": "{order}",
    "forces a step": "{forces}",
    "step/fs": "{step:g}",
    "fs per force": "{fs_per_force:g}",
    "forces/ps": "{forces_per_ps:.0f}",
    "rms(H)/rms(V)/%": "{percent:.3f}",
    "drift of the box/kJ/mol/ps": "{drift:.3f} ± {drift_error:.3f}",
}


@dataclass(frozen=True)
class SchemesSettings(BoxSettings):
    """Settings of the comparison.

    Attributes:
        dt: simulated time per force evaluation, fs.
        schemes: by name; all unless given.
        time: of each run, ps.
        equilibrate: before them, ps.
    """

    dt: tuple[float, ...] = (1.0, 1.5, 2.0, 2.5)
    schemes: tuple[str, ...] = ()
    time: float = 4.0
    equilibrate: float = 4.0


def compare(settings: SchemesSettings, report: Report = SILENT) -> pd.DataFrame:
    """Run every scheme at every time per force evaluation from one equilibrated start.

    Returns:
        A row for each, with its step in fs, `percent` for rms(H)/rms(V) in per cent (see
        `openmm_sier.measure.observables.energy_error`), the drift of the energy of the whole box in kJ/mol/ps, and why
        the run ended early, if it did: `broken`.

    Raises:
        ValueError: a scheme is unknown.
    """
    methods = chosen(settings.schemes, KNOWN, "scheme")
    liquid = equilibrated_liquid(settings, settings.equilibrate, report)
    rows = []
    for dt in settings.dt:
        for method in methods:
            rows.append(_row(liquid, method, dt, settings.time, report))
            form = "rms(H)/rms(V) = {percent:.3f} %, drift {drift:+.2f} ± {drift_error:.2f} kJ/mol/ps"
            told = f"broke down ({rows[-1]['broken']})" if rows[-1]["broken"] else records.cell(form, rows[-1])
            report.note(f"{method.name} at {dt:g} fs per force: {told}")
    return pd.DataFrame(rows)


def _row(liquid: Liquid, method: Method, dt: float, time: float, report: Report) -> dict[str, Any]:
    row = {
        "method": method.name,
        "order": method.order,
        "forces": method.forces,
        "step": dt * method.forces,
        "fs_per_force": dt,
        "forces_per_ps": 1000 / dt,
        "percent": math.nan,
        "drift": math.nan,
        "drift_error": math.nan,
        "broken": "",
    }
    try:
        series = follow(liquid, method, dt, time, report=report).series
    except Unstable as error:
        return row | {"broken": str(error)}
    row["percent"] = 100 * energy_error(series.time, series.total, series.potential)
    row["drift"], row["drift_error"], _ = energy_drift(series.time, series.total)
    return row


def study(settings: SchemesSettings, report: Report = SILENT) -> Record:
    """Compare, and write schemes.json and schemes.png."""
    rows = compare(settings, report)
    report.table(records.table(f"Conservation of energy, {settings.time:g} ps each", rows, COLUMNS))
    for dt, mine in rows.dropna(subset=["percent"]).groupby("fs_per_force"):
        best = mine.loc[mine["percent"].idxmin()]
        report.note(f"least energy error at {dt:g} fs per force: {best['method']}, {best['percent']:.3f} %")
    record = Record(settings.recorded(), {"rows": rows}, {})
    record.write(settings.out / "schemes.json")
    figure(record, settings.out / "schemes.png")
    return record


def figure(record: Record, path: Path) -> None:
    """Energy error and size of the drift against force evaluations per picosecond, one line per scheme."""
    rows = record.tables["rows"].assign(drift=lambda rows: np.abs(rows["drift"]))
    with style.figure(path, 2) as (made, (error, drift)):
        style.curves(error, rows, "forces_per_ps", "percent")
        style.curves(drift, rows, "forces_per_ps", "drift")
        error.set(yscale="log", ylabel="rms(H)/rms(V) (%)", title="Energy error")
        # Linear where a drift is below what a run of some ps resolves.
        drift.set_yscale("symlog", linthresh=0.1)
        drift.set(ylim=(0, None), ylabel="size of the energy drift of the box (kJ/mol/ps)", title="Energy drift")
        for axes in (error, drift):
            axes.yaxis.set_major_formatter("{x:g}")
            axes.set_xlabel("force evaluations per picosecond")
        style.shared_legend(made, error)


def main(arguments: Sequence[str] | None = None) -> int:
    return execute(SchemesSettings, study, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
