"""What long steps change around a solute, cause by cause, in a harmonic model without noise.

    python -m studies.harmonic_bath
    python -m studies.harmonic_bath systems/dipeptide.pdb --starts 4

A box is cooled to a minimum of its energy. Around one molecule of the solute its neighbours move harmonically, with
their constraints, and the rest of the box stands still. A step of SIER2 in a bath is then an affine map, averages are
those of a Gaussian distribution, and differences of one per mille have no noise. The mean energies of bonds and angles
of the molecule are compared with those of the Boltzmann distribution of the same model, by step, inner steps, friction,
masses, and motion of the neighbours. Beside them stands what follows from one cause alone: slow forces in kicks stretch
a mode of the fast forces, of period T, by x/tan(x) of the right amount, x = pi h/T. Writes harmonic-bath.json.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from openmm_sier.analysis.statistics import of_independent
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.system import tables
from studies import text
from studies.command import SYSTEMS, Settings
from studies.harmonic_bath.minimum import KINDS, Minimum, masses_of, minimum, neighbourhood
from studies.harmonic_bath.steps import Case, stationary, stretched
from studies.harmonic_bath.surfaces import Gaussian, Surface, Tangents
from studies.records import Record
from studies.report import SILENT, Report

#: 1/ps. Modes are at least as stiff: softer ones have no error, and a minimum that is not exact makes them unstable.
SOFTEST = 2 * math.pi / 2.0

COLUMNS = {
    "SIER2": "{case}",
    "angles, %": "{angles_text}",
    "by the stretch alone": "{angles_law_text}",
    "bonds, %": "{bonds_text}",
    "by the stretch alone ": "{bonds_law_text}",
}

CASES = {
    "9 fs": Case(),
    "9 fs, seven inner steps": Case(inner=7),
    "9 fs, 1/ps": Case(friction=1.0),
    "9 fs, 20/ps": Case(friction=20.0),
    "9 fs, neighbours at rest": Case(has_neighbours=False),
    "9 fs, hydrogens of 2": Case(hydrogens=2.0),
    "9 fs, solute twice as heavy": Case(solute=2.0),
    "10 fs": Case(step=10.0),
    "8 fs": Case(step=8.0),
    "4 fs": Case(step=4.0),
}


@dataclass(frozen=True, kw_only=True)
class HarmonicSettings(Settings):
    """Settings of the model.

    Attributes:
        box: PDB file of a solute in water that names its force field.
        temperature: K.
        starts: minima, each after a run.
        molecules: of the solute, the first ones; all unless given.
        equilibrate: length of these runs, ps.
        minimize: most steps to a minimum.
    """

    box: Path = field(default=SYSTEMS / "mixture.pdb", kw_only=False)
    temperature: float = 297.0
    starts: int = 2
    molecules: int | None = None
    equilibrate: float = 2.0
    minimize: int = 3000


def compared(box: Minimum, molecule: int, case: Case, thermal: float) -> dict[str, float]:
    """Return what a step changes of the energies of a molecule, and their means in the Boltzmann distribution, kJ/mol.

    The latter are above the energies at the minimum.
    """
    is_in = box.molecules == molecule
    moving = neighbourhood(box.positions, box.edges, box.molecules, molecule)
    moving = moving if case.has_neighbours else np.flatnonzero(is_in)
    tangents = Tangents(box.positions, tables.constraints(box.system).pairs, masses_of(box, case), moving)
    slow, fast = tangents(box.surfaces["slow"]), tangents(box.surfaces["fast"])
    stiffness, modes = np.linalg.eigh(slow.curvature + fast.curvature)
    stiffness = np.maximum(stiffness, SOFTEST**2)
    slow = Surface(slow.gradient, (modes * stiffness) @ modes.T - fast.curvature)
    fast = Surface(-slow.gradient, fast.curvature)

    exact = Gaussian(np.zeros(len(stiffness)), (modes * (thermal / stiffness)) @ modes.T)
    actual = stationary(slow, fast, case, thermal)
    law = stretched(slow, fast, case, thermal)
    values: dict[str, float] = {}
    for kind in KINDS:
        surface = tangents(box.surfaces[kind].of_atoms(is_in))
        right = exact.energy(surface)
        values |= {
            f"{kind}_exact": right,
            kind: actual.energy(surface) - right,
            f"{kind}_law": law.energy(surface) - right,
        }
    return values


def study(settings: HarmonicSettings, report: Report = SILENT) -> Record:
    """Compare all cases, and write harmonic-bath.json."""
    thermal = GAS_CONSTANT * settings.temperature
    each = []
    for seed in range(settings.seed, settings.seed + settings.starts):
        run = settings.equilibrate, settings.minimize, seed, settings.molecules
        box = minimum(settings.box, settings.temperature, *run)
        for name, case in CASES.items():
            for molecule in box.solute:
                values = compared(box, molecule, case, thermal)
                means = {kind: box.energies[kind] + values[f"{kind}_exact"] for kind in KINDS}
                shares = {
                    f"{kind}{end}": 100 * values[f"{kind}{end}"] / means[kind] for kind in KINDS for end in ("", "_law")
                }
                each.append({"case": name, **case._asdict(), **shares})
        report.note(f"{settings.box.stem}, minimum {seed}: done")
    rows = averaged(pd.DataFrame(each), settings.box.stem)
    report.table("Error in per cent", text.table(rows, COLUMNS))
    return Record(settings.recorded(), {"rows": rows}, {}).write(settings.out / "harmonic-bath.json")


def averaged(each: pd.DataFrame, box: str) -> pd.DataFrame:
    """Return a row for each case: means over molecules, with errors."""
    rows: list[dict[str, Any]] = []
    for name, several in each.groupby("case", sort=False):
        row = {"box": box, "case": name, **CASES[str(name)]._asdict(), "molecules": len(several)}
        for kind in (f"{kind}{end}" for kind in KINDS for end in ("", "_law")):
            mean = of_independent(several[kind].to_numpy())
            row |= {kind: mean.value, f"{kind}_error": mean.error}
        rows.append(row)
    return pd.DataFrame(rows)
