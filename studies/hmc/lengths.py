"""Energy errors of trajectories by scheme, step and length, and the chance that their ends are accepted.

    python -m studies.hmc.lengths                                     TIP3P, heavy hydrogens, all schemes and steps
    python -m studies.hmc.lengths systems/peptide.pdb --schemes sier4g sier2p3 --steps 3 4
    python -m studies.hmc.lengths --light --steps 2 3 4

All schemes follow trajectories from the same phase points, which hybrid Monte Carlo draws and `--out` keeps. Of each
trajectory the energies at the end of every step are known, so that one trajectory tells for all lengths up to its own
with what chance its end were accepted. Steps are in fs for each force evaluation.

What an independent sample costs, `studies.hmc.trials` measures in long runs. Writes trial-lengths.json.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import openmm
import pandas as pd

from openmm_sier import SIERHMCIntegrator, SIERIntegrator, prepare_system
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.schemes import CATALOGUE, SIER2P3, Scheme, alternating
from openmm_sier.dynamics.stages import DRIFT
from openmm_sier.inputs.starts import make_context
from studies import heat_bath, records, text
from studies.command import SYSTEMS, RunsSettings, chosen, command
from studies.records import Record, Task
from studies.report import SILENT, Report
from studies.units import md

#: The outer drift of schemes of three stages that no harmonic mode makes unstable near half its period, see SIER2P3.
OUTER = (0.1, 0.109, 0.113, 0.124, 0.13)


def three_stages(outer: float) -> Scheme:
    """A scheme of the family of SIER2P3, by its outer drift."""
    return alternating(f"3 stages, {outer:g}", (outer, (0.5 - outer) / (2 - 6 * outer), 0.5 - outer), first=DRIFT)


#: SIER2P3 with kicks and drifts exchanged: its last force is that at its end, with which the energy comes.
KICKS_FIRST = alternating(
    "3 stages, kicks first",
    (SIER2P3.stages[0].fraction, SIER2P3.stages[1].fraction, SIER2P3.stages[2].fraction),
    SIER2P3.source,
)

FOUR_STAGES = alternating(
    "4 stages",
    (0.07135391345027973, 0.1916678, 0.2685487911612301, 0.5 - 0.1916678),
    "Blanes, Casas and Sanz-Serna, SIAM J. Sci. Comput. 36, A1556 (2014), four stages",
    DRIFT,
)

#: By the names of their rows: the catalogue, and others that were considered for it.
SCHEMES = {
    **CATALOGUE,
    **{scheme.name.lower(): scheme for scheme in map(three_stages, OUTER)},
    KICKS_FIRST.name: KICKS_FIRST,
    FOUR_STAGES.name: FOUR_STAGES,
}

#: Masses of hydrogens in dalton by how they are called; None leaves them as they are.
HYDROGENS = {"heavy": 4.0, "light": None}

#: Starts are drawn by trials of this scheme, so many steps of it in fs, of which as many lie between two starts.
DRAWN_BY, DRAWN_STEP, DRAWN_STEPS, BETWEEN = "sier2p3", {"heavy": 12.0, "light": 8.0}, 9, 3

#: ps of a heat bath before the first start.
EQUILIBRATION = 3.0

#: Lengths of trials in fs that tables show, or the lengths next to them.
SHOWN = (36.0, 72.0, 144.0)

COLUMNS = {
    **text.columns("box", "hydrogens", "scheme", "per_force", "step"),
    "trial/fs": "{length:g}",
    "accepted": "{acceptance:.3f} ± {acceptance_error:.3f}",
    "sd/kT": "{spread:.3f}",
}


@dataclass(frozen=True)
class LengthSettings(RunsSettings):
    """Settings of the trajectories.

    Attributes:
        box: PDB file that names its force field, or dhfr.
        schemes: by name, all unless given.
        steps: fs for each force evaluation.
        light: whether hydrogens keep their masses; they have 4 dalton otherwise.
        longest: length of trajectories, fs.
        starts: trajectories of each scheme and step.
        temperature: K.
        tolerance: OpenMM's ewaldErrorTolerance; the sums of PME are balanced.
    """

    box: Path = SYSTEMS / "tip3p-512.pdb"
    schemes: tuple[str, ...] = ()
    steps: tuple[float, ...] = (3.0, 4.0, 5.0, 6.0, 7.0)
    light: bool = False
    longest: float = 216.0
    starts: int = 40
    temperature: float = 297.0
    tolerance: float = 1e-4

    SHARED: ClassVar[tuple[str, ...]] = ("temperature", "tolerance")
    FIRST = "box"

    @property
    def hydrogens(self) -> str:
        return "light" if self.light else "heavy"


class Starts(NamedTuple):
    """Phase points: positions in nm and velocities in nm/ps, (starts, N, 3) each."""

    positions: np.ndarray
    velocities: np.ndarray


def tasks(settings: LengthSettings) -> Iterator[Task]:
    """The trajectories of each scheme at each step."""
    chosen(settings.schemes, SCHEMES, "scheme")
    place = {"box": settings.box.stem, "hydrogens": settings.hydrogens, "seed": settings.seed}
    shared = place | {"longest": settings.longest, "starts": settings.starts}
    for scheme, per_force in product(settings.schemes or SCHEMES, settings.steps):
        yield Task(settings, shared | {"scheme": scheme, "per_force": per_force})


def run(task: Task) -> dict[str, Any]:
    """Total energies at the end of each step of each trajectory, kJ/mol; null from a step on that failed."""
    settings = task.settings
    scheme = SCHEMES[task.point["scheme"]]
    step = task.point["per_force"] * scheme.force_evaluations
    context = _context(settings, SIERIntegrator(1e-3 * step, scheme))
    starts = _starts(settings)
    steps = math.ceil(settings.longest / step)
    total = np.full((settings.starts, steps + 1), math.nan)
    for i in range(settings.starts):
        context.setPositions(starts.positions[i])
        context.setVelocities(starts.velocities[i])
        total[i, 0] = _energy(context)
        for j in range(1, steps + 1):
            try:
                context.getIntegrator().step(1)
            except openmm.OpenMMException:
                break
            total[i, j] = _energy(context)
    return task.point | {"step": step, "total": np.round(total, 4)}


def _context(settings: LengthSettings, integrator: openmm.Integrator) -> openmm.Context:
    box = heat_bath.read_box(settings)
    prepare_system(box.system, hydrogenMass=HYDROGENS[settings.hydrogens])
    context = make_context(box.system, integrator, "CPU")
    context.setPositions(box.positions)
    return context


def _energy(context: openmm.Context) -> float:
    state = context.getState(energy=True)
    return md(state.getPotentialEnergy() + state.getKineticEnergy())


def _starts(settings: LengthSettings) -> Starts:
    """The starts of a box, drawn where `out` does not have them."""
    kept = settings.out / f"starts-{settings.box.stem}-{settings.hydrogens}-{settings.starts}-{settings.seed}.npz"
    if not kept.exists():
        _draw(settings, kept)
    found = np.load(kept)
    return Starts(found["positions"], found["velocities"])


def _draw(settings: LengthSettings, kept: Path) -> None:
    step = 1e-3 * DRAWN_STEP[settings.hydrogens]
    integrator = SIERHMCIntegrator(settings.temperature, step, DRAWN_BY, DRAWN_STEPS)
    integrator.setRandomNumberSeed(settings.seed)
    context = _context(settings, integrator)
    openmm.LocalEnergyMinimizer.minimize(context, 10, 300)
    context.setVelocitiesToTemperature(settings.temperature, settings.seed)
    integrator.step(round(EQUILIBRATION / (step * DRAWN_STEPS)))
    positions, velocities = [], []
    for i in range(settings.starts):
        integrator.step(BETWEEN)
        positions.append(md(context.getState(positions=True).getPositions(asNumpy=True)))
        context.setVelocitiesToTemperature(settings.temperature, settings.seed + 1000 * (i + 1))
        velocities.append(md(context.getState(velocities=True).getVelocities(asNumpy=True)))
    np.savez(kept, positions=positions, velocities=velocities)


def study(settings: LengthSettings, report: Report = SILENT) -> Record:
    """Follow the trajectories that are missing in the directory `out`, and write trial-lengths.json."""
    form = "{box}, {hydrogens}, {scheme}, {per_force:g} fs per force: done"
    runs = records.all_runs(settings, "trial-lengths", tasks(settings), run, report, form)
    rows = pd.DataFrame([row for run in runs.to_dict("records") for row in shown_lengths(run, settings.temperature)])
    rows = rows.sort_values(["box", "hydrogens", "per_force", "scheme", "about"])
    report.table("Trajectories by length", text.table(rows, COLUMNS))
    return Record(settings.shared(), {"rows": rows}, {}).write(settings.out / "trial-lengths.json")


def shown_lengths(run: dict[str, Any], temperature: float) -> Iterator[dict[str, Any]]:
    """The row next to each of the lengths in `SHOWN`, which it has as `about`."""
    rows = list(by_length(run, temperature))
    for about in SHOWN:
        yield min(rows, key=lambda row: abs(row["length"] - about)) | {"about": about}


def by_length(run: dict[str, Any], temperature: float) -> Iterator[dict[str, Any]]:
    """A row for each number of steps: chance of acceptance, and spread of errors."""
    total = np.array(run["total"], dtype=float)
    names = ("box", "hydrogens", "per_force", "step", "starts")
    for steps in range(1, total.shape[1]):
        errors = (total[:, steps] - total[:, 0]) / (GAS_CONSTANT * temperature)
        chances = np.exp(-np.maximum(np.nan_to_num(errors, nan=np.inf), 0))
        yield {name: run[name] for name in names} | {
            "scheme": SCHEMES[run["scheme"]].name,
            "steps": steps,
            "length": steps * run["step"],
            "acceptance": chances.mean(),
            "acceptance_error": chances.std(ddof=1) / math.sqrt(len(chances)),
            "spread": errors.std(ddof=1),
        }


main = command(LengthSettings, study, __doc__, __name__)
