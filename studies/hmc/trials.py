"""Cost of exact averages compared with LangevinMiddle: forces and time per independent sample.

    python -m studies.hmc.trials                                                TIP3P, all methods, 500 ps each
    python -m studies.hmc.trials systems/peptide.pdb --methods "LangevinMiddle, 4 fs" "SIER2V2 HMC, 9 fs x 8, 1/ps"
    python systems/make.py --model tip3p --molecules 64 --equilibrate 15 --out tip3p-64.pdb
    python -m studies.hmc.trials tip3p-64.pdb --methods "LangevinMiddle, 4 fs" "SIER2V2 HMC, 9 fs x 8, 1/ps"

Samples are the potential energy, the dipole of the box and, of a peptide, the cosine of psi. A trial of hybrid Monte
Carlo has so many steps of so many fs; momenta are drawn anew, or in part by the friction that is named. LangevinMiddle
has a friction of 5/ps and hydrogens of 3 dalton, hybrid Monte Carlo hydrogens of 4. Each run is kept in trials.jsonl as
soon as it is done and is not repeated; runs with other seeds, times or platforms add to the same averages. Processor
time is of one thread on the CPU platform. Writes trials.json.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd

from openmm_sier.dynamics.acceptance import TRIAL_FRICTION, usual_steps
from openmm_sier.dynamics.schemes import SIER2P3, SIER2V2, SIER4G, Scheme
from studies import heat_bath, methods, records, text
from studies.command import SYSTEMS, chosen, command
from studies.experiment import Experiment
from studies.heat_bath import AVERAGED, BathSettings
from studies.methods import MIDDLE, Contestant
from studies.records import Task

#: What is known of a run beside its averages, with errors.
COSTS = ("cost", "dipole_cost", "psi_cost")

COLUMNS = {
    **text.columns("box", "method", "hydrogens", "time"),
    "accepted": "{accepted:.3f}",
    "forces a trial": "{per_trial:.1f}",
    "V, kJ/mol": "{potential_text}",
    "forces an independent V": "{cost:.0f} ± {cost_error:.0f}",
    "dipole": "{dipole_cost:.0f} ± {dipole_cost_error:.0f}",
    "cos psi": "{psi_cost:.0f} ± {psi_cost_error:.0f}",
    "ms a force": "{milliseconds:.2f}",
    "seconds an independent V": "{seconds:.2f} ± {seconds_error:.2f}",
    "V over LangevinMiddle": "{relative:.2f} ± {relative_error:.2f}",
    "in processor time": "{seconds_relative:.2f} ± {seconds_relative_error:.2f}",
    "dipole over": "{dipole_relative:.2f} ± {dipole_relative_error:.2f}",
}


def _contestant(
    scheme: Scheme,
    step: float,
    steps: int,
    friction: float | None,
    mass: float | None,
    chances: int | None = None,
    engine: str = "auto",
) -> Contestant:
    """Return trials whose name has what they differ by."""
    detail = f" x {steps}"
    if friction is not None:
        detail += f", {friction:g}/ps"
    if mass is None:
        detail += ", light"
    if chances is not None:
        detail += f", {chances} extra chances"
    if engine != "auto":
        detail += f", {engine}"
    method = methods.trials(scheme, steps, frictionCoeff=friction, extraChances=chances, engine=engine)
    return method.at(step, hydrogens=mass, prepared=True, detail=detail, steps=steps)


#: Mass of heavy hydrogens, dalton.
HEAVY = 4.0

#: By scheme, step in fs, steps of a trial, friction in 1/ps, None where momenta are drawn anew, mass of hydrogens, None
#: where they keep theirs, extra chances, None for the usual number, and the engine.
TRIALS = (
    *(_contestant(SIER2V2, 9, 8, friction, HEAVY) for friction in (1.0, 2.0, 4.0, None)),
    *(_contestant(SIER2V2, 9, steps, 1.0, HEAVY) for steps in (4, 16)),
    *(_contestant(SIER2V2, 9, steps, 1.0, HEAVY, chances) for steps, chances in ((8, 5), (12, 2), (16, 2))),
    _contestant(SIER2V2, 9, 8, 1.0, HEAVY, engine="native"),
    _contestant(SIER2V2, 9, 17, None, HEAVY),
    _contestant(SIER2V2, 10, 7, 1.0, HEAVY),
    _contestant(SIER2V2, 12, 6, 1.0, HEAVY),
    *(_contestant(SIER2V2, 8, steps, 1.0, HEAVY) for steps in (4, 9)),
    _contestant(SIER2V2, 6, 12, 1.0, None),
    _contestant(SIER2P3, 18, 4, 1.0, HEAVY),
    _contestant(SIER2P3, 12, 6, 1.0, HEAVY),
    _contestant(SIER4G, 9, 8, 1.0, HEAVY),
)

#: Trials as integrator and command make them with heavy hydrogens, shorter ones, of which large boxes have more
#: accepted, and those of longer steps, for small boxes of water.
STEP = SIER2V2.heavy_trial_step or 0.0
USUAL = f"SIER2V2 HMC, {1e3 * STEP:g} fs x {usual_steps(STEP)}, {TRIAL_FRICTION:g}/ps"
SHORT = "SIER2V2 HMC, 8 fs x 4, 1/ps"
LONGER = "SIER2V2 HMC, 12 fs x 6, 1/ps"

#: What others take, with which exact averages are compared.
REFERENCE = "LangevinMiddle, 4 fs"

#: The same with a weaker bath, in which the energy may be forgotten sooner or later.
WEAK = MIDDLE.at(4, hydrogens=3.0, detail=", 1/ps", friction=1.0)

METHODS = {
    WEAK.name: WEAK,
    **{name: heat_bath.METHODS[name] for name in (REFERENCE, f"{REFERENCE}, light", "SIER2, 9 fs")},
    **{method.name: method for method in TRIALS},
}


@dataclass(frozen=True, kw_only=True)
class TrialSettings(BathSettings):
    """Settings of the runs; those of `heat_bath`, with shorter ones.

    Attributes:
        box: PDB file that names its force field, or dhfr.
        time: of each run, ps.
    """

    box: Path = field(default=SYSTEMS / "tip3p-512.pdb", kw_only=False)
    time: float = 500.0

    SHARED = ("temperature", "tolerance", "friction")


def tasks(settings: TrialSettings) -> Iterator[Task]:
    """All runs that the settings ask for, seed by seed."""
    chosen(settings.methods, METHODS, "method")
    at = "constant volume" if settings.pressure is None else f"{settings.pressure:g} bar"
    place = {"box": settings.box.stem, "at": at, "time": settings.time}
    for seed, name in product(range(settings.seed, settings.seed + settings.starts), settings.methods or METHODS):
        yield Task(settings, place | {"method": name, "seed": seed}, name)


def run(task: Task) -> dict[str, Any]:
    """Return what a run is kept as, see `heat_bath.measure`."""
    return task.point | heat_bath.measure(task.settings, METHODS[task.method], task.point["seed"])


def compared(runs: pd.DataFrame) -> pd.DataFrame:
    """A row for each box, pressure and method, with its costs as a multiple of those of LangevinMiddle."""
    rows = [_row(mine) for _, mine in runs.groupby(["box", "at", "method"], sort=False)]
    return pd.DataFrame([row | _relative(row, rows) for row in rows])


def _row(runs: pd.DataFrame) -> dict[str, Any]:
    """Means over the runs of one method in one box, weighted by their time, and the least time of a force."""
    row = runs.iloc[0][["box", "at", "method", "hydrogens"]].to_dict()
    row |= {"time": runs["time"].sum(), "broken": next((each for each in runs["broken"] if each), "")}
    share = runs["time"] / runs["time"].sum()
    errors = [f"{name}_error" for name in COSTS]
    known = runs.reindex(columns=["accepted", "trials", "fs_per_second", "forces", *COSTS, *errors])
    row |= {"accepted": (share * known["accepted"]).sum(min_count=1), "trials": known["trials"].sum()}
    row["per_trial"] = known["forces"].sum() / row["trials"] if row["trials"] else math.nan
    for name in COSTS:
        # Where a run is too short to show its memory, its cost has no error, and is as little known.
        is_known = known[f"{name}_error"].notna().all()
        row[name] = (share * known[name]).sum() if is_known else math.nan
        row[f"{name}_error"] = ((share * known[f"{name}_error"]) ** 2).sum() ** 0.5 if is_known else math.nan
    method = METHODS[row["method"]]
    forces = known["forces"].fillna(1e3 * runs["time"] / method.step * method.forces)
    # Other work on the machine only adds to it.
    row["milliseconds"] = (1e6 * runs["time"] / known["fs_per_second"] / forces).min()
    row |= {f"seconds{part}": 1e-3 * row["milliseconds"] * row[f"cost{part}"] for part in ("", "_error")}
    return row | records.pooled(runs, AVERAGED)


def _relative(row: dict[str, Any], rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Forces and processor time of an independent sample over those of LangevinMiddle in the same box."""
    same = (each for each in rows if (each["box"], each["at"], each["method"]) == (row["box"], row["at"], REFERENCE))
    reference = next(same, None)
    found: dict[str, Any] = {}
    names = {"relative": "cost", "seconds_relative": "seconds", "dipole_relative": "dipole_cost"}
    for name, of in (names | {"psi_relative": "psi_cost"}).items():
        if reference is None:
            found |= {name: math.nan, f"{name}_error": math.nan}
            continue
        found[name] = row[of] / reference[of]
        errors = [each[f"{of}_error"] / each[of] for each in (row, reference)]
        found[f"{name}_error"] = found[name] * math.hypot(*errors)
    return found


study = Experiment(
    "trials",
    tasks,
    run,
    "{box}, {at}, {method}, {time:g} ps, seed {seed}: {cost:.0f} forces an independent V",
    lambda settings, runs: ({"rows": compared(runs)}, {}),
    (("rows", "What an independent sample costs", COLUMNS),),
)

main = command(TrialSettings, study, __doc__, __name__)
