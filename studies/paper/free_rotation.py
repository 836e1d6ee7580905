"""Free rotation of a water molecule: when does the attitude become wrong? (van Zon and Schofield 2007, Sec. IV A)

The paper's measure is delta = <Tr[(A - A_ex)(A - A_ex)^T]/6>^(1/2) over a canonical ensemble, and tau, the time at
which the attitude is off by 10 %, is defined by delta = t/(10 tau). Here tau is t/(10 delta) at the last recorded time
at which delta has not passed 0.1. For MRDL and SEJ4 delta does grow linearly and tau is that time. With MRDL, however,
a body near the separatrix can end up on the wrong side of it and be far off at once: where delta is small, a few such
bodies dominate it, and a small ensemble says little. The median over bodies, also given, is not affected by them.

SIER is exact except for rounding. Rounding errors of A make the energy wander, and with it the phase, so delta grows
faster than t. The paper's linear law is then an extrapolation from the time at which delta is measured, here the length
of a run; the extrapolation by the fitted power law to delta = 0.1 is also given. The reference carries 34 digits.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from openmm_sier.dynamics import backend, operators, rotation
from openmm_sier.dynamics.backend.formulas import body_frame
from openmm_sier.dynamics.bodies import BodyState, RigidBodies
from openmm_sier.dynamics.stages import DRIFT, KICK
from openmm_sier.measure.statistics import jackknife
from studies.paper import reference, tip4p
from studies.paper.methods import FS, METHODS, Method, Progress

#: Deviation up to which delta is proportional to t for an inexact map.
MODERATE = 0.1


@dataclass(frozen=True)
class FreeRotationSettings:
    """Parameters of the experiment.

    Attributes:
        temperature: K.
        steps_fs: steps, fs.
        span: length of a run, ps. The paper takes 100 ps for the free flight of a molecule in a gas.
        bodies: in the ensemble of MRDL and SEJ4.
        exact_bodies: in the ensemble of SIER2 and SIER4, whose reference takes some 10 ms per body.
        marks_per_decade: times at which delta is recorded.
        timed_bodies, timings: numbers of bodies and of repetitions for the cost of a map.
        seed: of the initial states.
    """

    temperature: float = 297.0
    steps_fs: tuple[float, ...] = (1.66, 8.0)
    span: float = 100.0
    bodies: int = 8000
    exact_bodies: int = 100
    marks_per_decade: int = 3
    timed_bodies: int = 1000
    timings: int = 60
    seed: int = 1


QUICK = FreeRotationSettings(span=10.0, bodies=2000, exact_bodies=24, marks_per_decade=2, timings=20)


@dataclass(frozen=True)
class Curve:
    """Error of one method at one step.

    Attributes:
        method, step_fs: of the curve.
        times: ps.
        delta, delta_error: the paper's measure at these times, and its standard error.
        energy: rms over bodies of the deviation of the energy at the last time over the mean energy.
        tau, tau_error: by the linear law, ps.
        tau_median: the same with the median over bodies of the deviation in place of its rms, ps.
        exponent: of the growth of delta over the last decade of times up to `MODERATE`.
        tau_power: time at which the power law with that exponent reaches 10 %, ps.
    """

    method: str
    step_fs: float
    times: tuple[float, ...]
    delta: tuple[float, ...]
    delta_error: tuple[float, ...]
    energy: float
    tau: float
    tau_error: float
    tau_median: float
    exponent: float
    tau_power: float


@dataclass(frozen=True)
class Cost:
    """Time of a free-rotation map for one body and one step.

    Attributes:
        method, step_fs: of the map.
        nanoseconds: the least of many measurements.
        ratio: to that of MRDL.
        ratio_low, ratio_high: quartiles of the ratio in single rounds, in which all maps are timed.
    """

    method: str
    step_fs: float
    nanoseconds: float
    ratio: float
    ratio_low: float
    ratio_high: float


@dataclass(frozen=True)
class FreeRotation:
    """Results of the experiment."""

    settings: FreeRotationSettings
    moments: tuple[float, ...]
    curves: tuple[Curve, ...]
    costs: tuple[Cost, ...] = field(default=())


def rotate_freely(settings: FreeRotationSettings, progress: Progress = lambda what, fraction: None) -> FreeRotation:
    """Carry out the experiment."""
    runs = [(method, step) for step in settings.steps_fs for method in METHODS]
    work = np.array([method.forces * settings.span / step for method, step in runs])
    done = np.concatenate([[0.0], np.cumsum(work) / work.sum()])
    curves = []
    for (method, step), begin, end in zip(runs, done[:-1], done[1:], strict=True):
        what = f"free rotation: {method.name}, {step:g} fs"

        def report(fraction: float, what: str = what, begin: float = begin, end: float = end) -> None:
            progress(what, begin + fraction * (end - begin))

        curves.append(_curve(method, step, settings, report))
    progress("free rotation: cost of the maps", 1.0)
    moments = tuple(float(x) for x in tip4p.molecules(1).species[0].moments)
    return FreeRotation(settings, moments, tuple(curves), _costs(settings))


def _start(n: int, settings: FreeRotationSettings) -> tuple[RigidBodies, BodyState]:
    """Molecules with a canonical L~ whose axes lie along the lab's.

    Free motion has no preferred direction, and this attitude has no rounding error of its own.
    """
    bodies = tip4p.molecules(n)
    state = tip4p.canonical_rotation(bodies, settings.temperature, np.random.default_rng(settings.seed))
    axes = np.repeat(np.eye(3)[:, :, None], n, axis=2)
    return bodies, BodyState(state.q, state.p, axes, body_frame(state.A, state.L))


def _curve(method: Method, step_fs: float, settings: FreeRotationSettings, report: Callable[[float], None]) -> Curve:
    exact = method.rotation is rotation.exact
    bodies, start = _start(settings.exact_bodies if exact else settings.bodies, settings)
    h = step_fs * FS
    marks = _marks(round(settings.span / h), settings.marks_per_decade)
    flows = {KICK: lambda state, _: state, DRIFT: operators.drift(bodies, method.rotation)}
    step = operators.stepper(method.scheme, flows, h)
    judge = _squares_beyond_double if exact else _squares
    state, squares = start, []
    for count in range(1, marks[-1] + 1):
        state = step(state)
        if count in marks:
            squares.append(judge(state, start, bodies.species[0].moments, h, count))
        if count % 64 == 0:
            report(count / marks[-1])
    energies = [_energies(s, bodies) for s in (start, state)]
    return _summarize(method.name, step_fs, np.array(marks) * h, np.array(squares), energies)


def _marks(last: int, per_decade: int) -> list[int]:
    """Numbers of steps, evenly spaced in the logarithm, from 10 to the last."""
    number = max(2, round(per_decade * math.log10(last / 10)) + 1)
    return sorted({round(x) for x in np.geomspace(10, last, number)})


def _squares(state: BodyState, start: BodyState, moments: np.ndarray, h: float, count: int) -> np.ndarray:
    """The paper's squared deviation of each body, (n,)."""
    A, _ = rotation.exact(start.A, start.L, moments, h * count)
    return ((state.A - A) ** 2).sum(axis=(0, 1)) / 6


def _squares_beyond_double(state: BodyState, start: BodyState, moments: np.ndarray, h: float, count: int) -> np.ndarray:
    return reference.squared_deviations(state.A, start.L, moments, h, count)


def _energies(state: BodyState, bodies: RigidBodies) -> np.ndarray:
    return 0.5 * (body_frame(state.A, state.L) ** 2 * bodies.inverse_moments).sum(axis=0)


def _summarize(
    name: str, step_fs: float, times: np.ndarray, squares: np.ndarray, energies: Sequence[np.ndarray]
) -> Curve:
    n = squares.shape[1]
    delta, error = np.array([jackknife(_root_mean(row), n) for row in squares]).T
    moderate = np.flatnonzero(delta <= MODERATE)
    last = int(moderate[-1]) if moderate.size else 0
    tau, tau_error = jackknife(lambda kept: times[last] / (10 * math.sqrt(squares[last, kept].mean())), n)
    decade = moderate[times[moderate] >= 0.099 * times[last]]
    exponent = float(np.polyfit(np.log(times[decade]), np.log(delta[decade]), 1)[0]) if decade.size > 1 else math.nan
    before, after = energies
    return Curve(
        method=name,
        step_fs=step_fs,
        times=tuple(times.tolist()),
        delta=tuple(delta.tolist()),
        delta_error=tuple(error.tolist()),
        energy=float(np.sqrt(((after - before) ** 2).mean()) / before.mean()),
        tau=tau,
        tau_error=tau_error,
        tau_median=float(times[last] / (10 * np.sqrt(np.median(squares[last])))),
        exponent=exponent,
        tau_power=float(times[last] * (MODERATE / delta[last]) ** (1 / exponent)),
    )


def _root_mean(squares: np.ndarray) -> Callable[[np.ndarray], float]:
    return lambda kept: math.sqrt(squares[kept].mean())


def _costs(settings: FreeRotationSettings) -> tuple[Cost, ...]:
    """The three maps, all executed by NumPy, timed in turn, so that other work on the computer affects all alike."""
    maps = {"MRDL": rotation.mrdl, "SIER2": rotation.exact, "SEJ4": rotation.sej4}
    bodies, start = _start(settings.timed_bodies, settings)
    costs = []
    for step_fs in settings.steps_fs:
        with backend.using(backend.NUMPY):
            rounds = [
                [_seconds(rotation, start, bodies, step_fs * FS) for rotation in maps.values()]
                for _ in range(settings.timings)
            ]
        seconds = np.array(rounds)
        low, high = np.percentile(seconds / seconds[:, :1], (25, 75), axis=0)
        best = seconds.min(axis=0)
        middle, per_body = best / best[0], best / settings.timed_bodies * 1e9
        for i, name in enumerate(maps):
            costs.append(Cost(name, step_fs, float(per_body[i]), float(middle[i]), float(low[i]), float(high[i])))
    return tuple(costs)


def _seconds(rotation: Callable[..., Any], start: BodyState, bodies: RigidBodies, h: float) -> float:
    begin = time.perf_counter()
    rotation(start.A, start.L, bodies.species[0].moments, h)
    return time.perf_counter() - begin
