"""Acceptance of hybrid Monte Carlo of solvated molecules by step and by size, and whether solute or water limits it.

    python -m studies.hmc.solvated dhfr --scheme sier4g --step 2 --trials 100 --out solvated
    python -m studies.hmc.solvated dhfr --moving water --trials 20 --out solvated      the protein is frozen
    python -m studies.hmc.solvated dhfr --moving solute --trials 20 --out solvated     water is frozen
    python -m studies.hmc.solvated systems/peptide.pdb --scheme verlet --out solvated
    python -m studies.hmc.solvated --table solvated/*.json

Steps are in fs for each force evaluation, bonds to hydrogen are constrained, and fast forces act within the drifts.
`verlet` is the control: kick, drift, kick with all forces in the kicks, and water that RATTLE turns, solved to rounding
so that trajectories can be reversed. All schemes begin at one equilibrated start of each box, which `--out` keeps.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Any, Literal

import numpy as np
import pandas as pd

from openmm_sier import SIERHMCIntegrator
from openmm_sier.dynamics.metropolis import expected_acceptance
from openmm_sier.dynamics.rotation import exact, rattle
from openmm_sier.dynamics.schemes import CATALOGUE, SIER2
from openmm_sier.measure.report import SILENT, Report
from studies import records
from studies.command import execute
from studies.hmc import solutes
from studies.hmc.solutes import SoluteSettings
from studies.records import Record

COLUMNS = {
    "box": "{box}",
    "moves": "{moving}",
    "scheme": "{scheme}",
    "atoms": "{atoms}",
    "of the solute": "{solute}",
    "hydrogens": "{masses}",
    "fs per force": "{per_force:g}",
    "trial/fs": "{length:g}",
    "trials": "{trials}",
    "accepted": "{accepted}",
    "acceptance": "{acceptance:.3f} ± {acceptance_error:.3f}",
    "sd/kT": "{spread:.3f} ± {spread_error:.3f}",
    "mean/kT": "{mean:+.3f} ± {mean_error:.3f}",
    "by the sd": "{expected:.3f}",
}


@dataclass(frozen=True)
class SolvatedSettings(SoluteSettings):
    """What is run or read.

    Attributes:
        table: records of trials to be read, in place of a run.
        scheme: by name, or `verlet`.
        step: fs for each force evaluation.
        length: of a trial, fs, rounded to a whole number of steps.
        trials: how many.
        discarded: trials before them, in which the box settles.
    """

    table: tuple[Path, ...] = ()
    scheme: Literal["sier2", "sier4g", "sier4p", "sier4v", "verlet"] = "sier4g"
    step: float = 2.0
    length: float = 30.0
    trials: int = 100
    discarded: int = 3


def study(settings: SolvatedSettings, report: Report = SILENT) -> None:
    """Make trials, or a table."""
    made = [records.read(path) for path in settings.table] or [run(settings, report)]
    rows = pd.DataFrame([row_of(record) for record in made])
    rows = rows.sort_values(["atoms", "moving", "scheme", "per_force"])
    report.table(records.table("Trials of solvated molecules", rows, COLUMNS, left=3))


def integrator_of(settings: SolvatedSettings) -> SIERHMCIntegrator:
    """An integrator whose step is a trial."""
    scheme = SIER2 if settings.scheme == "verlet" else CATALOGUE[settings.scheme]
    step = settings.step * scheme.force_evaluations
    steps = max(1, round(settings.length / step))
    control: dict[str, Any] = {"rotation": rattle, "fastForceGroups": set()} if settings.scheme == "verlet" else {}
    control = control or {"rotation": exact}
    integrator = SIERHMCIntegrator(settings.temperature, 1e-3 * step, scheme, steps, **control)
    integrator.setRandomNumberSeed(settings.seed)
    return integrator


def run(settings: SolvatedSettings, report: Report = SILENT) -> Record:
    """Trials of one scheme in one box, in a file of its own, which is written as they are made."""
    solution = solutes.read(settings)
    integrator = integrator_of(settings)
    context = solutes.context(solution, integrator, settings)
    masses = f"{settings.hydrogen_mass:g}{'-heavy' if settings.heavy_water else ''}"
    name = f"{solution.name}-{settings.moving}-{masses}-{settings.scheme}-{settings.step:g}-{settings.length:g}"
    integrator.step(settings.discarded)
    integrator.resetStatistics()
    forces, begun, errors = integrator.forceEvaluations, process_time(), []
    notes: dict[str, Any] = {
        "box": solution.name,
        "atoms": context.getSystem().getNumParticles(),
        "solute": len(solution.solute),
        "waters": solution.waters,
        "length": 1e3 * integrator.getStepSize()._value,
        "reversal": integrator.reversalError,
    }
    with report.progress(name, settings.trials) as show:
        for done in range(1, settings.trials + 1):
            integrator.step(1)
            errors.append(integrator.lastEnergyError)
            notes |= {
                "accepted": integrator.accepted,
                "forces": integrator.forceEvaluations - forces,
                "processor_seconds": process_time() - begun,
            }
            record = Record(settings.recorded(), {"trials": pd.DataFrame({"error": errors})}, notes)
            record.write(settings.out / f"{name}.json")
            show(done)
    return record


def row_of(record: Record) -> dict[str, Any]:
    """What trials tell: acceptance, the mean of min(1, exp(-error)), and mean and standard deviation of the errors."""
    errors = record.tables["trials"]["error"].to_numpy(dtype=float)
    errors = np.where(np.isnan(errors), math.inf, errors)
    followed, chances = errors[np.isfinite(errors)], np.exp(-np.maximum(errors, 0))
    n, m = len(errors), len(followed)
    spread = float(np.std(followed, ddof=1)) if m > 1 else math.nan
    return {
        **record.notes,
        "moving": record.settings["moving"],
        "masses": f"{record.settings['hydrogen_mass']:g}{', water too' if record.settings['heavy_water'] else ''}",
        "scheme": record.settings["scheme"],
        "per_force": record.settings["step"],
        "trials": n,
        "acceptance": chances.mean(),
        "acceptance_error": chances.std(ddof=1) / math.sqrt(n) if n > 1 else math.nan,
        "spread": spread,
        "spread_error": spread / math.sqrt(2 * (m - 1)) if m > 1 else math.nan,
        "mean": followed.mean() if m else math.nan,
        "mean_error": spread / math.sqrt(m) if m > 1 else math.nan,
        "expected": expected_acceptance(spread),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    return execute(SolvatedSettings, study, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
