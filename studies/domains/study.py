"""Rigid domains and elastic networks: averages in a bath, the longest correct step, speed, and energy.

    python -m studies.domains                                  all models
    python -m studies.domains --models chain --kinds bath --methods sier2

Models: two chains of 120 residues with two rigid domains each, in the manner of CALVADOS, also with bonds as stiff as
those of atoms; carbon dioxide in a zeolite; patchy particles. They are built by modules of this
package from published parameters. Each is run with rigid bodies, by SIER2 in a bath and by hybrid Monte Carlo; with
frames, by OpenMM's LangevinMiddle; and, but for carbon dioxide, with springs that hold bodies, by LangevinMiddle.
Those with stiff bonds are run at constant energy alone. Each run is kept in domains.jsonl as soon as it is done, and is
not repeated. Writes domains.json and domains.png.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import openmm
import pandas as pd

from studies import text
from studies.command import RunsSettings, chosen
from studies.domains import bath, drawing, energy, speed
from studies.domains.methods import METHODS
from studies.domains.models import Model
from studies.domains.plans import PLANS, Plan
from studies.experiment import Experiment, Made
from studies.records import Task
from studies.units import md

#: Averages that are compared with exact ones, and temperatures, which are compared with that of the bath.
COMPARED = ("potential", "bonds", "gyration")
TEMPERATURES = ("temperature", "translation", "rotation", "linkers")

#: Errors by which a method may be off in the worst of its averages and count as right: one of seven averages without
#: any error of the step is off by more than this in one run of fifty.
RIGHT = 3.0

#: Kinds of runs.
KINDS = BATH, ENERGY, SPEED = "bath", "energy", "speed"

AVERAGES = text.columns("model", "method") | {
    "step/fs": "{step:g}",
    "T/K": "{temperature_text}",
    "T of bodies, translation/K": "{translation_text}",
    "rotation/K": "{rotation_text}",
    "T of linkers/K": "{linkers_text}",
    "V/kJ/mol": "{potential_text}",
    "bonds/kJ/mol": "{bonds_text}",
    "R_g/nm": "{gyration_text}",
    "worst, in errors": "{off:.1f}",
    "ns a day": "{ns_a_day:.0f}",
}
SPEEDS = text.columns("model", "method") | {
    "step/fs": "{step:.3g}",
    "ms a step": "{ms:.3g}",
    "ns a day": "{ns_a_day:.0f} ± {ns_a_day_error:.0f}",
    "longest right/fs": "{longest:g}",
    "over springs at their longest": "{over:.2f}",
}
ENERGIES = text.columns("model", "method") | {
    "step/fs": "{step:.3g}",
    "forces a step": "{forces}",
    "rms(H)/kJ/mol": "{rms:.2g}",
    "rms(H)/rms(V)/%": "{percent:.2g}",
    "drift/kJ/mol/ps": "{drift:+.1e} ± {drift_error:.0e}",
}
GAINS = text.columns("model", "method") | {
    "step/fs": "{step:g}",
    "rms(H)/kJ/mol": "{rms:.2g}",
    "Verlet of that error/fs": "{verlet:.2g}",
    "its time over that of the method": "{gain:.1f}",
}

#: Names, titles and columns of the tables of a record.
TABLES = (
    ("averages", "In a bath of 300 K", AVERAGES),
    ("speeds", "Processor time on one thread", SPEEDS),
    ("energies", "At constant energy", ENERGIES),
    ("gains", "Verlet with springs at the same error", GAINS),
)


@dataclass(frozen=True, kw_only=True)
class DomainSettings(RunsSettings):
    """What is run.

    Attributes:
        models: by name, chain, stiff, zeolite or patchy; all unless given.
        kinds: of runs, bath, energy (at constant energy) and speed; all unless given.
        methods: in the bath, by name; all that a model has unless given.
        steps: of them, fs; those of each model unless given.
        shorter: by which all times are divided.
        friction: of the bath, 1/ps.
        rounds: of turns for the speed.
        platform: of OpenMM in the bath; runs at constant energy are on Reference, in double precision.
    """

    models: tuple[str, ...] = ()
    kinds: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    steps: tuple[float, ...] = ()
    shorter: float = 1.0
    friction: float = 1.0
    rounds: int = 6
    platform: str = "CPU"

    SHARED = ("shorter", "friction", "platform")

    def start(self, name: str, plan: Plan, model: Model) -> openmm.State:
        """The equilibrated phase point of a model, which is kept for all runs of a seed."""
        path = self.out / f"start of {name}, seed {self.seed}.xml"
        return bath.settled(model, plan.settle / self.shorter, plan.step, self.seed, self.platform, path)


def tasks(settings: DomainSettings) -> Iterator[Task]:
    """All runs that the settings ask for: in the bath, then at constant energy, then turns for the speed."""
    chosen(settings.models, PLANS, "model")
    chosen(settings.methods, METHODS, "method")
    chosen(settings.kinds, dict.fromkeys(KINDS), "kind")
    for name, kind in product(settings.models or PLANS, settings.kinds or KINDS):
        for method, steps in _methods(PLANS[name], kind).items():
            if kind != BATH or not settings.methods or method in settings.methods:
                for step in (settings.steps or steps) if kind == BATH else steps:
                    point = {"kind": kind, "key": name, "name": method, "step": round(step, 6), "seed": settings.seed}
                    yield Task(settings, point, method)


def _methods(plan: Plan, kind: str) -> dict[str, tuple[float, ...]]:
    """Methods of a kind of run with their steps; turns for the speed are one run."""
    if kind == SPEED:
        return {"": (0.0,)}
    if kind == ENERGY:
        return dict(plan.energies)
    return dict(plan.baths)


def run(task: Task) -> dict[str, Any]:
    """Result of a run, with its point."""
    settings, (kind, name, method, step) = task.settings, (task.point[key] for key in ("kind", "key", "name", "step"))
    plan = PLANS[name]
    model = plan.build()
    start = settings.start(name, plan, model)
    row = task.point | {"model": model.name, "broken": ""}
    if kind == SPEED:
        rows = speed.by_turns(model, plan, start, settings.rounds, settings.seed, settings.platform)
        return row | {"rows": rows, "picture": drawing.picture(model, md(start.getPositions(asNumpy=True)))}
    if kind == ENERGY:
        time = plan.energy_time / settings.shorter
        return row | _energies(model, method, step, time, start, settings.seed)
    time = min(plan.time / settings.shorter, 1e-3 * step * plan.most)
    row |= {"time": time}
    averages = bath.averages(
        model, method, step, time, plan.interval, settings.friction, start, settings.seed, settings.platform
    )
    return row | {"method": METHODS[method].name} | averages


def _energies(model: Model, method: str, step: float, time: float, start: openmm.State, seed: int) -> dict[str, Any]:
    return {"method": energy.INTEGRATORS[method].name} | energy.followed(model, method, step, time, start, seed)


def averages(runs: pd.DataFrame) -> pd.DataFrame:
    """A row for each model, method and step: averages with errors, and by how many errors the worst of them is off."""
    rows = runs[(runs["kind"] == BATH) & (runs["broken"] == "")].reset_index(drop=True)
    rows = rows.assign(off=[worst(row, exact_of(rows, row)) for _, row in rows.iterrows()])
    a_day = {(r["key"], s["method"], s["step"]): s["ns_a_day"] for _, r in _of_speed(runs) for s in r["rows"]}
    keys = zip(rows["key"], rows["method"], rows["step"], strict=True)
    return rows.assign(ns_a_day=[a_day.get(key, math.nan) for key in keys])


def _of_speed(runs: pd.DataFrame) -> Iterator[tuple[Any, pd.Series]]:
    return runs[runs["kind"] == SPEED].iterrows()


def exact_of(rows: pd.DataFrame, row: pd.Series) -> pd.Series | None:
    """The exact run with which a run is compared: of the same model, and with springs if it has some."""
    of_run = rows[(rows["key"] == row["key"]) & (rows["seed"] == row["seed"])]
    springs = row["name"] in METHODS and METHODS[row["name"]].springs
    names = [name for name, method in METHODS.items() if method.exact and method.springs == springs]
    exact = of_run[of_run["name"].isin(names)]
    return None if exact.empty or row["name"] in names else exact.iloc[0]


def worst(row: pd.Series, exact: pd.Series | None) -> float:
    """The largest of the deviations of a run in standard errors; NaN for an exact run."""
    if exact is None:
        return math.nan
    temperature = 300.0
    off = [(row[key] - temperature) / row[f"{key}_error"] for key in TEMPERATURES]
    for key in set(COMPARED) - set(PLANS[row["key"]].slow):
        error = math.hypot(row[f"{key}_error"], exact[f"{key}_error"])
        off.append((row[key] - exact[key]) / error if error else 0.0)
    finite = [abs(each) for each in off if math.isfinite(each)]
    return max(finite, default=math.nan)


def longest_right(rows: pd.DataFrame, key: str, method: str) -> float:
    """The longest step up to which all that were tried are right; NaN if the shortest is not."""
    longest = math.nan
    for _, row in rows[(rows["key"] == key) & (rows["method"] == method)].sort_values("step").iterrows():
        if not row["off"] < RIGHT:
            break
        longest = row["step"]
    return longest


def speeds(runs: pd.DataFrame, rows: pd.DataFrame) -> pd.DataFrame:
    """ns a day of each method at each step, over that of springs at the longest step at which they are right."""
    tables = []
    for _, run in _of_speed(runs):
        measured = pd.DataFrame(run["rows"]).replace({None: math.nan}).assign(key=run["key"], model=run["model"])
        limits = {method: longest_right(rows, run["key"], method) for method in measured["method"]}
        measured["longest"] = measured["method"].map(limits)
        springs = METHODS["langevinmiddle"].name
        reference = measured[(measured["method"] == springs) & (measured["step"] == limits.get(springs))]["ns_a_day"]
        measured["over"] = measured["ns_a_day"] / (reference.iloc[0] if len(reference) else math.nan)
        tables.append(measured)
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()


def gains(energies: pd.DataFrame, timed: pd.DataFrame) -> pd.DataFrame:
    """Return what rigid bodies save: the processor time of Verlet with springs over theirs, at the same energy error.

    The step of Verlet is interpolated between those that were run, on logarithms; beyond them the error goes with the
    square of the step.
    """
    rows = []
    reference = energy.INTEGRATORS["verlet"].name
    for key, of_model in energies.groupby("key", sort=False) if len(energies) else ():
        verlet = of_model[of_model["method"] == reference].sort_values("step")
        if verlet.empty:
            continue
        # A step costs the same at any length.
        cost = timed[timed["key"] == key].groupby("method")["ms"].first() if len(timed) else pd.Series(dtype=float)
        for _, row in of_model[of_model["method"] != reference].iterrows():
            step, ours = same_error(verlet, row["rms"]), row["method"]
            gain = (
                cost[reference] / step / (cost[ours] / row["step"])
                if {ours, reference} <= set(cost.index)
                else math.nan
            )
            rows.append({name: row[name] for name in ("key", "model", "method", "step", "rms")})
            rows[-1] |= {"verlet": step, "gain": gain}
    return pd.DataFrame(rows)


def same_error(verlet: pd.DataFrame, error: float) -> float:
    """The step of Verlet with an error of the energy."""
    steps, errors = np.log(verlet["step"].to_numpy(float)), np.log(verlet["rms"].to_numpy(float))
    if error < verlet["rms"].min():
        return float(np.exp(steps[0] + (math.log(error) - errors[0]) / 2))
    return float(np.exp(np.interp(math.log(error), errors, steps)))


def made(settings: DomainSettings, runs: pd.DataFrame) -> Made:
    """Return the tables of all runs, and pictures of the models."""
    rows = averages(runs)
    timed = speeds(runs, rows)
    energies = runs[runs["kind"] == ENERGY].dropna(axis=1, how="all")
    broken = runs.loc[runs["broken"] != "", ["key", "name", "step", "broken"]]
    pictures = {run["key"]: run["picture"] for _, run in _of_speed(runs)}
    means = rows.drop(columns=[name for name in ("rows", "picture") if name in rows])
    tables = {"averages": means, "speeds": timed, "energies": energies, "gains": gains(energies, timed)}
    return tables | {"broken": broken}, {"pictures": pictures}


study = Experiment("domains", tasks, run, "{kind} of {key}: {name}, {step:g} fs", made, TABLES, drawing.figure)
