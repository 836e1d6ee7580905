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
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pandas as pd

from openmm_sier.analysis.statistics import Estimate, jackknife
from openmm_sier.dynamics import operators, rotation
from openmm_sier.dynamics.bodies import BodySet, BodyState
from openmm_sier.dynamics.plan import Drift, Kick
from openmm_sier.dynamics.vectors import body_frame
from studies import text
from studies.methods import PAPER, OwnMethod
from studies.paper import published, reference, tip4p
from studies.paper.published import FS
from studies.records import Record
from studies.report import SILENT, Report

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
        seed: of the initial states.
    """

    temperature: float = 297.0
    steps_fs: tuple[float, ...] = (1.66, 8.0)
    span: float = 100.0
    bodies: int = 8000
    exact_bodies: int = 100
    marks_per_decade: int = 3
    seed: int = 1


QUICK = FreeRotationSettings(span=10.0, bodies=2000, exact_bodies=24, marks_per_decade=2)


TAUS = {
    "h (fs)": "{step_fs:g}",
    "method": "{method}",
    "paper": "{paper}",
    "tau": "{ours}",
    "ratio": "{ratio}",
    "median body": "{median}",
    "power of t": "{exponent:.2f}",
    "10 % by that power": "{power}",
    "dE/E (%)": "{energy:.1e}",
}


def find(settings: FreeRotationSettings, report: Report = SILENT) -> Record:
    """Carry out the experiment.

    Returns:
        `curves`: for each method and step the paper's measure `delta` with its standard error, at times in ps.
        `taus`: `tau` by the linear law with its standard error and `tau_median`, the same with the median over bodies
        in place of the rms; `exponent`, that of the growth of delta over the last decade of times up to `MODERATE`, and
        `tau_power`, the time at which the power law with it reaches 10 %, all times in ps; and `energy`, the rms over
        bodies of the deviation of the energy at the last time over the mean energy, in per cent.
    """
    runs = [(method, step) for step in settings.steps_fs for method in PAPER]
    curves, taus = [], []
    with report.progress("free rotation", len(runs)) as advance:
        for number, (method, step) in enumerate(runs):
            advance(number, f"free rotation: {method.name}, {step:g} fs")
            curve, tau = _curve(method, step, settings)
            curves.append(curve)
            taus.append({"method": method.name, "step_fs": step} | tau)
        advance(len(runs))
    return Record(asdict(settings), {"curves": pd.concat(curves), "taus": pd.DataFrame(taus)}, {})


def _start(n: int, settings: FreeRotationSettings) -> tuple[BodySet, BodyState]:
    """Molecules with a canonical L~ whose axes lie along the lab's.

    Free motion has no preferred direction, and this attitude has no rounding error of its own.
    """
    bodies = tip4p.molecules(n)
    state = tip4p.canonical_rotation(bodies, settings.temperature, np.random.default_rng(settings.seed))
    axes = np.repeat(np.eye(3)[:, :, None], n, axis=2)
    return bodies, BodyState(state.q, state.p, axes, body_frame(state.A, state.L))


def _curve(method: OwnMethod, step_fs: float, settings: FreeRotationSettings) -> tuple[pd.DataFrame, dict[str, float]]:
    exact = method.rotation is rotation.exact
    bodies, start = _start(settings.exact_bodies if exact else settings.bodies, settings)
    h = step_fs * FS
    marks = _marks(round(settings.span / h), settings.marks_per_decade)
    drift = operators.drift(bodies, method.rotation)
    flows = {Kick: operators.always(lambda state, _: state), Drift: operators.always(drift)}
    step = operators.stepper(method.scheme, flows, h)
    judge = _squares_beyond_double if exact else _squares
    state, squares = start, []
    for count in range(1, marks[-1] + 1):
        state = step(state)
        if count in marks:
            squares.append(judge(state, start, bodies.species[0].moments, h, count))
    times, values = np.array(marks) * h, np.array(squares)
    delta, error, _ = np.array([jackknife(_root_mean(row), values.shape[1]) for row in values]).T
    curve = pd.DataFrame({"time": times, "delta": delta, "delta_error": error})
    before, after = (_energies(each, bodies) for each in (start, state))
    energy = 100 * float(np.sqrt(((after - before) ** 2).mean()) / before.mean())
    return curve.assign(method=method.name, step_fs=step_fs), summarize(times, delta, values) | {"energy": energy}


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


def _energies(state: BodyState, bodies: BodySet) -> np.ndarray:
    return 0.5 * (body_frame(state.A, state.L) ** 2 * bodies.inverse_moments).sum(axis=0)


def summarize(times: np.ndarray, delta: np.ndarray, squares: np.ndarray) -> dict[str, float]:
    """tau and the growth of delta, see `find`.

    Args:
        times: ps, (k,).
        delta: the paper's measure at these times, (k,).
        squares: squared deviation of each body, (k, n).
    """
    moderate = np.flatnonzero(delta <= MODERATE)
    last = int(moderate[-1]) if moderate.size else 0
    tau, tau_error, _ = jackknife(
        lambda chosen: times[last] / (10 * math.sqrt(squares[last, chosen].mean())), squares.shape[1]
    )
    decade = moderate[times[moderate] >= 0.099 * times[last]]
    exponent = float(np.polyfit(np.log(times[decade]), np.log(delta[decade]), 1)[0]) if decade.size > 1 else math.nan
    return {
        "tau": tau,
        "tau_error": tau_error,
        "tau_median": float(times[last] / (10 * np.sqrt(np.median(squares[last])))),
        "exponent": exponent,
        "tau_power": float(times[last] * (MODERATE / delta[last]) ** (1 / exponent)),
    }


def _root_mean(squares: np.ndarray) -> Callable[[np.ndarray], float]:
    return lambda chosen: math.sqrt(squares[chosen].mean())


# --- as text ---


def tables(record: Record) -> dict[str, pd.DataFrame]:
    """Return tau as text, with the paper's values and ours, by the title of the table."""
    settings = record.settings
    taus = pd.DataFrame([row | _beside(row) for row in record.tables["taus"].to_dict("records")])
    title = f"Free rotation of water, {settings['temperature']:g} K: tau from delta = t/(10 tau), "
    return {f"{title}runs of {settings['span']:g} ps": text.table(taus, TAUS)}


def _beside(row: dict[str, Any]) -> dict[str, str]:
    """tau as text, ours and the paper's."""
    tau, paper = row["tau"], published.TAU.get((row["method"], row["step_fs"]))
    scale, unit = published.unit_of(tau)
    return {
        "paper": "as SIER2" if paper is None else published.picoseconds(paper, like=tau),
        "ours": f"{Estimate(tau, row['tau_error']).times(1 / scale)} {unit}",
        "ratio": published.ratio(tau, paper),
        "median": published.picoseconds(row["tau_median"]),
        "power": published.picoseconds(row["tau_power"]),
    }
