"""Bias of averages in a heat bath by step and friction, beside a law that predicts it from short steps.

    python -m studies.bath_bias                                 all models
    python -m studies.bath_bias --models SPC/E --processes 2

64 molecules with an energy of their own (`liquids.py`): two models of water with hydrogens of 4 dalton, and hydrogen
sulphide; and water that turns in a field, where the average is an integral. Steps are those of SIER2 in a bath; others
have drifts that rotate molecules at once: exactly, by RATTLE as LangevinMiddle does, or half-way between. Short steps
give averages without bias and, by `law.py`, the bias of long steps. Each run is kept in bath-bias.jsonl as soon as it
is done, and is not repeated. Writes bath-bias.json.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from openmm_sier.analysis.statistics import Estimate, mean_and_error, pooled
from openmm_sier.dynamics.constants import GAS_CONSTANT
from studies import records, text
from studies.bath_bias import law
from studies.bath_bias.kernels import BETWEEN_MEAN, COLUMNS, EXACT_MEAN, HALVES, RATTLE_MEAN, follow
from studies.bath_bias.liquids import MODELS, Model
from studies.command import RunsSettings, chosen
from studies.records import Record, Task
from studies.report import SILENT, Report

#: Names of drifts.
ROTATIONS = {
    HALVES: "SIER2",
    EXACT_MEAN: "exact, by the mean",
    RATTLE_MEAN: "RATTLE, by the mean",
    BETWEEN_MEAN: "half-way, by the mean",
}

#: Columns of `law.predicted` that rotations by the mean add, and the share of each.
ADDITIONS = {
    ROTATIONS[HALVES]: {},
    ROTATIONS[EXACT_MEAN]: {"mean_": 1.0},
    ROTATIONS[RATTLE_MEAN]: {"rattle_": 1.0},
    ROTATIONS[BETWEEN_MEAN]: {"mean_": 0.5, "rattle_": 0.5},
}

#: The run without bias, from which the law has its averages.
SHORT = "short steps"


class Long(NamedTuple):
    """A run of long steps: these in fs, the rotation, frictions of translation and rotation in 1/ps, its time in ps."""

    step: float
    rotation: int
    frictions: tuple[float, float]
    time: float


class Plan(NamedTuple):
    """Runs of a model.

    Attributes:
        short: the short step, fs.
        interval: between its samples, fs.
        memory: of `law.predicted`, ps.
        short_time: of the run of short steps, ps.
        short_bath: its frictions of translation and rotation, 1/ps.
        long: runs of long steps.
    """

    short: float
    interval: float
    memory: float
    short_time: float
    short_bath: tuple[float, float]
    long: tuple[Long, ...]


PLANS = {
    "TIP3P": Plan(
        short=4.0,
        interval=8.0,
        memory=3.0,
        short_time=6000.0,
        short_bath=(5.0, 5.0),
        long=(
            Long(10.0, HALVES, (5.0, 5.0), 12000.0),
            Long(10.0, RATTLE_MEAN, (5.0, 5.0), 12000.0),
            Long(10.0, HALVES, (1.0, 1.0), 12000.0),
            Long(10.0, HALVES, (5.0, 20.0), 6000.0),
            Long(10.0, BETWEEN_MEAN, (5.0, 5.0), 6000.0),
        ),
    ),
    "SPC/E": Plan(
        short=5.0,
        interval=10.0,
        memory=3.0,
        short_time=5000.0,
        short_bath=(5.0, 5.0),
        long=(Long(10.0, HALVES, (5.0, 5.0), 6000.0),),
    ),
    "hydrogen sulphide": Plan(
        short=6.0,
        interval=12.0,
        memory=5.0,
        short_time=6000.0,
        short_bath=(2.0, 2.0),
        long=(Long(18.0, HALVES, (2.0, 2.0), 8000.0),),
    ),
    "TIP3P in a field": Plan(
        short=2.0,
        interval=4.0,
        memory=1.0,
        short_time=100.0,
        short_bath=(5.0, 5.0),
        long=(
            Long(10.0, HALVES, (5.0, 5.0), 1500.0),
            Long(10.0, RATTLE_MEAN, (5.0, 5.0), 1500.0),
            Long(10.0, EXACT_MEAN, (5.0, 5.0), 1500.0),
            Long(10.0, HALVES, (5.0, 20.0), 1500.0),
            Long(10.0, BETWEEN_MEAN, (5.0, 5.0), 1500.0),
        ),
    ),
}

COLUMNS_SHOWN = {
    **text.columns("model", "method"),
    "step, fs": "{step:g}",
    "frictions, 1/ps": "{friction:g}, {turning_friction:g}",
    "ps": "{time:g}",
    "T of translations, K": "{translation_text}",
    "predicted": "{translation_law_text}",
    "of rotations, K": "{rotation_text}",
    "predicted ": "{rotation_law_text}",
    "bias of V, kJ/mol a molecule": "{bias_text}",
    "of its thermal part, %": "{percent_text}",
    "predicted  ": "{bias_law_text}",
}


@dataclass(frozen=True, kw_only=True)
class BiasSettings(RunsSettings):
    """Settings of the comparison.

    Attributes:
        models: by name; all unless given.
        shorter: times of runs are divided by this.
    """

    models: tuple[str, ...] = ()
    shorter: float = 1.0

    SHARED = ("shorter",)


def tasks(settings: BiasSettings) -> Iterator[Task]:
    """All runs that the settings ask for."""
    chosen(settings.models, PLANS, "model")
    for model in settings.models or PLANS:
        plan = PLANS[model]
        runs = [(SHORT, plan.short, plan.short_bath)]
        runs += [(ROTATIONS[each.rotation], each.step, each.frictions) for each in plan.long]
        for method, step, (friction, turning) in runs:
            point = {"model": model, "method": method, "step": step, "seed": settings.seed}
            yield Task(settings, point | {"friction": friction, "turning_friction": turning})


def long_run(plan: Plan, point: dict[str, Any]) -> Long:
    """Return the run of long steps of a plan that a point identifies."""
    wanted = point["method"], point["step"], point["friction"], point["turning_friction"]
    return next(each for each in plan.long if (ROTATIONS[each.rotation], each.step, *each.frictions) == wanted)


def run(task: Task) -> dict[str, Any]:
    """Return what is kept of a run: means with errors, of molecules, and of one of short steps the law."""
    point, plan, model = task.point, PLANS[task.point["model"]], MODELS[task.point["model"]]
    frictions = point["friction"], point["turning_friction"]
    is_short = point["method"] == SHORT
    planned = Long(plan.short, HALVES, frictions, plan.short_time) if is_short else long_run(plan, point)
    time = planned.time / task.settings.shorter
    samples = simulate(model, plan, point["step"], time, frictions, planned.rotation, point["seed"], is_short)
    n, degrees = model.molecules, model.degrees
    temperature = [2 / (GAS_CONSTANT * n * max(1, each)) for each in degrees]
    means = {
        "potential": mean_and_error(samples["potential"].to_numpy() / n),
        "translation": mean_and_error(samples["kinetic_translation"].to_numpy() * temperature[0]),
        "rotation": mean_and_error(samples["kinetic_rotation"].to_numpy() * temperature[1]),
    }
    row = point | {"time": time}
    for name, estimate in means.items():
        row |= {name: estimate.value, f"{name}_error": estimate.error}
    if not is_short:
        return row
    liquid = model.liquid()
    bath = law.Bath(*frictions, liquid.thermal, (n * degrees[0], n * degrees[1]), liquid.moments)
    biases = law.predicted(samples, 1e-3 * plan.interval, plan.memory, bath)
    scales = {"potential": 1 / n, "kinetic_translation": temperature[0], "kinetic_rotation": temperature[1]}
    for name, estimate in biases.items():
        scale = next(scale for kind, scale in scales.items() if name.endswith(kind))
        row |= {f"{name}_law": float(estimate.value * scale), f"{name}_law_error": float(estimate.error * scale)}
    stiffness = samples["trace_translation"] + samples["trace_rotation"]
    return row | {
        "capacity": samples["potential"].var() / liquid.thermal**2 / n,
        "stiffness_translation": samples["trace_translation"].mean() / n,
        "stiffness_rotation": samples["trace_rotation"].mean() / n,
        "softening": samples["potential"].cov(stiffness) / liquid.thermal / n,
    }


def simulate(
    model: Model,
    plan: Plan,
    step: float,
    time: float,
    frictions: tuple[float, float],
    rotation: int,
    seed: int,
    is_short: bool,
) -> pd.DataFrame:
    """Return samples of a run at its temperature, columns of `kernels.COLUMNS`; steps are in fs, times in ps."""
    liquid, bodies = model.liquid(), model.start(seed)

    def go(step: float, time: float, every: int, frictions: tuple[float, float], rotation: int) -> np.ndarray:
        count = max(1, round(1e3 * time / (step * every)))
        rows = np.empty((count, len(COLUMNS)))
        follow(seed, liquid, bodies, 1e-3 * step, count * every, every, *frictions, rotation, is_short, rows)
        return rows

    # Molecules on a lattice overlap.
    for longer in (0.05, 0.25, 1.0):
        go(longer * plan.short, 500 * longer * plan.short * 1e-3, 1, (50.0, 50.0), HALVES)
    settled = min(100 * plan.memory / 2, time / 4)
    go(plan.short, settled / 4, 1, (5.0, 5.0), HALVES)
    go(step, settled, 1, frictions, rotation)
    every = max(1, round(plan.interval / step))
    samples = pd.DataFrame(go(step, time, every, frictions, rotation), columns=COLUMNS)
    if not np.isfinite(samples["potential"]).all():
        raise FloatingPointError(f"{model} is unstable in steps of {step:g} fs")
    return samples


def compared(runs: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each run of long steps: its bias, and what the law predicts.

    That is known in a bath that has a run of short steps too, and with SIER2 in the limit of a weak bath of equal
    frictions. In a field the bias is also given in per cent of the thermal part of V.
    """
    rows = []
    for name, group in runs.groupby("model", sort=False):
        short = group[group["method"] == SHORT]
        exact = exact_potential(name, short)
        for row in group[group["method"] != SHORT].to_dict("records"):
            row["bias"] = row["potential"] - exact.value
            row["bias_error"] = math.hypot(row["potential_error"], exact.error)
            frictions = ["friction", "turning_friction"]
            alike = short[(short[frictions] == [row[key] for key in frictions]).all(axis=1)]
            if MODELS[name].field:
                # At rest a body has -3 c.
                row["percent"], row["percent_error"] = (
                    100 * row[key] / (exact.value + 3 * MODELS[name].field) for key in ("bias", "bias_error")
                )
            if row["method"] == ROTATIONS[HALVES] and row["friction"] == row["turning_friction"]:
                row |= weak(short.iloc[0], row)
            rows.append(row | (predicted(alike.iloc[0], row) if len(alike) else {}))
    table = pd.DataFrame(rows)
    # Centres of mass move freely in a field.
    is_free = table["model"].map(lambda name: MODELS[name].field > 0)
    table.loc[is_free, [name for name in table if "translation" in name]] = math.nan
    return table


def weak(short: pd.Series, row: dict[str, Any]) -> dict[str, float]:
    """Return what the law predicts in a weak bath, with SIER2: the bias of V of a molecule, and temperatures."""
    square, model = (1e-3 * row["step"]) ** 2, MODELS[row["model"]]
    stiffness = short["stiffness_translation"], short["stiffness_rotation"]
    mean = sum(stiffness) / sum(model.degrees)
    each = [k / n - mean if n else 0.0 for k, n in zip(stiffness, model.degrees, strict=True)]
    translation, rotation = (model.temperature * (1 + square / 12 * excess) for excess in each)
    return {
        "weak_bias": square * short["weak_potential_law"],
        "weak_bias_error": square * short["weak_potential_law_error"],
        "weak_translation": translation,
        "weak_rotation": rotation,
    }


def exact_potential(name: str, short: pd.DataFrame) -> Estimate:
    """Return the mean potential energy of a molecule: of short steps less their bias or, in a field, an integral.

    Rotations by an angle t have the measure (1 - cos t) dt, and tr A is 1 + 2 cos t.
    """
    model = MODELS[name]
    if not model.field:
        means = [
            Estimate(row["potential"] - (1e-3 * row["step"]) ** 2 * row["potential_law"], row["potential_error"])
            for row in short.to_dict("records")
        ]
        return pooled(means)
    angles = np.linspace(0, np.pi, 100001)
    traces = 1 + 2 * np.cos(angles)
    weights = (1 - np.cos(angles)) * np.exp(model.field / model.liquid().thermal * (traces - 3))
    return Estimate(-model.field * float((weights * traces).sum() / weights.sum()), 0.0)


def predicted(short: pd.Series, row: dict[str, Any]) -> dict[str, float]:
    """Return what the law predicts for a run of long steps: temperatures, and the bias of V of a molecule."""
    square = (1e-3 * row["step"]) ** 2
    shares = {"": 1.0} | ADDITIONS[row["method"]]
    found = {}
    for name, column, base in (
        ("bias_law", "potential", 0.0),
        ("translation_law", "kinetic_translation", MODELS[row["model"]].temperature),
        ("rotation_law", "kinetic_rotation", MODELS[row["model"]].temperature),
    ):
        values = {f"{prefix}{column}_law": share for prefix, share in shares.items()}
        found[name] = base + square * sum(share * short[each] for each, share in values.items())
        errors = [share * short[f"{each}_error"] for each, share in values.items()]
        found[f"{name}_error"] = square * math.hypot(*errors)
    return found


def study(settings: BiasSettings, report: Report = SILENT) -> Record:
    """Make the runs that are missing in the directory `out`, and write bath-bias.json."""
    form = "{model}, {method}, {step:g} fs, friction {friction:g} and {turning_friction:g}: V = {potential_text} kJ/mol"
    runs = records.all_runs(settings, "bath-bias", tasks(settings), run, report, form)
    rows = compared(runs)
    report.table("Bias of averages", text.table(rows, COLUMNS_SHOWN))
    tables = {"rows": rows, "laws": runs[runs["method"] == SHORT].dropna(axis="columns")}
    return Record(settings.shared(), tables, {}).write(settings.out / "bath-bias.json")
