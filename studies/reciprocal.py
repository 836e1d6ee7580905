"""Measure what it saves to compute the reciprocal sum of PME every second step, in boxes of rigid water.

    OPENMM_CPU_THREADS=1 python -m studies.reciprocal

Force evaluations with and without the reciprocal sum, and steps of integrators with and without the device, take turns
in processor time. Sums are balanced as `prepare_system` leaves them, and hydrogens are heavy. SIER2 is a program for
OpenMM's CustomIntegrator here, which has the reciprocal sum in each step or, as an impulse, in every second one. The
same program at 4 fs stands for LangevinMiddle with the device, beside MTSLangevin, OpenMM's own integrator with it.
Ratios are medians over rounds. What averages become is measured by `studies.heat_bath`. Writes reciprocal.json.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import openmm
import pandas as pd

from openmm_sier.inputs import forcefields
from openmm_sier.inputs.starts import make_context
from studies import boxes, text
from studies.bench.timing import interleaved, median_and_error
from studies.command import SYSTEMS, Settings, command
from studies.contestants import (
    RECIPROCAL,
    SEVERAL_STEPS_OF_RECIPROCAL,
    WITH_IMPULSES,
    Bath,
    Contestant,
    middle,
    own,
    with_impulses,
)
from studies.records import Record
from studies.report import SILENT, Report

#: Of each box, K and 1/ps.
BATH = Bath(297.0, 5.0)

#: What is compared, and for each method with the device what it is compared with.
REFERENCE = "LangevinMiddle, 4 fs"
PLAIN = replace(WITH_IMPULSES, method="the program of SIER2", make=partial(with_impulses, every=1), detail="")
IMPULSES = replace(WITH_IMPULSES, method=PLAIN.method)
MIDDLE = Contestant("LangevinMiddle", 4, middle, hydrogens=4.0, prepared=True)
MIDDLE_IMPULSES = replace(IMPULSES, step=4, detail="reciprocal sum every 8 fs")
WITHOUT = {IMPULSES: PLAIN, MIDDLE_IMPULSES: MIDDLE, SEVERAL_STEPS_OF_RECIPROCAL: MIDDLE}
METHODS = (MIDDLE, own(9), PLAIN, *WITHOUT)

COLUMNS = {
    "box": "{box}",
    "molecules": "{molecules}",
    "tolerance": "{tolerance:g}",
    "method": "{name}",
    "ms a force": "{milliseconds:.2f}",
    "over that without": "{gain_text}",
    f"over {REFERENCE}": "{over_text}",
}
SHARES = {
    "box": "{box}",
    "molecules": "{molecules}",
    "tolerance": "{tolerance:g}",
    "ms a force": "{milliseconds:.2f}",
    "of it the reciprocal sum": "{share:.3f} ± {share_error:.3f}",
}


@dataclass(frozen=True)
class ReciprocalSettings(Settings):
    """Settings of the timings.

    Attributes:
        box: PDB files of rigid water that name their force fields.
        copies: of each box, along each edge.
        tolerance: OpenMM's ewaldErrorTolerance.
        rounds: of turns, for one copy; larger boxes have fewer, so that all take as long.
        steps: of a turn.
    """

    box: tuple[Path, ...] = (SYSTEMS / "tip3p-512.pdb", SYSTEMS / "tip4p2005-512.pdb")
    copies: tuple[int, ...] = (1, 2)
    tolerance: tuple[float, ...] = (1e-4, 5e-4)
    rounds: int = 60
    steps: int = 6


def study(settings: ReciprocalSettings, report: Report = SILENT) -> Record:
    """Measure, and write reciprocal.json."""
    shares, rows = [], []
    for path, copies, tolerance in product(settings.box, settings.copies, settings.tolerance):
        box = boxes.repeated(forcefields.read_box(path), path.parent, (copies,) * 3)
        boxes.with_tolerance(box.system, tolerance)
        place = {"box": path.stem, "molecules": box.molecules, "tolerance": tolerance}
        contexts = {method: _context(box, method, settings.seed) for method in METHODS}
        rounds = max(5, settings.rounds // copies**3)
        share = place | share_of_forces(contexts[IMPULSES], settings.steps, rounds)
        report.note(text.cell("{box}, {molecules} molecules, {tolerance:g}: {share:.3f} of a force", share))
        shares.append(share)
        rows += [place | row for row in speeds(contexts, settings.steps, rounds)]
    tables = {"shares": pd.DataFrame(shares), "speeds": pd.DataFrame(rows)}
    report.table("The reciprocal sum in a force", text.table(tables["shares"], SHARES))
    report.table("Speed by processor time", text.table(tables["speeds"], COLUMNS))
    return Record(settings.recorded(), tables, {}).write(settings.out / "reciprocal.json")


def _context(box: boxes.Replica, method: Contestant, seed: int) -> openmm.Context:
    """Return a Context on the CPU platform with a System of its own, at the positions of the box."""
    system = openmm.XmlSerializer.clone(box.system)
    method.fit(system)
    integrator = method.integrator(BATH)
    integrator.setRandomNumberSeed(seed)
    context = make_context(system, integrator, "CPU")
    context.setPositions(box.positions)
    context.computeVirtualSites()
    context.setVelocitiesToTemperature(BATH.temperature, seed)
    return context


def share_of_forces(context: openmm.Context, steps: int, rounds: int) -> dict[str, float]:
    """Return ms of a force evaluation, along a trajectory, and the share of the reciprocal sum with its error."""
    frames = [_frame(context) for _ in range(steps)]
    alone = openmm.Context(context.getSystem(), openmm.VerletIntegrator(0.001), context.getPlatform())

    def evaluate(groups: int) -> None:
        for frame in frames:
            alone.setPositions(frame)
            alone.getState(forces=True, groups=groups)

    everything = (1 << 32) - 1
    actions = {"all": everything, "without": everything & ~(1 << RECIPROCAL)}
    seconds = interleaved({name: partial(evaluate, groups) for name, groups in actions.items()}, rounds, process_time)
    share = median_and_error(1 - seconds["without"] / seconds["all"])
    return {
        "milliseconds": 1e3 * float(np.median(seconds["all"])) / steps,
        "share": share.value,
        "share_error": share.error,
    }


def _frame(context: openmm.Context) -> Any:
    context.getIntegrator().step(1)
    return context.getState(positions=True).getPositions(asNumpy=True)


def speeds(contexts: dict[Contestant, openmm.Context], steps: int, rounds: int) -> Iterator[dict[str, Any]]:
    """A row for each method: ms of processor time for a force, and ratios of simulated time in equal processor time."""
    actions: dict[str, Callable[[], object]] = {
        method.name: partial(context.getIntegrator().step, steps // method.forces)
        for method, context in contexts.items()
    }
    seconds = interleaved(actions, rounds, process_time)
    speed = {method.name: steps // method.forces * method.step / seconds[method.name] for method in contexts}
    for method in contexts:
        row: dict[str, Any] = {
            "name": method.name,
            "milliseconds": 1e3 * float(np.median(seconds[method.name])) / steps,
        }
        ratios = {"over": REFERENCE}
        if method in WITHOUT:
            ratios["gain"] = WITHOUT[method].name
        for key, other in ratios.items():
            found = median_and_error(speed[method.name] / speed[other])
            row |= {key: found.value, f"{key}_error": found.error}
        yield row


main = command(ReciprocalSettings, study, __doc__, __name__)
