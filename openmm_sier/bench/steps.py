"""Cost of a step over that of its forces and over OpenMM's own integrators."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from itertools import cycle

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier import compiled, console
from openmm_sier.bench.timing import Settings, interleaved, summary
from openmm_sier.forcefields import load, pme_system, read_box
from openmm_sier.integrator import SIERIntegrator
from openmm_sier.preparation import make_context
from openmm_sier.schemes import SIER2, SIER4

#: Step per force evaluation of every method, ps.
STEP = 1e-3

BARE = "bare force"

#: Molecules times force evaluations in a turn, at least; some 40 ms.
WORK = 4096

#: Copies of the box along each edge below which there are more rounds than were asked for: turns are shorter there.
LONG_TURNS = 4

#: Positions that the bare forces go through, in turns: as many as let OpenMM's neighbour lists grow old.
FRAMES = 60


def measure(settings: Settings) -> list[dict]:
    """Rows of cost ratios for every size of box."""
    return [row for copies in settings.copies for row in _ratios(copies, settings)]


def _ratios(copies: int, settings: Settings) -> list[dict]:
    topology, positions, system = repeated_box(settings, copies)
    molecules = topology.getNumResidues()
    evaluations = 4 * math.ceil(WORK / molecules / 4)
    actions = _actions(system, positions, evaluations, settings)
    seconds = interleaved(actions, settings.rounds * max(1, LONG_TURNS // copies) ** 2)
    pairs = [(name, BARE) for name in actions if name != BARE] + [("SIER2", "OpenMM Verlet")]
    rows = []
    for name, base in pairs:
        median, spread = summary(seconds[name] / seconds[base])
        cost = 1e3 * float(np.median(seconds[name])) / evaluations
        row = {"name": f"{name} / {base}", "molecules": molecules, "median": median, "spread": spread}
        rows.append(row | {"milliseconds": cost})
        console.note(f"{molecules} molecules: {row['name']} = {median:.3f} ± {spread:.3f}")
    return rows


def _actions(system, positions, evaluations: int, settings: Settings) -> dict[str, Callable[[], None]]:
    """What takes turns: as many force evaluations each, bare or in the steps of an integrator."""
    start = _start(system, positions, settings)
    frames = cycle(_frames(system, start, max(evaluations, FRAMES), settings))
    bare = _context_at(system, openmm.VerletIntegrator(STEP), start, settings)

    def forces():
        for _ in range(evaluations):
            bare.setPositions(next(frames))
            bare.getState(forces=True)

    actions: dict[str, Callable[[], None]] = {BARE: forces}
    integrators = {
        "SIER2": SIERIntegrator(STEP, SIER2),
        "SIER4": SIERIntegrator(4 * STEP, SIER4),
        "OpenMM Verlet": openmm.VerletIntegrator(STEP),
        "OpenMM LangevinMiddle": openmm.LangevinMiddleIntegrator(297, 1, STEP),
    }
    for name, integrator in integrators.items():
        context = _context_at(system, integrator, start, settings)
        count = evaluations // 4 if name == "SIER4" else evaluations
        actions[name] = partial(_steps, context, count)
    if compiled.executor() is not None:
        context = _context_at(system, SIERIntegrator(STEP, SIER2), start, settings)
        actions["SIER2, NumPy"] = partial(_steps_by_numpy, context, evaluations)
    return actions


def _steps(context, count: int) -> None:
    context.getIntegrator().step(count)


def _steps_by_numpy(context, count: int) -> None:
    with compiled.disabled():
        _steps(context, count)


def repeated_box(settings: Settings, copies: int):
    """Topology, positions (N, 3) and System of a box repeated along each edge."""
    box = read_box(settings.box, settings.forcefield)
    lengths = np.array(box.positions.value_in_unit(unit.nanometer))
    vectors = np.array(box.topology.getPeriodicBoxVectors().value_in_unit(unit.nanometer))
    if copies == 1:
        return box.topology, lengths, box.system
    model = app.Modeller(box.topology, box.positions)
    shifts = np.stack(np.meshgrid(*[np.arange(copies)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) @ vectors
    for shift in shifts[1:]:
        model.add(box.topology, (lengths + shift) * unit.nanometer)
    model.topology.setPeriodicBoxVectors(copies * vectors * unit.nanometer)
    positions = (lengths + shifts[:, None]).reshape(-1, 3)
    return model.topology, positions, pme_system(model.topology, load(box.choice.files, settings.box.parent))


def _start(system, positions, settings: Settings):
    context = make_context(system, openmm.VerletIntegrator(STEP), settings.platform)
    context.setPositions(positions)
    context.applyConstraints(1e-6)
    context.setVelocitiesToTemperature(297, settings.seed)
    return context.getState(positions=True, velocities=True)


def _context_at(system, integrator, start, settings: Settings):
    context = make_context(system, integrator, settings.platform)
    context.setState(start)
    return context


def _frames(system, start, count: int, settings: Settings) -> list[np.ndarray]:
    """Positions of consecutive steps: forces at positions that do not move would be cheaper than in a simulation."""
    integrator = openmm.VerletIntegrator(STEP)
    context = _context_at(system, integrator, start, settings)
    frames = []
    for _ in range(count):
        integrator.step(1)
        state = context.getState(positions=True)
        frames.append(state.getPositions(asNumpy=True).value_in_unit(unit.nanometer).copy())
    return frames


def show(rows: list[dict]) -> None:
    """Print the table."""
    console.table(
        "Cost of a step, one force evaluation's worth of it",
        ["ratio", "molecules", "median", "± its standard error", "ms per force evaluation"],
        [
            [
                row["name"],
                str(row["molecules"]),
                f"{row['median']:.3f}",
                f"{row['spread']:.3f}",
                f"{row['milliseconds']:.3g}",
            ]
            for row in rows
        ],
    )
