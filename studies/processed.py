"""Can a processed scheme of two forces hold the energy longer than SIER4G? Takahashi and Imada's, over whole runs.

    python -m studies.processed [--steps 3 4] [--time 100]

A step is half a drift, one gradient kick and half a drift: two force evaluations, and so two thirds of SIER4G's step at
the same simulated time per force evaluation. It is conjugate to a scheme of fourth order. What it conserves to fourth
order is the energy of the processed state, H - (h^2/24) d^2V/dt^2, which follows from the potential energy of three
steps. Starts are those of `studies.whole_run`, in the same directory.

Source: Takahashi and Imada, J. Phys. Soc. Jpn. 53, 3765 (1984); Lopez-Marcos, Sanz-Serna and Skeel, SIAM J. Sci.
Comput. 18, 223 (1997).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from openmm_sier.analysis.observables import energy_error, energy_walk
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.stages import DRIFT, GRADIENT_KICK, Stage
from studies import records, text
from studies.command import command
from studies.methods import of_scheme
from studies.records import Record, Task
from studies.report import SILENT, Report
from studies.sampling import follow
from studies.whole_run import WholeRunSettings, start, tasks

TAKAHASHI_IMADA = Scheme(
    "Takahashi-Imada",
    (Stage(DRIFT, 0.5), Stage(GRADIENT_KICK, 1.0, 1 / 12), Stage(DRIFT, 0.5)),
    "Takahashi and Imada, J. Phys. Soc. Jpn. 53, 3765 (1984)",
)

COLUMNS = text.columns("liquid", "step", "fs_per_force", "seed", "percent", "walk") | {
    "of the processed state/%": "{processed:.3g}",
}


@dataclass(frozen=True)
class ProcessedSettings(WholeRunSettings):
    """Settings of the trial, those of `studies.whole_run`; `methods` and `per_force` say nothing here."""

    steps: tuple[float, ...] = (3.0, 4.0)


def processed(V: np.ndarray, H: np.ndarray) -> np.ndarray:
    """Energy of the processed state at all steps but the first and last, from V and H of each step."""
    return H[1:-1] - (V[2:] - 2 * V[1:-1] + V[:-2]) / 24


def run(task: Task) -> dict[str, Any]:
    """Errors of the energy, in per cent of rms(V), without and with the processor."""
    method, settings = of_scheme(TAKAHASHI_IMADA), task.settings
    per_force = task.point["step"] / method.forces
    series = follow(start(task), method, per_force, settings.time, interval=task.point["step"]).series
    inner, better = slice(1, -1), processed(series.potential, series.total)
    return task.point | {
        "fs_per_force": per_force,
        "percent": 100 * energy_error(series.total, series.potential),
        "processed": 100 * energy_error(better, series.potential),
        "walk": 100 * energy_walk(series.time[inner], better, series.potential),
    }


def study(settings: ProcessedSettings, report: Report = SILENT) -> Record:
    """Make the runs that are missing in the directory `out`, and write processed.json."""
    form = "{liquid}, {step:g} fs, seed {seed}: {percent:.3f}, {processed:.3f} %"
    tried = tasks(replace(settings, methods=("sier4g",)))
    rows = records.all_runs(settings, "processed", tried, run, report, form).assign(method=TAKAHASHI_IMADA.name)
    report.table("Takahashi and Imada's scheme over whole runs", text.table(rows, COLUMNS))
    return Record(settings.recorded(), {"rows": rows}, {}).write(settings.out / "processed.json")


main = command(ProcessedSettings, study, __doc__, __name__)
