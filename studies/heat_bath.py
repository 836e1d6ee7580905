"""Averages of a solute in water by step, integrator and mass of hydrogens, and their cost in force evaluations.

    python -m studies.heat_bath                                               the dipeptide, all methods, 250 ps each
    python -m studies.heat_bath --methods "LangevinMiddle, 4 fs" "SIER2, 10 fs" --time 1000
    python -m studies.heat_bath systems/tip3p-512.pdb --time 100 --pressure 1
    python -m studies.heat_bath dhfr --methods "SIER2, 9 fs" --time 20

Temperatures are of water and solute apart: with SIER2 of velocities just after the bath, with OpenMM's integrators of
those at the end of steps, without their components along constraints. Translations and rotations of water show how a
bath is shared: a long step makes rotations warmer than translations, the more the weaker the bath. Hybrid Monte Carlo
gives exact averages. Each run is kept in heat-bath.jsonl as soon as it is done and is not repeated; runs with other
seeds add to the same averages. Runs take turns on `--processes` processes of one thread each. Writes heat-bath.json.

The distributions of phi and psi are compared with those of hybrid Monte Carlo by Kolmogorov and Smirnov, with as many
samples as are independent.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import openmm
import pandas as pd
from scipy.stats import kstwobign

from openmm_sier import SIERHMCIntegrator, SIERIntegrator
from openmm_sier.analysis.statistics import mean_and_error
from openmm_sier.dynamics.correlation import inefficiency
from openmm_sier.inputs import forcefields
from openmm_sier.inputs.equilibration import equilibrate, make_context
from studies import boxes, records, speed_boxes, text
from studies.command import SYSTEMS, RunsSettings, chosen, command
from studies.experiment import Experiment
from studies.frame import Unstable, sampled
from studies.methods import (
    MIDDLE,
    Bath,
    Contestant,
    exact,
    middle_in_rigid_water,
    more_inner_steps,
    own,
    several_steps,
    turned_more,
)
from studies.observers import ANGLES, BONDED, DIPOLE, OfSolution, cost
from studies.records import Task

#: What is averaged, with its heading.
AVERAGED = {
    "water": "T water, K",
    "translation": "T translations, K",
    "rotation": "T rotations, K",
    "solute": "T solute, K",
    "potential": "V, kJ/mol",
    "density": "density, g/cm³",
    **{kind: f"{kind}, kJ/mol" for kind in BONDED},
    "helical": "share of phi, psi < 0",
}

#: Temperatures to which components of velocities along constraints contribute.
OF_VELOCITIES = ("water", "rotation", "solute")

#: Columns that tell a row.
NAMES = text.columns("box", "method", "hydrogens", "time", "at")

AVERAGES = {
    **NAMES,
    **{heading: f"{{{key}_text}}" for key, heading in AVERAGED.items()},
    "phi, p": "{phi_p:.2f}",
    "psi, p": "{psi_p:.2f}",
}

COSTS = {
    **NAMES,
    "forces an independent V": "{cost:.0f} ± {cost_error:.0f}",
    "dipole": "{dipole_cost:.0f} ± {dipole_cost_error:.0f}",
    "cos psi": "{psi_cost:.0f} ± {psi_cost_error:.0f}",
    "accepted": "{accepted:.2f}",
    "over LangevinMiddle, 4 fs": "{over:.2f}",
}

#: Number of bins of the distributions of dihedrals.
BINS = 72

#: Forces for an independent sample, by the names of the columns.
SAMPLED = ("cost", "dipole_cost", "psi_cost")

#: fs between samples.
INTERVAL = 200.0

#: 1/ps; rows of another friction say so.
FRICTION = 5.0

METHODS = {
    method.name: method
    for method in (
        *(MIDDLE.at(step, detail=", light") for step in (2, 4)),
        *(MIDDLE.at(step, hydrogens=3.0) for step in (4, 5)),
        *(middle_in_rigid_water(step) for step in (9, 10)),
        several_steps(8),
        *(own(step, hydrogens=None, detail=", light") for step in (4, 5, 6)),
        *(own(step) for step in (8, 9, 10, 11)),
        *(own(9, hydrogens=mass, detail=f", hydrogens of {mass:g}") for mass in (2.0, 3.0, 4.5)),
        more_inner_steps(9, 3, ", five inner steps"),
        more_inner_steps(9, 4, ", seven inner steps"),
        own(9, friction=20.0, detail=", 20/ps"),
        *(turned_more(9, friction) for friction in (5.0, 10.0)),
        *(exact(step, steps) for step, steps in ((8, 5), (9, 4))),
    )
}


@dataclass(frozen=True, kw_only=True)
class BathSettings(RunsSettings):
    """Settings of the comparison; the seeds of runs follow `seed`.

    Attributes:
        box: PDB file that names its force field, or dhfr.
        methods: by name; unless given all that the box bears.
        starts: runs of each.
        time: of each run, ps.
        equilibrate: before it, ps.
        temperature: K.
        friction: 1/ps.
        pressure: bar; the volume is kept unless given.
        tolerance: OpenMM's ewaldErrorTolerance; the sums of PME are balanced.
        platform: of OpenMM; processor time is known of CPU alone.
    """

    box: Path = field(default=SYSTEMS / "peptide.pdb", kw_only=False)
    methods: tuple[str, ...] = ()
    starts: int = 1
    time: float = 250.0
    equilibrate: float = 5.0
    temperature: float = 297.0
    friction: float = FRICTION
    pressure: float | None = None
    tolerance: float = 1e-4
    platform: str = "CPU"

    SHARED: ClassVar[tuple[str, ...]] = ("temperature", "tolerance", "equilibrate")


def tasks(settings: BathSettings) -> Iterator[Task]:
    """All runs that the settings ask for, seed by seed."""
    chosen(settings.methods, METHODS, "method")
    at = "constant volume" if settings.pressure is None else f"{settings.pressure:g} bar"
    at += "" if settings.friction == FRICTION else f", {settings.friction:g}/ps"
    is_water = settings.box.exists() and boxes.is_water(settings.box)
    place = {"box": settings.box.stem, "at": at, "time": settings.time}
    names = settings.methods or [name for name, method in METHODS.items() if is_water or not method.only_rigid]
    for seed, name in product(range(settings.seed, settings.seed + settings.starts), names):
        yield Task(settings, place | {"method": name, "seed": seed}, name)


def run(task: Task) -> dict[str, Any]:
    """Return what is kept of a run."""
    return task.point | measure(task.settings, METHODS[task.method], task.point["seed"])


def measure(settings: BathSettings, method: Contestant, seed: int) -> dict[str, Any]:
    """Return averages and costs of a run with their errors, and its speed in fs per second of processor time.

    The speed is NaN on other platforms than CPU.
    """
    box = read_box(settings)
    bath = Bath(settings.temperature, settings.friction, settings.pressure)
    integrator = method.integrator(bath)
    integrator.setRandomNumberSeed(seed)
    method.fit(box.system)
    if bath.pressure is not None and not isinstance(integrator, SIERIntegrator):
        box.system.addForce(openmm.MonteCarloBarostat(bath.pressure, bath.temperature))
    masses = "as they are" if method.hydrogens is None else f"{method.hydrogens:g} Da"
    found: dict[str, Any] = {"hydrogens": masses, "broken": "", "projected": True}
    try:
        context = make_context(box.system, integrator, settings.platform)
        context.setPositions(box.positions)
        openmm.LocalEnergyMinimizer.minimize(context, 10, 300)
        context.setVelocitiesToTemperature(settings.temperature, seed)
        if isinstance(integrator, SIERHMCIntegrator):
            # Trials of large boxes are rejected while these warm up.
            equilibrate(context, settings.temperature, seed, settings.equilibrate)
        else:
            integrator.step(max(1, round(1e3 * settings.equilibrate / method.duration)))
        before = _evaluations(integrator)
        observe = OfSolution(box.system, box.topology)
        samples = sampled(context, observe, method.duration, settings.time, INTERVAL)
    except (openmm.OpenMMException, Unstable) as error:
        return found | {"broken": " ".join(str(error).split())}
    series = samples.table.dropna(axis="columns")
    for key in AVERAGED.keys() & set(series):
        found |= {key: (of_key := mean_and_error(series[key].to_numpy())).value, f"{key}_error": of_key.error}
    # Trials whose ends are not accepted at once take more forces.
    forces = _evaluations(integrator) - before or 1e3 * settings.time / method.step * method.forces
    found |= _distributions(series) | _costs(series, forces) | {"forces": forces}
    if isinstance(integrator, SIERHMCIntegrator):
        found |= {"trials": integrator.trials, "accepted": integrator.acceptanceRate}
    return found | {"fs_per_second": samples.fs_per_processor_second if settings.platform == "CPU" else math.nan}


def _evaluations(integrator: openmm.Integrator) -> int:
    """Return the number of force evaluations so far of hybrid Monte Carlo; 0 for integrators that do not count them."""
    return integrator.forceEvaluations if isinstance(integrator, SIERHMCIntegrator) else 0


def _distributions(series: pd.DataFrame) -> dict[str, Any]:
    """Return how often the dihedrals were in each bin, and how many samples of them are independent."""
    found: dict[str, Any] = {}
    for angle in ANGLES:
        if angle in series:
            found[f"{angle}_counts"] = np.histogram(series[angle], BINS, (-np.pi, np.pi))[0]
            memory = max(inefficiency(turned(series[angle].to_numpy())) for turned in (np.cos, np.sin))
            found[f"{angle}_samples"] = len(series) / memory
    return found


def _costs(series: pd.DataFrame, forces: float) -> dict[str, float]:
    """Forces for an independent energy, dipole of the box and cosine of psi, of a run of so many, with errors."""
    samples = {"cost": series[["potential"]], "dipole_cost": series[list(DIPOLE)]}
    if "psi" in series:
        samples["psi_cost"] = np.cos(series[["psi"]])
    found = {}
    for name, values in samples.items():
        found[name], found[f"{name}_error"] = cost(values, forces / len(series))[:2]
    return found


def read_box(settings: Any) -> Any:
    """Return what has topology, positions and system, its sums of PME in balance."""
    if settings.box.stem == "dhfr":
        box = boxes.dhfr(speed_boxes.CUTOFF, speed_boxes.SWITCH, settings.tolerance, speed_boxes.HYDROGEN)
    else:
        box = forcefields.read_box(settings.box, None, "hbonds")
    boxes.with_tolerance(box.system, settings.tolerance)
    return box


def averaged(runs: pd.DataFrame) -> pd.DataFrame:
    """A row for each box, pressure and method: means over its runs with errors, and what is compared with others.

    Temperatures are of the runs whose velocities have no components along constraints.
    """
    rows = []
    for _, at in comparable(runs).groupby(["box", "at"], sort=False):
        exact = at[at["method"].str.contains("HMC")]
        for _, mine in at.groupby("method", sort=False):
            rows.append(_row(mine) | {f"{angle}_p": _probability(angle, mine, exact) for angle in ANGLES})
    frame = pd.DataFrame(rows)
    reference = frame[frame["method"] == "LangevinMiddle, 4 fs"].set_index(["box", "at"])["speed"]
    places = pd.MultiIndex.from_frame(frame[["box", "at"]])
    return frame.assign(over=frame["speed"] / reference.reindex(places).to_numpy())


def _row(runs: pd.DataFrame) -> dict[str, Any]:
    """Means over the runs of one method in one box."""
    row = runs.iloc[0][["box", "at", "method", "hydrogens"]].to_dict()
    row |= {"time": runs["time"].sum(), "broken": next((each for each in runs["broken"] if each), "")}
    row["projected"] = bool(runs.get("projected", pd.Series(False)).eq(True).any())
    # What is not known of any run has no column.
    known = runs.reindex(columns=["accepted", "trials", "fs_per_second"])
    row |= known.mean().rename({"fs_per_second": "speed"}).to_dict() | {"trials": known["trials"].sum()}
    return row | records.pooled(runs, (*SAMPLED, *AVERAGED))


def comparable(rows: pd.DataFrame) -> pd.DataFrame:
    """Return runs, or rows of a record, without temperatures of velocities with components along constraints.

    Runs are `projected` if these components were taken away; this package's integrators have none.
    """
    projected = rows.get("projected", pd.Series(False, rows.index)).eq(True)
    raw = ~projected & rows["method"].str.contains("Langevin")
    names = [name for key in OF_VELOCITIES for name in (key, f"{key}_error") if name in rows]
    return rows.assign(**{name: rows[name].mask(raw) for name in names})


def _probability(angle: str, runs: pd.DataFrame, exact: pd.DataFrame) -> float:
    """Of a distance between two distributions as large as theirs if they were one; NaN where one is not known.

    Source: N. Smirnov, Ann. Math. Stat. 19, 279 (1948), with the numbers of independent samples.
    """
    names = [f"{angle}_counts", f"{angle}_samples"]
    several = [part.reindex(columns=names).dropna() for part in (runs, exact)]
    if any(part.empty for part in several) or several[0].index.equals(several[1].index):
        return math.nan
    first, second = (np.cumsum(np.sum(part[f"{angle}_counts"].tolist(), axis=0)) for part in several)
    distance = np.abs(first / first[-1] - second / second[-1]).max()
    one, other = (part[f"{angle}_samples"].sum() for part in several)
    return float(kstwobign.sf(distance * math.sqrt(one * other / (one + other))))


study = Experiment(
    "heat-bath",
    tasks,
    run,
    "{box}, {at}, {method}, {time:g} ps, seed {seed}: done",
    lambda settings, runs: ({"rows": averaged(runs)}, {}),
    (("rows", "Averages in a heat bath", AVERAGES), ("rows", "What they cost", COSTS)),
)

main = command(BathSettings, study, __doc__, __name__)
