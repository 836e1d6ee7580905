"""What large boxes of water cost before and in the first step, beside OpenMM, from 1,500 atoms to 330,000.

    OPENMM_CPU_THREADS=1 python -m studies.scale [--molecules 512 4096]

Each run is a process of its own, which reads a System, makes its Context and steps it, once with OpenMM's Verlet and
once with SIER2 on the prepared System; both take turns. Times are of the processor, on the CPU platform, with compiled
code that an earlier run left on disk; memory is the most that a process held, less what it held before it read the
System. A step after positions that are set, and after a checkpoint that is made or loaded, is timed with that call,
and so is OpenMM's list of neighbours alone, which a step after a checkpoint makes anew. Each run is kept in scale.jsonl
as soon as it is done. Writes scale.json and scale.png.
"""

from __future__ import annotations

import itertools
import math
import multiprocessing
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import openmm
import pandas as pd

from openmm_sier import SIERIntegrator, prepare_system
from openmm_sier.dynamics.schemes import SIER2
from openmm_sier.inputs import forcefields
from studies import boxes, records, speed_boxes, style, text
from studies.command import SYSTEMS, RunsSettings, claim, command
from studies.records import Record
from studies.report import SILENT, Report
from studies.timing import median_and_error

#: Methods, in the order of their turns. The first one is that with which the other is compared.
VERLET, OURS = "OpenMM Verlet", SIER2.name


#: Steps of both, ps, and the number of steps and forces that are timed.
STEP, REPEATS = 0.001, 5

#: Seconds of a day.
DAY = 86400.0

#: What a user waits for before the first step has ended, in order.
WAITS = ("prepare", "context", "velocities", "first")

#: What may come before a step, and make it longer.
CALLS = ("positions", "saved", "loaded")

#: How far all atoms are moved so that OpenMM makes a new list of neighbours, nm.
FAR = 1.0

COLUMNS = text.columns("atoms", "method") | {
    "prepare_system/s": "{prepare_text}",
    "Context/s": "{context_text}",
    "velocities/s": "{velocities_text}",
    "first step/s": "{first_text}",
    "a step/s": "{step_text}",
    "step over force": "{step_over_force:.2f}",
    "memory/MB": "{memory:.0f}",
}

AFTERWARDS = text.columns("atoms", "method") | {
    "positions are set": "{positions_more:.2f}",
    "a checkpoint is made": "{saved_more:.2f}",
    "a checkpoint is loaded": "{loaded_more:.2f}",
    "a list alone": "{list_forces:.2f}",
}

LOSSES = {
    "atoms": "{atoms:,}",
    "more than OpenMM/s": "{lost_text}",
    "in forces": "{forces:.1f}",
    "of a day's run/%": "{day_percent:.4f}",
    "memory over OpenMM's, without that of code": "{memory_ratio:.2f}",
}


@dataclass(frozen=True, kw_only=True)
class ScaleSettings(RunsSettings):
    """Settings of the comparison.

    Attributes:
        molecules: of each box, multiples of 512.
        rounds: in which both methods take their turns in each box.
    """

    molecules: tuple[int, ...] = (512, 4096, 13824, 32768, 110592)
    rounds: int = 3


def make_box(path: Path, molecules: int) -> None:
    """Write the System of a box of water as OpenMM makes it, and positions beside it, unless they are there."""
    if path.exists():
        return
    box = forcefields.read_box(SYSTEMS / "tip3p-512.pdb", interactions=speed_boxes.INTERACTIONS)
    repeated = boxes.repeated(box, SYSTEMS, boxes.copies_for(molecules, box.topology.getNumResidues()))
    boxes.split_by_openmm(repeated.system)
    np.save(path.with_suffix(".npy"), repeated.positions)
    records.replace_file(path, openmm.XmlSerializer.serialize(repeated.system))


def measure(path: Path, method: str) -> dict[str, float]:
    """Return what a method costs in a box: processor time of each action in s, and memory in MB."""
    times: dict[str, float] = {}

    def timed(name: str, action: Callable[[], Any]) -> Any:
        start = time.process_time()
        result = action()
        times[name] = time.process_time() - start
        return result

    before = memory("VmRSS")
    system, positions = openmm.XmlSerializer.deserialize(path.read_text()), np.load(path.with_suffix(".npy"))
    times["prepare"] = 0.0
    if method == OURS:
        timed("prepare", lambda: prepare_system(system))
    integrator = SIERIntegrator(STEP, SIER2) if method == OURS else openmm.VerletIntegrator(STEP)
    platform = openmm.Platform.getPlatformByName("CPU")
    context = timed("context", lambda: openmm.Context(system, integrator, platform))
    context.setPositions(positions)
    timed("velocities", lambda: context.setVelocitiesToTemperature(300, 1))
    timed("first", lambda: integrator.step(1))
    times["step"] = median_of(lambda: integrator.step(1))
    times["force"] = median_of(lambda: context.getState(forces=True))
    held = memory("VmHWM") - before
    return times | after_calls(context, integrator) | {"memory": held, "atoms": len(positions)}


def after_calls(context: openmm.Context, integrator: openmm.Integrator) -> dict[str, float]:
    """Return the processor time of a step with each of `CALLS` before it, and of a list of neighbours, s."""
    checkpoint = context.createCheckpoint()
    step = partial(integrator.step, 1)
    positions = context.getState(positions=True).getPositions(asNumpy=True)._value
    times = {
        "positions": median_of(lambda: context.setPositions(positions), step),
        "saved": median_of(context.createCheckpoint, step),
        "loaded": median_of(lambda: context.loadCheckpoint(checkpoint), step),
    }
    shifts = itertools.cycle((FAR, 0.0))

    def move() -> None:
        openmm.Context.setPositions(context, positions + next(shifts))

    # OpenMM looks at its list at each request for forces, even of no group.
    with_list = median_of(move, lambda: openmm.Context.getState(context, forces=True, groups=0))
    return times | {"list": with_list - median_of(move)}


def median_of(*actions: Callable[[], Any]) -> float:
    """Return the median processor time of actions, one after the other, in s."""
    seconds = []
    for _ in range(REPEATS):
        start = time.process_time()
        for action in actions:
            action()
        seconds.append(time.process_time() - start)
    return float(np.median(seconds))


def memory(name: str) -> float:
    """Return the memory of this process in MB: VmRSS is what it holds, VmHWM the most that it held; NaN off Linux."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith(name)), math.nan)


def memory_of_code() -> float:
    """Return the memory in MB that Numba and compiled code take in any System: that of a step of one molecule."""
    before = memory("VmRSS")
    system = openmm.System()
    for mass in (16.0, 1.0, 1.0):
        system.addParticle(mass)
    for i, j, length in ((0, 1, 0.1), (0, 2, 0.1), (1, 2, 0.16)):
        system.addConstraint(i, j, length)
    integrator = SIERIntegrator(STEP, SIER2)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("CPU"))
    context.setPositions([[0, 0, 0], [0.1, 0, 0], [-0.028, 0.096, 0]])
    context.setVelocitiesToTemperature(300, 1)
    integrator.step(1)
    return memory("VmRSS") - before


def fresh(function: Callable[..., Any], *arguments: Any) -> Any:
    """Return the result of a function in a process of its own."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(function, arguments)


def missing(settings: ScaleSettings, kept: list[dict[str, Any]]) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Yield the box and the point of each run that is not kept, by turns."""
    for molecules in settings.molecules:
        for turn in range(settings.rounds):
            for method in (VERLET, OURS):
                point = {"molecules": molecules, "round": turn, "method": method}
                if not any(point.items() <= run.items() for run in kept):
                    yield settings.out / f"box of {molecules}.xml", point


def medians(runs: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each box and method: medians over the rounds with standard errors."""
    rows = []
    for (atoms, method), group in runs.groupby(["atoms", "method"], sort=False):
        row: dict[str, Any] = {"atoms": int(atoms), "method": method}
        for name in (*WAITS, "step", "force", *CALLS, "list", "memory"):
            row[name], row[f"{name}_error"], _ = median_and_error(group[name].to_numpy(dtype=float))
        row["waits"], row["waits_error"], _ = median_and_error(group[list(WAITS)].sum(axis=1).to_numpy())
        row["step_over_force"] = row["step"] / row["force"]
        row["list_forces"] = row["list"] / row["force"]
        row |= {f"{name}_more": (row[name] - row["step"]) / row["force"] for name in CALLS}
        rows.append(row)
    return pd.DataFrame(rows).sort_values("atoms", kind="stable")


def losses(rows: pd.DataFrame, code_memory: float) -> pd.DataFrame:
    """Return for each box what is lost beside OpenMM: time before the first step has ended, and memory.

    Args:
        rows: of `medians`.
        code_memory: that of `memory_of_code`, which no box changes.
    """
    pairs = rows[rows["method"] == OURS].merge(rows[rows["method"] == VERLET], on="atoms", suffixes=("", "_openmm"))
    lost = pairs["waits"] - pairs["waits_openmm"]
    return pd.DataFrame(
        {
            "atoms": pairs["atoms"],
            "lost": lost,
            "lost_error": np.hypot(pairs["waits_error"], pairs["waits_error_openmm"]),
            "forces": lost / pairs["force_openmm"],
            "day_percent": 100 * lost / DAY,
            "memory_ratio": (pairs["memory"] - code_memory) / pairs["memory_openmm"],
            "code_memory": code_memory,
        }
    )


def study(settings: ScaleSettings, report: Report = SILENT) -> Record:
    """Make the runs that are missing in the directory `out`, and write scale.json and its figure."""
    claim(settings.out / "scale-settings.json", settings.shared())
    path = settings.out / "scale.jsonl"
    for number, (box, point) in enumerate(missing(settings, records.kept_runs(path))):
        fresh(make_box, box, point["molecules"])
        if not number:
            # Not kept: it may compile.
            fresh(measure, box, OURS)
        records.keep_run(path, point | fresh(measure, box, point["method"]))
        report.note(text.cell("{molecules} molecules, {method}, round {round}", point))
    runs = pd.DataFrame(records.kept_runs(path))
    rows = medians(runs)
    tables = {"rows": rows, "losses": losses(rows, fresh(memory_of_code)), "runs": runs}
    record = Record(settings.shared(), tables, {})
    report.table("Before and in the first step", text.table(rows, COLUMNS))
    report.table("A step after a call, in forces more than a step", text.table(rows, AFTERWARDS))
    report.table("Beside OpenMM", text.table(record.tables["losses"], LOSSES))
    record.write(settings.out / "scale.json")
    figure(record, settings.out / "scale.png")
    return record


def figure(record: Record, path: Path) -> None:
    """Draw times until the first step has ended, and memory, against the number of atoms."""
    rows, lost = record.tables["rows"], record.tables["losses"]
    title = f"{lost['atoms'].max():,} atoms: {lost['lost'].iloc[-1]:.1f} s later than OpenMM, once in a run"
    with style.figure(path, 2, title) as (picture, (times, memories)):
        style.curves(times, rows, "atoms", "waits")
        forces = rows[rows["method"] == VERLET]
        times.plot(forces["atoms"], forces["force"], color=style.GREY, ls=":", label="one force")
        times.set(
            xlabel="atoms", ylabel="processor time until the first step has ended (s)", xscale="log", yscale="log"
        )
        style.curves(memories, rows, "atoms", "memory")
        memories.set(xlabel="atoms", ylabel="memory of System and Context (MB)", xscale="log", yscale="log")
        style.shared_legend(picture, times)


main = command(ScaleSettings, study, __doc__, __name__)
