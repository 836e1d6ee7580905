"""Acceptance of hybrid Monte Carlo of solvated molecules by step and size, and its limit by solute or water.

    python -m studies.hmc.solvated dhfr --schemes sier4g verlet --steps 2 --out solvated
    python -m studies.hmc.solvated dhfr --moving water --trials 20 --out solvated      the protein is frozen
    python -m studies.hmc.solvated dhfr --moving solute --trials 20 --out solvated     water is frozen
    python -m studies.hmc.solvated systems/peptide.pdb --out solvated

Commands with one `--out` add to the same tables. Steps are in fs for each force evaluation, bonds to hydrogen are
constrained, and fast forces act within the drifts. `verlet` is the control: kick, drift, kick with all forces in the
kicks, and water that RATTLE turns, solved to rounding so that trajectories can be reversed. All schemes begin at one
equilibrated start of each box, which `--out` keeps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from time import process_time
from typing import Any, ClassVar

import numpy as np
import pandas as pd

from openmm_sier import SIERHMCIntegrator
from openmm_sier.dynamics.acceptance import spread_at
from studies import records, text
from studies.command import chosen, command
from studies.hmc import solutes
from studies.hmc.solutes import SoluteSettings
from studies.methods import REVERSIBLE
from studies.records import Record, Task
from studies.report import SILENT, Report
from studies.units import md

COLUMNS = text.columns(
    *("box", "moving", "scheme", "atoms", "solute", "masses", "per_force", "length"),
    *("trials", "accepted", "acceptance", "spread", "mean", "expected"),
)

LAWS = text.columns("moving", "scheme", "masses", "per_force", "boxes", "one", "of", "atoms_80", "atoms_50")


@dataclass(frozen=True, kw_only=True)
class SolvatedSettings(SoluteSettings):
    """Choose what is run.

    Attributes:
        schemes: by name, or `verlet`.
        steps: fs for each force evaluation.
        length: of a trial, fs, rounded to a whole number of steps.
        trials: how many.
        discarded: trials before them, in which the box settles.
    """

    schemes: tuple[str, ...] = ("sier4g",)
    steps: tuple[float, ...] = (2.0,)
    length: float = 30.0
    trials: int = 100
    discarded: int = 3

    SHARED: ClassVar[tuple[str, ...]] = ("temperature", "cutoff", "tolerance", "seed", "discarded")


def study(settings: SolvatedSettings, report: Report = SILENT) -> None:
    """Make the trials that are missing in the directory `out`, and write solvated.json with all energy errors there."""
    chosen(settings.schemes, REVERSIBLE, "scheme")
    masses = f"{settings.hydrogen_mass:g}{', water too' if settings.heavy_water else ''}"
    shared = {"box": settings.box.stem, "moving": settings.moving, "masses": masses, "asked": settings.length}
    tasks = [
        Task(settings, shared | {"scheme": scheme, "per_force": step, "trials": settings.trials})
        for scheme, step in product(settings.schemes, settings.steps)
    ]
    form = "{box}, {moving}, {masses}, {scheme}, {per_force:g} fs per force: {accepted} of {trials} accepted"
    rows = records.all_runs(settings, "solvated", tasks, run, report, form)
    rows = rows.sort_values(["atoms", "moving", "masses", "scheme", "per_force"])
    found = laws(rows)
    report.table("Trials of solvated molecules", text.table(rows, COLUMNS))
    report.table("Laws by size", text.table(found, LAWS))
    Record(settings.recorded(), {"rows": rows, "laws": found}, {}).write(settings.out / "solvated.json")


def integrator_of(settings: SolvatedSettings, scheme: str, per_force: float) -> SIERHMCIntegrator:
    """An integrator whose step is a trial."""
    method = REVERSIBLE[scheme]
    step = per_force * method.forces
    # The control has all forces in its kicks.
    control: dict[str, Any] = {"fastForceGroups": set()} if scheme == "verlet" else {}
    steps = max(1, round(settings.length / step))
    integrator = SIERHMCIntegrator(
        settings.temperature, 1e-3 * step, method.scheme, steps, rotation=method.rotation, extraChances=0, **control
    )
    integrator.setRandomNumberSeed(settings.seed)
    return integrator


def run(task: Task) -> dict[str, Any]:
    """Return what trials tell, see `statistics`, and the acceptance that the spread predicts."""
    settings = task.settings
    solution = solutes.read(settings)
    integrator = integrator_of(settings, task.point["scheme"], task.point["per_force"])
    context = solutes.context(solution, integrator, settings)
    integrator.step(settings.discarded)
    integrator.resetStatistics()
    forces, begun, errors = integrator.forceEvaluations, process_time(), []
    for _ in range(settings.trials):
        integrator.step(1)
        errors.append(integrator.lastEnergyError)
    found = statistics(errors)
    return task.point | {
        **found,
        "atoms": context.getSystem().getNumParticles(),
        "solute": len(solution.solute),
        "waters": solution.waters,
        "length": 1e3 * md(integrator.getStepSize()),
        "reversal": integrator.reversalError,
        "accepted": integrator.accepted,
        "forces": integrator.forceEvaluations - forces,
        "processor_seconds": process_time() - begun,
        "expected": expected_acceptance(found["spread"]),
        "errors": np.round(errors, 6),
    }


def statistics(errors: Sequence[float]) -> dict[str, Any]:
    """Return what energy errors of trials in kT tell; an error is NaN where a trajectory could not be followed.

    Returns:
        The number of `trials`; `acceptance`, the mean of min(1, exp(-error)); `spread`, the standard deviation of the
        energy error; `mean` of the error, half the square of the spread if errors are normal; each with its standard
        error, and NaN where there are too few trials.
    """
    of_all = np.array(errors, dtype=float)
    followed = of_all[np.isfinite(of_all)]
    chances = np.exp(-np.maximum(np.where(np.isfinite(of_all), of_all, math.inf), 0))
    n, m = len(of_all), len(followed)
    sd = float(followed.std(ddof=1)) if m > 1 else math.nan
    return {
        "trials": n,
        "acceptance": chances.mean() if n else math.nan,
        "acceptance_error": chances.std(ddof=1) / math.sqrt(n) if n > 1 else math.nan,
        "spread": sd,
        "spread_error": sd / math.sqrt(2 * (m - 1)) if m > 1 else math.nan,
        "mean": followed.mean() if m else math.nan,
        "mean_error": sd / math.sqrt(m) if m > 1 else math.nan,
    }


def expected_acceptance(spread: float) -> float:
    """Return the mean of min(1, exp(-error)) for normal energy errors with this standard deviation in kT."""
    return math.erfc(spread / math.sqrt(8))


def pooled_spread(spreads: pd.Series, parts: pd.Series, trials: pd.Series) -> tuple[float, float]:
    """Return the spread for one of the parts of a box and its standard error, from boxes weighted by their trials.

    For n parts it is sqrt(n) times as large.
    """
    freedom = trials - 1
    value = math.sqrt((freedom * spreads**2 / parts).sum() / freedom.sum())
    return value, value / math.sqrt(2 * freedom.sum())


def laws(rows: pd.DataFrame) -> pd.DataFrame:
    """The spread of energy errors for one atom, or one molecule of water where water moves alone, from all boxes.

    Independent parts of a box add to the variance, so that it grows as their number. `atoms_80` and `atoms_50` are the
    atoms of a box at acceptances of 0.8 and 0.5, by this law.
    """
    units = {"all": ("atoms", "an atom"), "water": ("waters", "a molecule"), "solute": ("solute", "an atom")}
    found = []
    for (moving, scheme, masses, step), mine in rows.groupby(["moving", "scheme", "masses", "per_force"], sort=False):
        column, of = units[moving]
        one, error = pooled_spread(mine["spread"], mine[column], mine["trials"])
        row = {"moving": moving, "scheme": scheme, "masses": masses, "per_force": step, "boxes": len(mine), "of": of}
        row |= {"one": one, "one_error": error, "atoms_80": math.nan, "atoms_50": math.nan}
        if moving == "all":
            row |= {f"atoms_{round(100 * wanted)}": (spread_at(wanted) / one) ** 2 for wanted in (0.8, 0.5)}
        found.append(row)
    return pd.DataFrame(found)


main = command(SolvatedSettings, study, __doc__, __name__)
