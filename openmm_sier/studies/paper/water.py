"""Liquid water: energy error against simulated time per force evaluation (van Zon and Schofield 2007, Fig. 1).

Every method runs from the same phase points, which are taken from a thermostatted run of the same system. Along each
run of 1 ps rms(H) and rms(V) are taken about the run's own means, and the figure shows the mean of the former over the
mean of the latter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import openmm

from openmm_sier.context.integrator import SIERIntegrator
from openmm_sier.dynamics.bodies import RigidityError
from openmm_sier.measure.observables import energy_drift, energy_fluctuation
from openmm_sier.measure.statistics import jackknife, rms
from openmm_sier.studies.paper import liquids, start
from openmm_sier.studies.paper.methods import FS, METHODS, Method, Progress

#: Beyond this rms(H)/rms(V) a method has broken down, and longer steps are not tried.
BROKEN = 1.0

#: Ranges of h/f in fs in which the order is read off: above, higher orders take part; below, SIER4 meets rounding. With
#: PME, whose forces of single precision leave an error of 0.005 %, no range is left to SIER4.
SLOPE_RANGES = {
    liquids.MOLECULAR: {"SIER2": (0.3, 2.5), "SIER4": (0.3, 1.2)},
    liquids.PME: {"SIER2": (0.3, 2.5)},
}


@dataclass(frozen=True)
class WaterSettings:
    """Parameters of the experiment.

    Attributes:
        molecules: number of them; `start.BOX_MOLECULES` come from the project's box.
        temperature: K.
        cutoffs: of both systems.
        kinds: which systems are run.
        force_steps_fs: h/f, fs, for SIER2 and SIER4.
        compared_from_fs: MRDL and SEJ4 run from this h/f on; below they cannot be told from SIER2.
        compared_to_fs: and up to this one.
        fine_below_fs: for h/f below this fewer runs are averaged, since they take long.
        span: length of a run, ps.
        runs, fine_runs: number of runs averaged.
        relax: time between the starts of two runs, ps.
        sample_fs: time between two evaluations of H, fs, or the step if that is longer.
        seed: of everything random.
    """

    molecules: int = 512
    temperature: float = 297.0
    cutoffs: liquids.Cutoffs = field(default_factory=liquids.Cutoffs)
    kinds: tuple[str, ...] = (liquids.MOLECULAR, liquids.PME)
    force_steps_fs: tuple[float, ...] = (0.1, 0.25, 0.5, 1.0, 1.4, 1.8, 2.2, 2.8, 3.5, 5.0, 7.0)
    compared_from_fs: float = 1.0
    compared_to_fs: float = 7.0
    fine_below_fs: float = 0.4
    span: float = 1.0
    runs: int = 9
    fine_runs: int = 3
    relax: float = 1.0
    sample_fs: float = 4.0
    seed: int = 1


#: Fewer molecules, so that a shorter cut-off fits in the box, and fewer and shorter runs.
QUICK = WaterSettings(
    molecules=216,
    cutoffs=liquids.Cutoffs(molecular_on=0.7, molecular_off=0.9, pme=0.9, pme_switch=0.7),
    force_steps_fs=(0.7, 1.0, 1.4, 2.0, 2.8),
    compared_from_fs=1.4,
    compared_to_fs=2.0,
    fine_below_fs=0.0,
    span=0.25,
    runs=2,
    relax=0.4,
)


@dataclass(frozen=True)
class Point:
    """One point of the figure.

    Attributes:
        kind, method, force_step_fs: which.
        energy, energy_error: mean rms(H) over mean rms(V), and its standard error over the runs.
        rms_H, rms_V: means over the runs, kJ/mol.
        drift: mean slope of H in a run, kJ/mol/ps.
        runs: number of runs.
    """

    kind: str
    method: str
    force_step_fs: float
    energy: float
    energy_error: float
    rms_H: float
    rms_V: float
    drift: float
    runs: int


@dataclass(frozen=True)
class Crossing:
    """Where SIER4 stops to be better than SIER2.

    Attributes:
        kind: of the system.
        force_step_fs, error: h/f in fs, and its standard error over the runs.
        slopes: of the curves in `SLOPE_RANGES`, the orders of their methods.
    """

    kind: str
    force_step_fs: float
    error: float
    slopes: dict[str, float]


@dataclass(frozen=True)
class Water:
    """Results of the experiment."""

    settings: WaterSettings
    box: str
    edge: float
    points: tuple[Point, ...]
    crossings: tuple[Crossing, ...]


def simulate_water(settings: WaterSettings, progress: Progress = lambda what, fraction: None) -> Water:
    """Carry out the experiment."""
    progress("liquid water: starting box", 0.0)
    box = start.water_box(settings.molecules, settings.cutoffs, settings.temperature, settings.seed)
    points, crossings = [], []
    for i, kind in enumerate(settings.kinds):

        def report(what: str, fraction: float, i: int = i, kind: str = kind) -> None:
            progress(f"liquid water, {kind}: {what}", (i + fraction) / len(settings.kinds))

        samples = _sample(box, kind, settings, report)
        points += [_point(kind, *key, np.array(values)) for key, values in samples.items()]
        crossings.append(_crossing(kind, samples))
    return Water(settings, box.origin, box.edge, tuple(points), tuple(crossings))


def _plan(settings: WaterSettings) -> list[tuple[Method, float, int]]:
    """The runs from each phase point: method, h/f, and the number of phase points."""
    plan = []
    for method in METHODS:
        compared = method.name in ("MRDL", "SEJ4")
        for step in settings.force_steps_fs:
            if compared and not settings.compared_from_fs <= step <= settings.compared_to_fs:
                continue
            plan.append((method, step, settings.fine_runs if step < settings.fine_below_fs else settings.runs))
    return plan


def _sample(
    box: start.Box, kind: str, settings: WaterSettings, report: Callable[[str, float], None]
) -> dict[tuple[str, float], list]:
    """For each method and h/f the list of (rms(H), rms(V), drift) of its runs."""
    plan = _plan(settings)
    total, done = sum(runs / step for _, step, runs in plan), 0.0
    samples: dict[tuple[str, float], list] = {(method.name, step): [] for method, step, _ in plan}
    contexts = {method.name: _context(box, kind, method, settings) for method in METHODS}
    points = start.phase_points(
        box, kind, settings.cutoffs, settings.temperature, settings.relax, settings.runs, settings.seed
    )
    report("relaxing", 0.0)
    broken: dict[str, float] = {}
    for i, point in enumerate(points):
        for method, step, runs in plan:
            if i >= runs:
                continue
            report(f"{method.name}, h/f = {step:g} fs, run {i + 1}", done)
            done += 1 / step / total
            if step > broken.get(method.name, np.inf):
                continue
            sample = _run(contexts[method.name], point, step * method.forces * FS, settings)
            if sample is None or sample[0] > BROKEN * sample[1]:
                broken[method.name] = step
            if sample is not None:
                samples[method.name, step].append(sample)
    return samples


def _context(box: start.Box, kind: str, method: Method, settings: WaterSettings) -> openmm.Context:
    system = liquids.build(kind, box.molecules, box.edge, settings.cutoffs)
    integrator = SIERIntegrator(FS, scheme=method.scheme, rotation=method.rotation)
    return liquids.context(system, integrator, kind)


def _run(
    context: openmm.Context, point: tuple[np.ndarray, np.ndarray], h: float, settings: WaterSettings
) -> tuple[float, float, float] | None:
    """rms(H), rms(V) and drift of one run, None if it did not get to its end."""
    integrator = context.getIntegrator()
    integrator.setStepSize(h)
    context.setPositions(point[0])
    context.setVelocities(point[1])
    stride = max(1, round(settings.sample_fs * FS / h))
    energies = []
    try:
        # One step before the first energy makes velocities those of rigid bodies to rounding.
        integrator.step(1)
        for i in range(max(3, round(settings.span / (stride * h)) + 1)):
            if i > 0:
                integrator.step(stride)
            kinetic, potential = liquids.energies(context)
            energies.append((kinetic + potential, potential))
    except (openmm.OpenMMException, RigidityError):
        return None
    H, V = np.array(energies).T
    if not np.isfinite(H).all():
        return None
    time = h * stride * np.arange(len(H))
    # The paper's H is about its mean.
    return energy_fluctuation(time, H, window=None), rms(V), energy_drift(time, H)[0]


def _ratio(samples: np.ndarray) -> float:
    return float(samples[:, 0].mean() / samples[:, 1].mean())


def _point(kind: str, method: str, step: float, samples: np.ndarray) -> Point:
    if not samples.size:
        nan = float("nan")
        return Point(kind, method, step, nan, nan, nan, nan, nan, 0)
    energy, error = jackknife(lambda kept: _ratio(samples[kept]), len(samples))
    rms_H, rms_V, drift = (float(x) for x in samples.mean(axis=0))
    return Point(kind, method, step, energy, error, rms_H, rms_V, drift, len(samples))


def _crossing(kind: str, samples: dict[tuple[str, float], list]) -> Crossing:
    runs = max(len(values) for values in samples.values())

    def crossing_of(kept: np.ndarray) -> float:
        curves = {name: _curve(samples, name, kept) for name in ("SIER2", "SIER4")}
        return _intersection(curves["SIER2"], curves["SIER4"])

    value, error = jackknife(crossing_of, runs)
    everything = np.arange(runs)
    slopes = {name: _slope(_curve(samples, name, everything), limits) for name, limits in SLOPE_RANGES[kind].items()}
    return Crossing(kind, value, error, slopes)


def _curve(samples: dict[tuple[str, float], list], method: str, kept: np.ndarray) -> dict[float, float]:
    """h/f to rms(H)/rms(V), from some of the runs; where there are few, from all of them."""
    curve = {}
    for (name, step), values in samples.items():
        if name == method and values:
            table = np.array(values)
            usable = kept[kept < len(table)]
            curve[step] = _ratio(table[usable] if usable.size else table)
    return curve


def _intersection(second: dict[float, float], fourth: dict[float, float]) -> float:
    """Where two curves cross for the last time, by interpolation in logarithms; NaN if they do not."""
    steps = sorted(set(second) & set(fourth))
    difference = np.array([np.log(fourth[s] / second[s]) for s in steps])
    changes = np.flatnonzero((difference[:-1] < 0) & (difference[1:] >= 0))
    if not changes.size:
        return float("nan")
    i = int(changes[-1])
    fraction = -difference[i] / (difference[i + 1] - difference[i])
    return float(np.exp(np.log(steps[i]) + fraction * np.log(steps[i + 1] / steps[i])))


def _slope(curve: dict[float, float], limits: tuple[float, float]) -> float:
    steps = np.array(sorted(s for s in curve if limits[0] <= s <= limits[1]))
    if steps.size < 2:
        return float("nan")
    return float(np.polyfit(np.log(steps), np.log([curve[s] for s in steps]), 1)[0])
