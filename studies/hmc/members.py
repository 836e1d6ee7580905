"""What a sample costs, from the members of an ensemble of hybrid Monte Carlo or Langevin dynamics.

    openmm-sier ensemble systems/dipeptide-samples.toml --out samples
    python -m studies.hmc.members samples/* --skip 5 --out samples-table

Acceptance, energy error, potential energy, volume and density by settings, and the number of forces for an
independent potential energy, volume, dipole of the box and cosine of the first psi, from the logs and trajectories of
complete runs; those that differ in their seeds alone are pooled. An energy, for the decision on a trial or on a move of
the volume, counts as a force. Writes members.json.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import openmm
import pandas as pd
from mdtraj.formats import DCDTrajectoryFile
from tyro.conf import Positional

from openmm_sier.cli.finished_runs import FinishedRun, open_runs
from openmm_sier.measure.forcefields import read_box
from openmm_sier.measure.liquid_samples import quietly
from openmm_sier.measure.statistics import mean_and_error, pooled
from openmm_sier.observe.stock import BAROSTAT_INTERVAL
from studies import records
from studies.command import Settings, command
from studies.hmc.dihedrals import backbone, dihedral
from studies.hmc.samples import cost
from studies.records import Record
from studies.report import SILENT, Report
from studies.units import md

#: What is observed, with its column in the log.
OBSERVED = {"potential": "Potential Energy (kJ/mole)", "volume": "Box Volume (nm^3)"}

#: Of what means are shown.
MEANS = OBSERVED | {"density": "Density (g/mL)"}

COLUMNS = {
    "run": "{label}",
    "runs": "{runs}",
    "ps": "{time:.0f}",
    "accepted": "{accepted:.3f}",
    "energy error, kT": "{spread:.3f}",
    "V, kJ/mol": "{potential_text}",
    "volume, nm³": "{volume_text}",
    "g/cm³": "{density_text}",
    "forces for an independent V": "{potential_cost_text}",
    "volume": "{volume_cost_text}",
    "dipole": "{dipole_cost_text}",
    "cos psi": "{psi_cost_text}",
}

#: Of what the number of forces for an independent sample is found.
COSTS = (*OBSERVED, "dipole", "psi")


@dataclass(frozen=True)
class MemberSettings(Settings):
    """What is read.

    Attributes:
        runs: directories of members, or checkpoints.
        skip: ps to leave out at the beginning of each run.
    """

    runs: Positional[tuple[Path, ...]] = ()
    skip: float = 0.0

    ANY_SIGN: ClassVar[tuple[str, ...]] = ("skip",)


def study(settings: MemberSettings, report: Report = SILENT) -> Record:
    """A table of runs, which is written to members.json.

    Raises:
        ValueError: no run is given.
    """
    if not settings.runs:
        raise ValueError("name the directories of an ensemble's members")
    alike: dict[str, list[FinishedRun]] = {}
    for run in open_runs(settings.runs):
        if run.complete:
            alike.setdefault(label_of(run), []).append(run)
    rows = pd.DataFrame([row_of(label, runs, settings.skip) for label, runs in alike.items()])
    shown = records.with_text(rows, *MEANS, *(f"{name}_cost" for name in COSTS))
    report.table(records.table("Samples", shown, COLUMNS))
    return Record({"skip": settings.skip}, {"rows": rows}, {}).write(settings.out / "members.json")


def label_of(run: FinishedRun) -> str:
    """A run in a few words."""
    plan = run.plan
    trials = f", trials of {1e3 * plan.step_time:.4g} fs" if plan.ensemble == "hmc" else ""
    friction = f", friction {plan.friction:g}/ps" if plan.friction else ""
    return f"{Path(str(plan.box)).stem}: {plan.method.name}{trials}, steps of {plan.dt:g} fs{friction}{plan.hydrogens}"


def forces_per_step(run: FinishedRun) -> float:
    """Forces of a step, which is a trial with hybrid Monte Carlo, and energies for decisions."""
    plan = run.plan
    moves, scheme = plan.moves_volume, plan.method.scheme
    forces = scheme.force_evaluations if scheme else 1
    if plan.ensemble == "hmc":
        return forces * plan.steps_per_trial + 1 + moves
    return forces + moves / BAROSTAT_INTERVAL


def row_of(label: str, runs: Sequence[FinishedRun], skip: float) -> dict[str, Any]:
    """Means with errors, and costs, of runs that are alike."""
    logs = [run.log(skip) for run in runs]
    row: dict[str, Any] = {"label": label, "runs": len(runs)}
    row["time"] = sum(float(np.ptp(log["Time (ps)"])) for log in logs)
    row["accepted"] = np.mean([log["Acceptance"][-1] for log in logs]) if "Acceptance" in logs[0] else math.nan
    errors = np.concatenate([log.get("Energy Error (kT)", np.array([])) for log in logs])
    row["spread"] = float(np.nanstd(errors, ddof=1)) if len(errors) else math.nan
    for name, column in MEANS.items():
        row[name], row[f"{name}_error"], _ = pooled([mean_and_error(log[column]) for log in logs])
    rows, frames = (forces_per_step(runs[0]) * runs[0].plan.interval(each) for each in intervals(runs[0]))
    series = [{name: pd.DataFrame({name: log[column]}) for name, column in OBSERVED.items()} for log in logs]
    of_frames = [in_frames(run, skip) for run in runs]
    for name in COSTS:
        seen = [each[name] for each in (series if name in OBSERVED else of_frames) if name in each]
        row[f"{name}_cost"] = row[f"{name}_cost_error"] = math.nan
        # What does not change has no samples.
        if len(seen) == len(runs) and all((np.ptp(each.to_numpy(), axis=0) > 0).all() for each in seen):
            found = [cost(each, rows if name in OBSERVED else frames) for each in seen]
            row[f"{name}_cost"], row[f"{name}_cost_error"], _ = pooled(found)
    return row


def intervals(run: FinishedRun) -> tuple[float, float]:
    """ps between rows of the log, and between frames."""
    return run.plan.report_every, run.plan.every


def in_frames(run: FinishedRun, skip: float) -> dict[str, pd.DataFrame]:
    """The dipole of the box, of whole molecules, e nm, and the cosine of the first psi; without those that have none.

    The dipole needs neutral molecules whose sites are all in the trajectory.
    """
    if not run.notes["trajectory"]["count"] or run.plan.box is None:
        return {}
    box = read_box(Path(run.plan.box), run.plan.forcefield, run.plan.constraints)
    with quietly(), DCDTrajectoryFile(str(run.plan.out)) as file:
        positions = 0.1 * file.read()[0][round(skip / run.plan.every) :].astype(float)
    found = {}
    if len(box.listed) == box.topology.getNumAtoms():
        force = next(each for each in box.system.getForces() if isinstance(each, openmm.NonbondedForce))
        charges = np.array([md(force.getParticleParameters(i)[0]) for i in range(len(box.listed))])
        found["dipole"] = pd.DataFrame(np.einsum("i,kix->kx", charges, positions), columns=["x", "y", "z"])
    # Amides and water have no psi.
    with contextlib.suppress(ValueError):
        psi = backbone(box.topology)[1]
        found["psi"] = pd.DataFrame({"psi": np.cos([dihedral(each, psi) for each in positions])})
    return found


main = command(MemberSettings, study, __doc__, __name__)
