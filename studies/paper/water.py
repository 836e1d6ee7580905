"""Liquid water: energy error against simulated time per force evaluation (van Zon and Schofield 2007, Fig. 1).

Every method runs from the same phase points, which are taken from a thermostatted run of the same system. Along each
run of 1 ps rms(H) and rms(V) are taken about the run's own means, and the figure shows the mean of the former over the
mean of the latter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from openmm_sier.measure.statistics import jackknife
from studies.paper import liquids
from studies.paper.methods import METHODS
from studies.paper.water_runs import PhasePoint, Run, WaterSettings

#: Ranges of h/f in fs in which the order is read off. Above, higher orders contribute; below, rounding limits SIER4.
#: With PME, whose single-precision forces leave an error of 0.005 %, no range is left for SIER4.
SLOPE_RANGES = {
    liquids.MOLECULAR: {"SIER2": (0.3, 2.5), "SIER4": (0.3, 1.2)},
    liquids.PME: {"SIER2": (0.3, 2.5)},
}


@dataclass(frozen=True)
class Point:
    """One point of the figure.

    Attributes:
        kind, method, force_step_fs: of the point.
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
    """Where SIER4 stops being better than SIER2.

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


def result_of(settings: WaterSettings, origin: str, edge: float, runs: Mapping[str, Sequence[Run]]) -> Water:
    """The result of the experiment.

    Args:
        settings: of the experiment.
        origin: of the box.
        edge: of the box, nm.
        runs: from all phase points, by the kind of the liquid.
    """
    points, crossings = [], []
    for kind, made in runs.items():
        samples = samples_of(settings, kind, made)
        points += [_point(kind, *key, np.array(values)) for key, values in samples.items()]
        crossings.append(_crossing(kind, samples))
    return Water(settings, origin, edge, tuple(points), tuple(crossings))


def samples_of(settings: WaterSettings, kind: str, runs: Sequence[Run]) -> dict[tuple[str, float], list]:
    """For each method and h/f the list of (rms(H), rms(V), drift) of the runs that finished."""
    first = PhasePoint(kind, 1)
    samples: dict[tuple[str, float], list] = {
        (method.name, step): [] for method in METHODS for step in settings.steps_of(method, first)
    }
    for run in runs:
        if run.found is not None:
            samples[run.method, run.force_step_fs].append(run.found)
    return samples


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
    """h/f to rms(H)/rms(V), from the runs `kept`; from all runs where none of these exist."""
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
