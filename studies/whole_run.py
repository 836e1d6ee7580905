"""Energy conservation over whole runs: how far the energy of each scheme walks at each step.

    python -m studies.whole_run                                              64 molecules of TIP3P, every scheme
    python -m studies.whole_run --liquids TIP4P/2005 OPC --methods verlet sier4g --steps 1.5 4.5 6
    python -m studies.whole_run --molecules 512 --time 100 --methods sier4g --steps 4.5

The energy error is rms(H)/rms(V) about the mean of the whole run. The walk is the scatter of the means of H over 1 ps,
over rms(V). Each run is kept in whole-run.jsonl as soon as it is done, and is not repeated: a command that was stopped
goes on where it was, and commands with other liquids, methods, steps, sizes or lengths and one `--out` add to the same
table. Runs take turns on `--processes` processes of one thread each. Writes whole-run.json, whole-run.md and
whole-run.png from all runs there.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import openmm
import pandas as pd

from openmm_sier import prepare_system
from openmm_sier.measure import forcefields
from openmm_sier.measure.observables import energy_error, energy_walk
from openmm_sier.measure.starts import make_context, prepare
from openmm_sier.measure.statistics import slope_and_error
from openmm_sier.system import find_bodies
from studies import boxes, records, style
from studies.command import SYSTEMS, Settings, chosen, claim, execute
from studies.methods import CONSTANT_ENERGY
from studies.records import Record
from studies.report import SILENT, Report
from studies.sampling import Liquid, Unstable, follow


class Kind(NamedTuple):
    """A liquid: its PDB file in `systems`, and a force field if it is not the one that the file names."""

    file: str
    forcefield: tuple[str, ...] = ()


LIQUIDS = {
    "TIP3P": Kind("tip3p-512.pdb"),
    "SPC/E": Kind("spce-512.pdb"),
    "TIP4P/2005": Kind("tip4p2005-512.pdb"),
    "OPC": Kind("tip4p2005-512.pdb", ("opc.xml",)),
    "TIP5P": Kind("tip5p-512.pdb"),
    "peptide": Kind("peptide.pdb"),
    "protein": Kind("protein.pdb"),
}

#: fs between two samples of the energy. It is far below the 1 ps over which the walk is averaged.
INTERVAL = 24.0

#: What a point of the table has in common; its runs differ in their seeds alone.
POINT = ["liquid", "molecules", "time", "method", "step"]

COLUMNS = {
    "liquid": "{liquid}",
    "molecules": "{molecules}",
    "ps": "{time:g}",
    "scheme": "{method}",
    "step/fs": "{step:g}",
    "fs per force": "{fs_per_force:.3g}",
    "starts": "{starts}",
    "rms(H)/rms(V)/%": "{percent:.3g} ± {percent_error:.1g}",
    "walk/%": "{walk:.2g} ± {walk_error:.1g}",
    "drift of the box/kJ/mol/ps": "{drift:.4f} ± {drift_error:.4f}",
}


@dataclass(frozen=True)
class WholeRunSettings(Settings):
    """Settings of the comparison; the seeds of the starts follow `seed`.

    Attributes:
        liquids: by name, TIP3P, SPC/E, TIP4P/2005, OPC, TIP5P, peptide or protein.
        molecules: of a box of water.
        methods: by name, all unless given.
        steps: of each method, fs; steps for the same simulated time per force evaluation unless given.
        per_force: simulated time per force evaluation, fs.
        starts: equilibrated phase points, from which all runs start.
        time: of each run, ps.
        equilibrate: before them, ps.
        temperature: K.
        tolerance: OpenMM's ewaldErrorTolerance.
        processes: that make runs at the same time.
        platform: of OpenMM.
    """

    liquids: tuple[str, ...] = ("TIP3P",)
    molecules: int = 64
    methods: tuple[str, ...] = ()
    steps: tuple[float, ...] = ()
    per_force: tuple[float, ...] = (1.0, 4 / 3, 1.5, 2.0)
    starts: int = 2
    time: float = 100.0
    equilibrate: float = 5.0
    temperature: float = 297.0
    tolerance: float = 1e-4
    processes: int = 1
    platform: str = "CPU"


class Task(NamedTuple):
    """One run."""

    settings: WholeRunSettings
    liquid: str
    method: str
    step: float
    seed: int

    @property
    def molecules(self) -> int:
        """Of water boxes; 0 for boxes that are taken as they are."""
        return self.settings.molecules if LIQUIDS[self.liquid].file.endswith("-512.pdb") else 0

    @property
    def point(self) -> dict[str, Any]:
        """What identifies the run."""
        return {
            "liquid": self.liquid,
            "molecules": self.molecules,
            "time": self.settings.time,
            "method": CONSTANT_ENERGY[self.method].name,
            "step": round(self.step, 6),
            "seed": self.seed,
        }


def tasks(settings: WholeRunSettings) -> Iterator[Task]:
    """All runs that the settings ask for, seed by seed."""
    chosen(settings.liquids, LIQUIDS, "liquid")
    chosen(settings.methods, CONSTANT_ENERGY, "method")
    for seed in range(settings.seed, settings.seed + settings.starts):
        for liquid in settings.liquids:
            for name in settings.methods or CONSTANT_ENERGY:
                forces = CONSTANT_ENERGY[name].forces
                for step in settings.steps or [forces * each for each in settings.per_force]:
                    yield Task(settings, liquid, name, step, seed)


def start(task: Task) -> Liquid:
    """The equilibrated phase point of a task, which is kept for the others of its liquid, size and seed."""
    settings, kind = task.settings, LIQUIDS[task.liquid]
    kept = settings.out / f"start of {task.liquid.replace('/', '-')}, {task.molecules}, seed {task.seed}.xml"
    box = forcefields.read_box(SYSTEMS / kind.file, kind.forcefield or None, None if task.molecules else "hbonds")
    topology, positions, system = box.topology, box.positions, box.system
    if task.molecules:
        replica = boxes.of_size(box, SYSTEMS, task.molecules)
        positions, system = replica.positions * openmm.unit.nanometer, replica.system
    boxes.with_tolerance(system, settings.tolerance)
    if not task.molecules:
        prepare_system(system)
    if kept.exists():
        state = openmm.XmlSerializer.deserialize(kept.read_text())
    else:
        context = make_context(system, CONSTANT_ENERGY["sier4g"].make(0.003), settings.platform)
        prepare(context, positions, settings.temperature, task.seed, settings.equilibrate)
        state = context.getState(positions=True, velocities=True)
        records.replace_file(kept, openmm.XmlSerializer.serialize(state))
    bodies = find_bodies.RigidBodies.from_system(system, None if task.molecules else topology)
    return Liquid(system, bodies, state, settings.platform)


def run(task: Task) -> dict[str, Any]:
    """The energy error of a run, its walk and drift; why it ended early, if it did, is in `broken`."""
    method = CONSTANT_ENERGY[task.method]
    found = task.point | {"forces": method.forces, "fs_per_force": task.step / method.forces, "broken": ""}
    unknown = dict.fromkeys(("percent", "walk", "within_1_ps", "drift"), math.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            series = follow(start(task), method, found["fs_per_force"], task.settings.time, interval=INTERVAL).series
        except Unstable as error:
            return found | unknown | {"broken": str(error)}
    time, H, V = series.time, series.total, series.potential
    drift = slope_and_error(time, H)
    return found | {
        "percent": 100 * energy_error(H, V),
        "walk": 100 * energy_walk(time, H, V),
        "rms_V": float(np.std(V)),
        "drift": drift.value,
        "its_error": drift.error,
        "temperature": float(np.nanmean(series.translation)),
        "means": np.round([each.mean() for each in np.array_split(H, max(1, round(task.settings.time)))], 4),
    }


def run_missing(settings: WholeRunSettings, path: Path, report: Report = SILENT) -> None:
    """Make the runs that a file lacks, and add each to it."""
    done = [{name: kept[name] for name in (*POINT, "seed")} for kept in records.kept_runs(path)]
    missing = [task for task in tasks(settings) if task.point not in done]
    os.environ.setdefault("OPENMM_CPU_THREADS", "1")
    with ProcessPoolExecutor(settings.processes, multiprocessing.get_context("spawn")) as pool:
        for made in as_completed([pool.submit(run, task) for task in missing]):
            found = made.result()
            records.keep_run(path, found)
            told = found["broken"] or records.cell("{percent:.3f} %, walk {walk:.3f} %, {drift:+.4f} kJ/mol/ps", found)
            report.note(", ".join(str(found[name]) for name in (*POINT, "seed")) + f": {told}")


def points(runs: pd.DataFrame) -> pd.DataFrame:
    """A row for each liquid, size, length, scheme and step: means over the starts with standard errors."""
    return pd.DataFrame([_point(mine) for _, mine in runs.groupby(POINT, sort=False)])


def _point(runs: pd.DataFrame) -> dict[str, Any]:
    starts = len(runs)
    point = {name: runs.iloc[0][name] for name in (*POINT, "forces", "fs_per_force")} | {"starts": starts}
    for name in ("percent", "walk", "drift"):
        point[name] = runs[name].mean(skipna=False)
        point[f"{name}_error"] = runs[name].std(skipna=False) / math.sqrt(starts)
    return point | {"broken": next((reason for reason in runs["broken"] if reason), "")}


def study(settings: WholeRunSettings, report: Report = SILENT) -> Record:
    """Make the runs that are missing in the directory `out`, and write whole-run.json, whole-run.md and the figure."""
    shared = {name: settings.recorded()[name] for name in ("temperature", "equilibrate", "tolerance", "platform")}
    claim(settings.out / "whole-run-settings.json", shared)
    path = settings.out / "whole-run.jsonl"
    run_missing(settings, path, report)
    runs = pd.DataFrame(records.kept_runs(path)).replace({None: math.nan})
    rows = points(runs).sort_values([*POINT[:3], "method", "step"], kind="stable")
    table = records.table("Conservation of energy over whole runs", rows, COLUMNS, left=1)
    report.table(table)
    record = Record(shared, {"rows": rows, "runs": runs}, {})
    record.write(settings.out / "whole-run.json")
    (settings.out / "whole-run.md").write_text(records.markdown(table))
    figure(record, settings.out / "whole-run.png")
    return record


def figure(record: Record, path: Path) -> None:
    """The walk of the energy against the step, one line for each scheme."""
    rows = record.tables["rows"]
    first = rows[["liquid", "molecules", "time"]].iloc[0]
    rows = rows[(rows[["liquid", "molecules", "time"]] == first).all(axis=1)]
    with style.figure(path, 1) as (made, (axes,)):
        style.curves(axes, rows, "step", "walk")
        axes.set(yscale="log", xlabel="step (fs)", ylabel="scatter of means over 1 ps (% of rms(V))")
        style.shared_legend(made, axes)


def main(arguments: Sequence[str] | None = None) -> int:
    return execute(WholeRunSettings, study, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
