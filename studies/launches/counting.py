"""Commands of one case, counted in a separate process.

    python -c "from studies.launches import counting; counting.main()" BOX METHOD PRECISION SEED

prints a row of JSON. `run` starts it, with OpenCL's runtime and the library that counts.
"""

from __future__ import annotations

import importlib
import json
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from openmm.openmm import _openmm

from studies.launches import cases, opencl
from studies.launches.shim import Commands, Shim

ROOT = Path(__file__).parents[2]

PROGRAM = "from studies.launches import counting; counting.main()"

#: Seconds after which a case counts as hanging.
LIMIT = 3000

#: Steps before those that are counted. The first trial of hybrid Monte Carlo is followed back, as no other is.
FIRST = 2

#: Calls of many steps.
LONG_CALLS = 3

#: Kernels of OpenMM by what they do: the first pattern that has the beginning of a name.
KINDS = {
    "sort of the mesh": r"findAtomGridIndex|computeRange|assignElements|computeBucket|copyDataToBuckets|sortBuckets",
    "mesh": r"gridSpread|finishSpread|VkFFT|reciprocal|gridInterpolate|gridEvaluate|addForces|addEnergy",
    "nonbonded": r"findBlock|computeSortKeys|sortBoxData|computeNonbonded|sortShortList",
    "bonded": r"computeBondedForces|compute\w*Bond",
    "sums of forces": r"clear|reduceForces|distribute|saveDistributed",
    "constraints, positions": r"apply\w+ToPositions|applyPositionDeltas",
    "constraints, velocities": r"apply\w+ToVelocities",
    "virtual sites": r"computeVirtualSites",
    "atoms": r"computePerDof|integrate|timeShift",
    "parts of steps": r"sier\w+",
    "noise": r"generateRandomNumbers",
    "centre of mass": r"calcCenterOfMass|removeCenterOfMass",
    "energies": r"computeKineticEnergy|compute(Float|Double)Sum|reduceEnergy|copy(Float|Double)Buffer",
}

#: All other kernels.
OTHERS = "others"

#: What is counted besides kernels by what they do. Bytes end in `_bytes`.
COUNTS = (
    "launches",
    *(f"{kind}{what}" for kind in ("copies", "reads", "writes") for what in ("", "_bytes")),
    *("blocking_reads", "blocking_writes", "waits"),
)

#: Commands by what tables call them. To map a buffer is to read it.
TRANSFERS = {"copy": "copies", "read": "reads", "map": "reads", "write": "writes"}


def kind_of(kernel: str) -> str:
    """Return the purpose of a kernel."""
    return next((kind for kind, pattern in KINDS.items() if re.match(pattern, kernel)), OTHERS)


def numbers(commands: Iterable[Commands]) -> Counter[str]:
    """Return the numbers of commands by `COUNTS`, and of kernels by purpose.

    A wait is whatever OpenMM waits for: blocking transfers too.
    """
    counts: Counter[str] = Counter()
    for each in commands:
        if each.kind == "kernel":
            counts["launches"] += each.number
            counts[kind_of(each.kernel)] += each.number
        if name := TRANSFERS.get(each.kind):
            counts[name] += each.number
            counts[f"{name}_bytes"] += each.bytes
            if each.is_blocking:
                counts[f"blocking_{name}"] += each.number
        if each.is_blocking:
            counts["waits"] += each.number
    return counts


def divided(
    one: Mapping[str, float], many: Mapping[str, float], steps: int
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the numbers for a step, and for a call without its steps.

    Args:
        one: numbers of a call of one step.
        many: numbers of a call of many.
        steps: how many.
    """
    names = sorted({*one, *many})
    step = {name: (many.get(name, 0) - one.get(name, 0)) / (steps - 1) for name in names}
    return step, {name: one.get(name, 0) - step[name] for name in names}


def measure(box: str, name: str, precision: str, seed: int) -> dict[str, Any]:
    """Return the numbers of a case for each step and call, with the time of Python in microseconds.

    For a call that is the time of one with a single step, for a step that of a call of many, divided. Of several calls
    the shortest time counts, which no other work on the machine has made longer.
    """
    case, shim = cases.CASES[name], Shim()
    context = cases.context(box, case.integrator, precision, seed)
    step = context.getIntegrator().step
    step(FIRST)
    if name.startswith("hmc"):
        # It reads velocities now and then, where a trial reads none.
        context.getIntegrator().impl.session.watch.look = lambda *_: None

    into_cpp: list[tuple[Any, str]] = [(_openmm, f"{case.kind}_step")]
    if name in cases.WITH_KERNELS:
        into_cpp.append((importlib.import_module("openmm_sier_kernels").Library, "run"))

    def calls(steps: int, number: int) -> tuple[dict[str, float], float]:
        times: list[float] = []

        def make() -> None:
            for _ in range(number):
                times.append(shim.python_time(partial(step, steps), into_cpp))

        counts = numbers(shim.counted(make))
        return {name: count / number for name, count in counts.items()}, 1e6 * min(times)

    (one, of_one), (many, of_many) = calls(1, case.calls), calls(case.steps, LONG_CALLS)
    per_step, per_call = divided(one, many, case.steps)
    return {"step": per_step | {"python": of_many / case.steps}, "call": per_call | {"python": of_one}}


def run(box: str, name: str, precision: str, seed: int, library: Path) -> dict[str, Any]:
    """Count a case in a process of its own.

    Args:
        box, name, precision, seed: see `cases.context`.
        library: the compiled one.

    Raises:
        OSError: the process failed, such as where OpenCL finds no device.
    """
    return in_process(PROGRAM, [box, name, precision, str(seed)], library)


def in_process(program: str, arguments: Sequence[str], library: Path) -> dict[str, Any]:
    """Return the row of JSON that a program in Python prints, with OpenCL's runtime and the library that counts.

    Raises:
        OSError: it failed.
    """
    environment = opencl.environment() | {"LD_PRELOAD": str(library), "OPENMM_CPU_THREADS": "1"}
    command = [sys.executable, "-c", program, *arguments]
    process = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=LIMIT, check=False
    )
    if process.returncode:
        raise OSError(f"the case {' '.join(arguments)} failed: {process.stderr.strip()[-2000:]}")
    return json.loads(process.stdout.splitlines()[-1])


def main() -> None:
    box, name, precision, seed = sys.argv[1:]
    print(json.dumps(measure(box, name, precision, int(seed))))
