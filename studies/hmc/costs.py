"""Measure what a sample of the solvated dipeptide costs with hybrid Monte Carlo and Langevin dynamics.

    python -m studies.hmc.costs
    python -m studies.hmc.costs --methods "SIER4G, trials of 30 fs, steps of 6 fs" --starts 4

297 K, 1 bar and heavy hydrogens; the volume is tried after each trial, or every 25 steps. Acceptance, energy error,
potential energy, volume and density, and the number of forces for an independent potential energy, volume, dipole of
the box and cosine of psi. An energy, for the decision on a trial or on a move of the volume, counts as a force. Each
run has a directory in `--out`, and its numbers are kept in costs.jsonl: it is not repeated. Runs that differ in their
seeds alone are pooled. Runs take turns on `--processes` processes of one thread each. Writes costs.json.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd

from openmm_sier.analysis.statistics import mean_and_error
from openmm_sier.dynamics.schemes import SIER4G
from openmm_sier.inputs.forcefields import read_box
from openmm_sier.observe.stock import BAROSTAT_INTERVAL
from studies import command_runs, records, text
from studies.command import SYSTEMS, RunsSettings, chosen, command
from studies.hmc.samples import backbone, charges, cost, dihedral
from studies.records import Record, Task
from studies.report import SILENT, Report

BOX = SYSTEMS / "dipeptide.pdb"

#: ps between samples, which are rows of the log and frames.
EVERY = 0.12

#: Options of all runs.
OPTIONS = {
    "temperature": 297.0,
    "pressure": 1.0,
    "cutoff": 0.7,
    "switch": 0.6,
    "tolerance": 1e-4,
    "hydrogen_mass": 3.0,
    "equilibrate": 5.0,
    "every": EVERY,
    "report_every": EVERY,
    "checkpoint_every": 10.0,
    "platform": "CPU",
}


def _trials(steps: int, **more: float) -> dict[str, Any]:
    return {"ensemble": "hmc", "scheme": "sier4g", "dt": 6.0, "steps_per_trial": steps, **more}


def _middle(dt: float) -> dict[str, Any]:
    return {"ensemble": "npt", "scheme": "langevinmiddle", "dt": dt, "friction": 2.0}


#: Options by what is run. Hybrid Monte Carlo draws momenta anew for each trial, or in part, by a friction.
METHODS = {
    "OpenMM LangevinMiddle, steps of 2 fs, friction 2/ps": _middle(2.0),
    "OpenMM LangevinMiddle, steps of 4 fs, friction 2/ps": _middle(4.0),
    "SIER4G, trials of 120 fs, steps of 6 fs, friction 2/ps": _trials(20, friction=2.0),
    "SIER4G, trials of 120 fs, steps of 6 fs": _trials(20),
    "SIER4G, trials of 30 fs, steps of 6 fs, friction 2/ps": _trials(5, friction=2.0),
    "SIER4G, trials of 30 fs, steps of 6 fs": _trials(5),
}

#: What is observed, with its column in the log.
OBSERVED = {"potential": "Potential Energy (kJ/mole)", "volume": "Box Volume (nm^3)"}

#: Of what means are shown.
MEANS = OBSERVED | {"density": "Density (g/mL)"}

COLUMNS = text.columns("label", "runs", "time", "accepted", "spread", "potential", "density") | {
    "volume, nm³": "{volume_text}",
    "forces for an independent V": "{potential_cost_text}",
    "volume": "{volume_cost_text}",
    "dipole": "{dipole_cost_text}",
    "cos psi": "{psi_cost_text}",
}

#: Of what the number of forces for an independent sample is found.
COSTS = tuple(f"{name}_cost" for name in (*OBSERVED, "dipole", "psi"))


@dataclass(frozen=True)
class CostSettings(RunsSettings):
    """Choose what is run.

    Attributes:
        methods: by name, all unless given.
        starts: runs of each, whose seeds follow `seed`.
        time: of each run, ps.
        skip: ps to leave out at the beginning of each.
    """

    methods: tuple[str, ...] = ()
    starts: int = 2
    time: float = 100.0
    skip: float = 0.0

    ANY_SIGN: ClassVar[tuple[str, ...]] = ("skip",)
    SHARED = ("time", "skip")


def tasks(settings: CostSettings) -> Iterator[Task]:
    """All runs that the settings ask for, seed by seed."""
    chosen(settings.methods, METHODS, "method")
    seeds = range(settings.seed, settings.seed + settings.starts)
    for seed, method in product(seeds, settings.methods or METHODS):
        yield Task(settings, {"label": f"{BOX.stem}: {method}", "seed": seed}, method)


def directory(task: Task) -> Path:
    """Where the files of a run are."""
    name = task.method.replace(",", "").replace(" ", "-").replace("/", "-")
    return task.settings.out / f"{name}-seed{task.point['seed']}"


def forces_per_step(options: Mapping[str, Any]) -> float:
    """Forces of a step, which is a trial with hybrid Monte Carlo, and energies for decisions."""
    if options["ensemble"] == "hmc":
        return SIER4G.force_evaluations * options["steps_per_trial"] + 2
    return 1 + 1 / BAROSTAT_INTERVAL


def forces_per_sample(options: Mapping[str, Any]) -> float:
    """Forces from one sample to the next."""
    step = 1e-3 * options["dt"] * options.get("steps_per_trial", 1)
    return forces_per_step(options) * round(EVERY / step)


def run(task: Task) -> dict[str, Any]:
    """Means with errors, and costs, of one run; what it does not have is NaN."""
    settings, options, place = task.settings, METHODS[task.method], directory(task)
    command_runs.carry_out(place, BOX, OPTIONS | options | {"time": settings.time, "seed": task.point["seed"]})
    log = command_runs.read_log(place, settings.skip)
    row = task.point | {"time": float(np.ptp(log["Time (ps)"])), "accepted": math.nan, "spread": math.nan}
    if options["ensemble"] == "hmc":
        row |= {"accepted": log["Acceptance"][-1], "spread": float(np.nanstd(log["Energy Error (kT)"], ddof=1))}
    for name, column in MEANS.items():
        row[name], row[f"{name}_error"], _ = mean_and_error(log[column])
    series = {name: pd.DataFrame({name: log[column]}) for name, column in OBSERVED.items()}
    for name, samples in (series | in_frames(place, settings.skip)).items():
        # What does not change has no samples.
        if (np.ptp(samples.to_numpy(), axis=0) > 0).all():
            row[f"{name}_cost"], row[f"{name}_cost_error"], _ = cost(samples, forces_per_sample(options))
    return row


def in_frames(directory: Path, skip: float) -> dict[str, pd.DataFrame]:
    """The dipole of the box, of whole molecules, e nm, and the cosine of psi."""
    box = read_box(BOX, None, "hbonds")
    positions = command_runs.read_frames(directory, BOX).xyz[round(skip / EVERY) :].astype(float)
    _, psi = backbone(box.topology)
    return {
        "dipole": pd.DataFrame(charges(box.system) @ positions, columns=["x", "y", "z"]),
        "psi": pd.DataFrame({"psi": np.cos([dihedral(each, psi) for each in positions])}),
    }


def study(settings: CostSettings, report: Report = SILENT) -> Record:
    """Make the runs that are missing in the directory `out`, and write costs.json.

    Raises:
        RunFailed: a run ended with an error.
        ValueError: there is no such method.
    """
    rows = averaged(records.all_runs(settings, "costs", tasks(settings), run, report, "{label}, seed {seed}: done"))
    report.table("Samples", text.table(rows, COLUMNS))
    return Record(settings.shared(), {"rows": rows}, {}).write(settings.out / "costs.json")


def averaged(runs: pd.DataFrame) -> pd.DataFrame:
    """A row for each method, over its runs."""
    rows = []
    for label, mine in runs.groupby("label"):
        row = {"label": label, "runs": len(mine), "time": mine["time"].sum(), "accepted": mine["accepted"].mean()}
        row["spread"] = (mine["spread"] ** 2).mean() ** 0.5
        rows.append(row | records.pooled(mine, (*MEANS, *COSTS)))
    return pd.DataFrame(rows)


main = command(CostSettings, study, __doc__, __name__)
