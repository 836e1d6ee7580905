"""Time of the host in a step, outside of OpenMM's forces and of OpenCL, by the size of the box.

    python -m studies.launches.host [--boxes tip3p-64] [--methods sier2-kernels]

The library of `studies.launches` stands between OpenMM and OpenCL, and forgets all commands after the first steps. The
host goes on as it does in any step: it makes every call, and waits for nothing. Its time is that of OpenMM's function
that makes steps, without its calls of OpenCL, of forces, and of what OpenMM itself does before steps. The median over
many calls leaves out the steps in which OpenMM puts atoms into another order. Also measured is the time of steps that
are executed, on cores that execute the kernels too, so that the caches of the host are empty after each force. Writes
host.json.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from studies import records, text
from studies.command import RunsSettings, chosen, command
from studies.launches import cases, counting, shim
from studies.records import Record, Task
from studies.report import SILENT, Report

PROGRAM = "from studies.launches import host; host.measure_case()"

#: Sizes of water, and a peptide in water; two engines and OpenMM's own integrator.
BOXES = ("tip3p-64", "tip3p-512", "tip3p-32768", "peptide")
METHODS = ("langevinmiddle", "sier2", "sier2-kernels")

#: Steps in a call, and numbers of calls without commands and with them.
STEPS, DROPPED_CALLS, CALLS = 10, 500, 3

#: Length of steps, ps.
STEP = 1e-4

#: Columns for a terminal.
COLUMNS = {
    "box": "{box}",
    "atoms": "{atoms}",
    "method": "{method}",
    "host/us": "{host:.1f}",
    "quarters/us": "{host_low:.1f} to {host_high:.1f}",
    "on busy cores/us": "{busy:.1f}",
}


@dataclass(frozen=True, kw_only=True)
class HostSettings(RunsSettings):
    """What is measured.

    Attributes:
        boxes: names of files in `systems`, or tip3p-N, N molecules of water.
        methods: by name, as in `studies.launches`; without compiled kernels those that do not need them.
        out: for the compiled library and what was measured too.
    """

    boxes: tuple[str, ...] = BOXES
    methods: tuple[str, ...] = ()
    out: Path = Path("host")

    SHARED: ClassVar[tuple[str, ...]] = ("seed",)


def tasks(settings: HostSettings) -> Iterator[Task]:
    """Yield a task for each case.

    Raises:
        ValueError: a method is unknown.
    """
    methods = settings.methods or tuple(name for name in METHODS if name in cases.usual())
    chosen(methods, dict.fromkeys(METHODS), "method")
    for box, name in product(settings.boxes, methods):
        yield Task(settings, {"box": box, "name": name})


def run(task: Task) -> dict[str, Any]:
    """Return the point of a case with its times."""
    point, settings = task.point, task.settings
    library = settings.out.resolve() / shim.LIBRARY
    return point | counting.in_process(PROGRAM, [point["box"], point["name"], str(settings.seed)], library)


def measure_case() -> None:
    """Print the times of a case in a row of JSON."""
    box, name, seed = sys.argv[1:]
    print(json.dumps(measure(box, name, int(seed))), flush=True)
    # What OpenMM frees at the end it would send commands for.
    os._exit(0)


def measure(box: str, name: str, seed: int) -> dict[str, Any]:
    """Return the number of atoms and times of a step in microseconds: medians, and quartiles of the first one."""
    integrator, library = cases.CASES[name].integrator, shim.Shim()
    context = cases.context(box, integrator, "mixed", seed)
    # The host does the same in a step of any length, and water on a lattice is far from equilibrium.
    context.getIntegrator().setStepSize(STEP)
    step = context.getIntegrator().step
    step(counting.FIRST)

    def times(calls: int) -> list[float]:
        return [1e6 * library.host_time(partial(step, STEPS)) / STEPS for _ in range(calls)]

    busy = times(CALLS)
    library.drop_commands()
    low, middle, high = np.quantile(times(DROPPED_CALLS), (0.25, 0.5, 0.75))
    atoms = context.getSystem().getNumParticles()
    of_step = {"host": middle, "host_low": low, "host_high": high, "busy": float(np.median(busy))}
    return {"atoms": atoms, "method": integrator.name} | {key: round(each, 2) for key, each in of_step.items()}


def study(settings: HostSettings, report: Report = SILENT) -> Record:
    """Measure what `out` lacks, and write host.json."""
    points = list(tasks(settings))
    shim.build(settings.out)
    runs = records.all_runs(settings, "host", points, run, report, "{box}, {name}")
    report.table("For each step", text.table(runs, COLUMNS))
    return Record(settings.recorded(), {"rows": runs.drop(columns="name")}, {}).write(settings.out / "host.json")


main = command(HostSettings, study, __doc__, __name__)
