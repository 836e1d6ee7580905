"""Energy error against cost: OpenMM's Verlet, the schemes of the catalogue, and other programs where installed."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import openmm

from openmm_sier.measure import sampling
from openmm_sier.measure.forcefields import read_box
from openmm_sier.measure.observables import energy_error
from openmm_sier.measure.report import Report, Table
from openmm_sier.measure.starts import equilibrated, make_context
from openmm_sier.system.find_bodies import RigidBodies
from studies import schemes
from studies.bench import peers
from studies.bench.timing import BenchSettings

#: fs per force evaluation: of methods of second order, and of those of fourth.
SECOND_ORDER = (0.25, 0.5, 1.0, 2.0)
FOURTH_ORDER = (0.75, 1.0, 1.5, 2.0, 2.5)
METHODS = {"verlet": SECOND_ORDER, "sier2": SECOND_ORDER, "sier4": FOURTH_ORDER, "sier4g": FOURTH_ORDER}
METHODS["sier4p"] = FOURTH_ORDER

#: Steps of a run that is timed before the one that is measured, so that lists and meshes are set up.
WARM_UP = 10

#: Values of rms(H)/rms(V) at which costs are compared; 0.003 % is the floor of forces in single precision.
LEVELS = (2e-4, 5e-4, 1e-3)


@dataclass(frozen=True)
class Point:
    """One method at one step.

    Attributes:
        method: name.
        fs_per_force: simulated time per force evaluation.
        error: rms(H)/rms(V), see `openmm_sier.measure.observables.energy_error`; NaN where the method broke down.
        fs_per_second: simulated time per wall time.
    """

    method: str
    fs_per_force: float
    error: float
    fs_per_second: float


def compare_accuracy(settings: BenchSettings, report: Report) -> list[Point]:
    """All methods at all their steps, from one equilibrated start."""
    box = read_box(settings.box, settings.forcefield)
    bodies = RigidBodies.from_system(box.system, box.topology)
    start = equilibrated(box, settings.temperature, settings.seed, settings.equilibrate, settings.platform, report)
    points = []

    def add(name: str, dt: float, run: Callable[[], Point]) -> None:
        try:
            points.append(run())
            report.note(f"{name} at {dt:g} fs per force: {100 * points[-1].error:.4f} %")
        except (sampling.Unstable, openmm.OpenMMException, peers.PeerError) as error:
            points.append(Point(name, dt, math.nan, math.nan))
            report.note(f"{name} at {dt:g} fs per force: {error}")

    known = schemes.known()
    for name, steps in METHODS.items():
        method = known[name][0]
        for dt in steps:
            add(method.name, dt, partial(of_openmm, method, dt, box.system, bodies, start, settings))
    for peer, liquid in _peers(box.system, start, report):
        for dt in SECOND_ORDER:
            add(peer.name, dt, partial(_of_peer, peer, liquid, dt, settings))
    return points


def _peers(system: openmm.System, start: openmm.State, report: Report) -> Iterator[tuple[peers.Peer, peers.Liquid]]:
    """The programs that are installed, each with the liquid."""
    found = peers.installed()
    if not found:
        report.note("no other program: neither lmp nor gmx is on the PATH")
        return
    liquid = peers.liquid_of(system, start)
    if liquid is None:
        report.note("no other program: they are compared at three-site water alone")
        return
    for peer in found:
        yield peer, liquid


def _every(step: float) -> int:
    return max(1, round(schemes.INTERVAL / step))


def of_openmm(
    method: sampling.Method,
    dt: float,
    system: openmm.System,
    bodies: RigidBodies,
    start: openmm.State,
    settings: BenchSettings,
) -> Point:
    """The energy error and speed of an integrator of OpenMM or ours at a step of so many fs per force."""
    step = dt * method.force_evaluations
    integrator = method.make(1e-3 * step)
    integrator.setConstraintTolerance(sampling.CONSTRAINT_TOLERANCE)
    context = make_context(system, integrator, settings.platform)
    context.setState(start)
    integrator.step(WARM_UP)
    context.setState(start)
    steps = max(1, round(1e3 * settings.time / step))
    begun = time.perf_counter()
    series = sampling.sample(context, bodies, steps, min(steps, _every(step)))
    seconds = time.perf_counter() - begun
    return Point(method.name, dt, energy_error(series.time, series.total, series.potential), steps * step / seconds)


def _of_peer(peer: peers.Peer, liquid: peers.Liquid, dt: float, settings: BenchSettings) -> Point:
    steps = max(1, round(1e3 * settings.time / dt))
    with tempfile.TemporaryDirectory() as directory:
        energies, seconds = peer.simulate(liquid, dt, steps, min(steps, _every(dt)), Path(directory))
    return Point(peer.name, dt, energy_error(energies.time, energies.total, energies.potential), steps * dt / seconds)


def step_at(points: list[Point], method: str, level: float) -> float:
    """fs per force evaluation at which a method reaches an error; NaN where its points do not enclose it.

    Between two points the error is taken as a power of the step. The longest such step is returned.
    """
    mine = sorted((p.fs_per_force, p.error) for p in points if p.method == method and not math.isnan(p.error))
    for (h1, e1), (h2, e2) in reversed(list(pairwise(mine))):
        if e1 <= level < e2:
            return h1 * (h2 / h1) ** (math.log(level / e1) / math.log(e2 / e1))
    return math.nan


def summary(points: list[Point], level: float) -> dict[str, dict[str, float]]:
    """For each method the step, forces per ps and speed at a given error."""
    found = {}
    for name in dict.fromkeys(point.method for point in points):
        dt = step_at(points, name, level)
        mine = [p for p in points if p.method == name and p.fs_per_second > 0]
        speed = float(np.median([p.fs_per_second / p.fs_per_force for p in mine])) if mine else math.nan
        found[name] = {"fs_per_force": dt, "forces_per_ps": 1000 / dt, "fs_per_second": dt * speed}
    return found


def record(points: list[Point]) -> dict:
    """The measured points and what follows from them, for JSON."""
    levels = [{"level": level, "methods": summary(points, level)} for level in LEVELS]
    return {"points": [asdict(point) for point in points], "levels": levels}


def tables(points: list[Point]) -> list[Table]:
    """Errors and costs, for the report."""

    def cell(value: float, digits: int) -> str:
        return "-" if math.isnan(value) else f"{value:.{digits}f}"

    errors = Table(
        "Energy error and speed",
        ["method", "fs per force", "rms(H)/rms(V)/%", "simulated fs per second"],
        [[p.method, f"{p.fs_per_force:g}", cell(100 * p.error, 4), cell(p.fs_per_second, 0)] for p in points],
    )
    costs = Table(
        "Cost of an accuracy; - where the steps do not enclose it",
        ["rms(H)/rms(V)/%", "method", "fs per force", "forces per ps", "simulated fs per second"],
        [
            [
                f"{100 * level:g}",
                name,
                cell(row["fs_per_force"], 2),
                cell(row["forces_per_ps"], 0),
                cell(row["fs_per_second"], 0),
            ]
            for level in LEVELS
            for name, row in summary(points, level).items()
        ],
    )
    return [errors, costs]


def notes(points: list[Point]) -> list[str]:
    """How the other programs that took part differ."""
    return [
        f"{name}: {difference}"
        for name, difference in peers.DIFFERENCES.items()
        if any(point.method.startswith(name) for point in points)
    ]
