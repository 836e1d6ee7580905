"""Acceptance of hybrid Monte Carlo of solvated molecules by step and by size, and whether solute or water limits it.

    python -m studies.hmc.solvated dhfr --scheme sier4g --step 2 --trials 100 --out solvated
    python -m studies.hmc.solvated dhfr --moving water --trials 20 --out solvated      the protein is frozen
    python -m studies.hmc.solvated dhfr --moving solute --trials 20 --out solvated     water is frozen
    python -m studies.hmc.solvated systems/peptide.pdb --scheme verlet --out solvated
    python -m studies.hmc.solvated --table solvated/*.json
    python -m studies.hmc.solvated dhfr --pdb dhfr.pdb       the box for `openmm-sier`, before any equilibration

Steps are in fs for each force evaluation, bonds to hydrogen are constrained, and fast forces act within the drifts.
`verlet` is the control: kick, drift, kick with all forces in the kicks, and water that RATTLE turns, solved to rounding
so that trajectories can be reversed. All schemes begin at one equilibrated start of each box, which `--out` keeps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Any, Literal

import pandas as pd

from openmm_sier import SIERHMCIntegrator
from openmm_sier.dynamics.metropolis import spread_at
from openmm_sier.dynamics.rotation import exact, rattle
from openmm_sier.dynamics.schemes import CATALOGUE, SIER2
from studies import records
from studies.acceptance import expected_acceptance, pooled_spread, statistics
from studies.command import command
from studies.hmc import solutes
from studies.hmc.solutes import SoluteSettings
from studies.records import Record
from studies.report import SILENT, Report
from studies.units import md

COLUMNS = records.columns(
    *("box", "moving", "scheme", "atoms", "solute", "masses", "per_force", "length"),
    *("trials", "accepted", "acceptance", "spread", "mean", "expected"),
)

LAWS = records.columns("moving", "scheme", "masses", "per_force", "boxes", "one", "of", "atoms_80", "atoms_50")


@dataclass(frozen=True)
class SolvatedSettings(SoluteSettings):
    """What is run or read.

    Attributes:
        table: records of trials to be read, in place of a run.
        pdb: where to write the box, in place of a run.
        scheme: by name, or `verlet`.
        step: fs for each force evaluation.
        length: of a trial, fs, rounded to a whole number of steps.
        trials: how many.
        discarded: trials before them, in which the box settles.
    """

    table: tuple[Path, ...] = ()
    pdb: Path | None = None
    scheme: Literal["sier2", "sier4g", "sier4p", "sier4v", "verlet"] = "sier4g"
    step: float = 2.0
    length: float = 30.0
    trials: int = 100
    discarded: int = 3


def study(settings: SolvatedSettings, report: Report = SILENT) -> None:
    """Make trials, or tables of those made, which are written to solvated.json with all energy errors; or a box."""
    if settings.pdb is not None:
        solutes.write(settings.pdb, solutes.read(settings))
        report.note(f"wrote {settings.pdb}")
        return
    if not settings.table:
        report.table(records.table("Trials", pd.DataFrame([row_of(run(settings, report))]), COLUMNS, left=3))
        return
    rows = pd.DataFrame([row_of(records.read(path)) for path in settings.table])
    rows = rows.sort_values(["atoms", "moving", "masses", "scheme", "per_force"])
    found = laws(rows)
    report.table(records.table("Trials of solvated molecules", rows, COLUMNS, left=3))
    report.table(records.table("Laws by size", found, LAWS, left=2))
    Record(settings.recorded(), {"rows": rows, "laws": found}, {}).write(settings.out / "solvated.json")


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
    forces, begun = integrator.forceEvaluations, process_time()
    known: dict[str, Any] = {
        "box": solution.name,
        "atoms": context.getSystem().getNumParticles(),
        "solute": len(solution.solute),
        "waters": solution.waters,
        "length": 1e3 * md(integrator.getStepSize()),
        "reversal": integrator.reversalError,
    }

    def trial() -> dict[str, float]:
        integrator.step(1)
        return {"error": integrator.lastEnergyError}

    def notes(_: int) -> dict[str, Any]:
        spent = {"forces": integrator.forceEvaluations - forces, "processor_seconds": process_time() - begun}
        return known | {"accepted": integrator.accepted, **spent}

    return solutes.kept_series(settings, name, name, settings.trials, 1, trial, notes, report)


def row_of(record: Record) -> dict[str, Any]:
    """What trials tell, see `studies.acceptance.statistics`, and the acceptance that is expected by the spread."""
    settings, errors = record.settings, record.tables["samples"]["error"].to_numpy(dtype=float)
    found = statistics(errors)
    return {
        **record.notes,
        **found,
        "moving": settings["moving"],
        "masses": f"{settings['hydrogen_mass']:g}{', water too' if settings['heavy_water'] else ''}",
        "scheme": settings["scheme"],
        "per_force": settings["step"],
        "expected": expected_acceptance(found["spread"]),
        "errors": errors.round(6),
    }


def laws(rows: pd.DataFrame) -> pd.DataFrame:
    """The spread of energy errors for one atom, or one molecule of water where water moves alone, from all boxes.

    Independent parts of a box add to the variance, so that it grows as their number. `atoms_80` and `atoms_50` are the
    atoms of a box at acceptances of 0.8 and 0.5, by this law.
    """
    units = {"all": ("atoms", "an atom"), "water": ("waters", "a molecule"), "solute": ("solute", "an atom")}
    found = []
    for (moving, scheme, masses, step), mine in rows.groupby(["moving", "scheme", "masses", "per_force"], sort=False):
        column, of = units[moving]
        one, error = pooled_spread(mine.assign(molecules=mine[column]))
        row = {"moving": moving, "scheme": scheme, "masses": masses, "per_force": step, "boxes": len(mine), "of": of}
        row |= {"one": one, "one_error": error, "atoms_80": math.nan, "atoms_50": math.nan}
        if moving == "all":
            row |= {f"atoms_{round(100 * wanted)}": (spread_at(wanted) / one) ** 2 for wanted in (0.8, 0.5)}
        found.append(row)
    return pd.DataFrame(found)


main = command(SolvatedSettings, study, __doc__, __name__)
