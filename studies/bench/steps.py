"""Cost of a step over that of its forces and over OpenMM's own integrators."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from functools import partial
from itertools import cycle
from typing import Any

import numpy as np
import openmm
import pandas as pd
from openmm import unit

from openmm_sier.dynamics import backend
from openmm_sier.dynamics.schemes import SIER2, SIER4
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.measure.force_clock import ForceClock
from openmm_sier.measure.starts import make_context
from studies import boxes, records
from studies.bench.timing import BenchSettings, apart, interleaved, median_and_error
from studies.report import Report, Table

#: Step per force evaluation of every method, ps.
STEP = 1e-3

BARE, NUMPY = "bare force", "SIER2, NumPy"

#: Force evaluations in a turn, a multiple of SIER4's. OpenMM's `Simulation` asks for ten steps at a time.
EVALUATIONS = 12

#: Number of molecules with which there are as many rounds as requested. Smaller boxes, whose turns are shorter, have
#: more and larger ones fewer, within these factors.
USUAL_SIZE = 4096
LEAST, MOST = 1 / 3, 8

#: Fewest turns in which steps are compared with the force calls in them.
FEWEST = 3

#: Number of positions through which the bare forces cycle, enough for OpenMM's neighbour lists to grow old.
FRAMES = 60


COLUMNS = {
    "ratio": "{name}",
    "molecules": "{molecules}",
    "median": "{median:.3f}",
    "± its standard error": "{median_error:.3f}",
    "ms per force evaluation": "{milliseconds:.3g}",
}


def find(settings: BenchSettings, report: Report) -> dict[str, pd.DataFrame]:
    """Rows of cost ratios for every size of box."""
    rows = [row for copies in settings.copies for row in _ratios(copies, settings, report)]
    return {"steps": pd.DataFrame(rows)}


def tables(found: Mapping[str, pd.DataFrame]) -> list[Table]:
    """The costs, for the report."""
    return [records.table("Cost of a step, one force evaluation's worth of it", found["steps"], COLUMNS)]


def _ratios(copies: int, settings: BenchSettings, report: Report) -> list[dict[str, Any]]:
    molecules, positions, system = boxes.repeated(boxes.read(settings), settings.box.parent, (copies, copies, copies))
    start = _start(system, positions, settings)
    contexts = _contexts(system, start, settings)
    actions: dict[str, Callable[[], object]] = {BARE: _bare_force(system, start, settings)}
    actions |= {name: partial(_steps, name, context) for name, context in contexts.items()}
    rounds = max(1, round(settings.rounds * min(max(USUAL_SIZE / molecules, LEAST), MOST)))
    seconds = interleaved(actions, rounds)
    pairs = [(name, BARE) for name in contexts] + [("SIER2", "OpenMM Verlet")]
    ratios = {f"{name} / {base}": (seconds[name] / seconds[base], seconds[name]) for name, base in pairs}
    for name in (name for name in ("SIER2", NUMPY) if name in contexts):
        # This is the sharper measure, since changes of the machine's speed affect both alike.
        ratios[f"{name} / the force calls in it"] = _over_own_force(name, contexts[name], max(FEWEST, rounds // 4))
    rows: list[dict[str, Any]] = []
    for name, (values, times) in ratios.items():
        median, error, _ = median_and_error(values)
        milliseconds = 1e3 * float(np.median(times)) / EVALUATIONS
        row = {"name": name, "molecules": molecules, "median": median, "median_error": error}
        rows.append(row | {"milliseconds": milliseconds})
        report.note(records.cell("{molecules} molecules: {name} = {median:.3f} ± {median_error:.3f}", row))
    return rows


def _bare_force(system: openmm.System, start: openmm.State, settings: BenchSettings) -> Callable[[], None]:
    frames = cycle(_frames(system, start, settings))
    context = _context_at(system, openmm.VerletIntegrator(STEP), start, settings)

    def action() -> None:
        for _ in range(EVALUATIONS):
            context.setPositions(next(frames))
            context.getState(forces=True)

    return action


def _contexts(system: openmm.System, start: openmm.State, settings: BenchSettings) -> dict[str, openmm.Context]:
    integrators = {
        "SIER2": SIERIntegrator(STEP, SIER2),
        "SIER4": SIERIntegrator(4 * STEP, SIER4),
        "OpenMM Verlet": openmm.VerletIntegrator(STEP),
        "OpenMM LangevinMiddle": openmm.LangevinMiddleIntegrator(297, 1, STEP),
    }
    if backend.active() is not backend.NUMPY:
        integrators[NUMPY] = SIERIntegrator(STEP, SIER2)
    return {name: _context_at(system, integrator, start, settings) for name, integrator in integrators.items()}


def _steps(name: str, context: openmm.Context) -> None:
    """A turn: as many steps as take `EVALUATIONS` forces."""
    with backend.using(backend.NUMPY) if name == NUMPY else nullcontext():
        context.getIntegrator().step(EVALUATIONS // 4 if name == "SIER4" else EVALUATIONS)


def _over_own_force(name: str, context: openmm.Context, turns: int) -> tuple[np.ndarray, np.ndarray]:
    """Time of each turn over that of its OpenMM calls for positions and forces, and its time in seconds."""
    clock = ForceClock(context)
    outside, inside = np.array([apart(clock, partial(_steps, name, context)) for _ in range(turns)]).T
    return 1 + outside / inside, outside + inside


def _start(system: openmm.System, positions: np.ndarray, settings: BenchSettings) -> openmm.State:
    context = make_context(system, openmm.VerletIntegrator(STEP), settings.platform)
    context.setPositions(positions)
    context.applyConstraints(1e-6)
    context.setVelocitiesToTemperature(297, settings.seed)
    return context.getState(positions=True, velocities=True)


def _context_at(
    system: openmm.System, integrator: openmm.Integrator, start: openmm.State, settings: BenchSettings
) -> openmm.Context:
    context = make_context(system, integrator, settings.platform)
    context.setState(start)
    return context


def _frames(system: openmm.System, start: openmm.State, settings: BenchSettings) -> list[np.ndarray]:
    """Positions of consecutive steps: forces at positions that do not move would be cheaper than in a simulation."""
    integrator = openmm.VerletIntegrator(STEP)
    context = _context_at(system, integrator, start, settings)
    frames = []
    for _ in range(FRAMES):
        integrator.step(1)
        state = context.getState(positions=True)
        frames.append(state.getPositions(asNumpy=True).value_in_unit(unit.nanometer).copy())
    return frames
