"""The command `openmm-sier properties`: what runs of a liquid say of it, beside experiment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from openmm_sier.cli import records
from openmm_sier.cli.console import REPORT, table
from openmm_sier.cli.plan import CONTINUED, Plan, RunError, noted_plan
from openmm_sier.dynamics.constants import BAR
from openmm_sier.measure import properties
from openmm_sier.measure.forcefields import Box, describe, read_box
from openmm_sier.measure.liquid_samples import LiquidSamples, read_samples
from openmm_sier.measure.properties import Estimate
from openmm_sier.studies import style
from openmm_sier.studies.figures import property_figure

#: Liquid water at 298.15 K and 1 bar: density, heat capacity, enthalpy of vaporization and dielectric constant by the
#: IAPWS formulations; self-diffusion of Holz et al., Phys. Chem. Chem. Phys. 2, 4740 (2000); the first maximum of the
#: O-O distribution of Skinner et al., J. Chem. Phys. 138, 074506 (2013).
EXPERIMENT = {
    "density": "0.9970",
    "vaporization": "43.99",
    "capacity": "75.3",
    "dielectric": "78.4",
    "diffusion": "2.30",
    "peak": "2.57 at 0.280",
}


class Row(NamedTuple):
    """A property: its key in `EXPERIMENT`, its name with the unit, and how it follows from a run."""

    key: str
    name: str
    estimate: Callable[[Run], Estimate | None]


class Run(NamedTuple):
    """A finished run.

    Attributes:
        plan: of the command.
        log: columns of the log after what is skipped.
        samples: of the trajectory.
        molecules: their number.
    """

    plan: Plan
    log: dict[str, np.ndarray]
    samples: LiquidSamples
    molecules: int

    @property
    def energy(self) -> np.ndarray:
        """The energy whose fluctuations give the heat capacity: the enthalpy where the volume moves."""
        total = self.log["Total Energy (kJ/mole)"]
        if self.plan.moves_volume:
            total = total + (self.plan.pressure or 0.0) * BAR * self.log["Box Volume (nm^3)"]
        return total


def _capacity(run: Run) -> Estimate | None:
    if run.plan.ensemble == "nve":
        return None
    return properties.heat_capacity(run.energy, run.plan.temperature, run.molecules)


def _vaporization(run: Run) -> Estimate:
    potential = properties.mean(run.log["Potential Energy (kJ/mole)"])
    return properties.vaporization_enthalpy(potential, run.plan.temperature, run.molecules)


def _dielectric(run: Run) -> Estimate | None:
    if run.samples.dipoles is None:
        return None
    return properties.dielectric_constant(run.samples.dipoles, run.samples.volumes, run.plan.temperature)


def _diffusion(run: Run) -> Estimate:
    return properties.self_diffusion(run.samples.centres, run.samples.interval)


def _rotation(run: Run) -> Estimate:
    return properties.rotation_time(run.samples.directions, run.samples.interval)


ROWS = (
    Row("density", "density, g/cm³", lambda run: properties.mean(run.log["Density (g/mL)"])),
    Row(
        "",
        "potential energy, kJ/mol of molecules",
        lambda run: properties.mean(run.log["Potential Energy (kJ/mole)"] / run.molecules),
    ),
    Row("vaporization", "enthalpy of vaporization, kJ/mol, rigid and without polarization", _vaporization),
    Row("capacity", "heat capacity (total energy or enthalpy), classical, J/mol/K", _capacity),
    Row("dielectric", "static dielectric constant", _dielectric),
    Row("diffusion", "self-diffusion in the box, 10⁻⁹ m²/s", _diffusion),
    Row("", "rotational correlation time of second order, ps", _rotation),
)


def properties_of(
    checkpoints: Sequence[Path], box: Path | None, skip: float, viscosity: float | None, out: Path
) -> None:
    """Carry out `openmm-sier properties`.

    Args:
        checkpoints: of the runs, or their directories.
        box: the PDB file; None takes that of the checkpoints.
        skip: ps to leave out at the beginning of each run.
        viscosity: mPa s, for the size correction of diffusion; None: no correction.
        out: directory for the figure.

    Raises:
        RunError: runs differ in more than the seed and the length.
        RecordError, NoLiquidError, OSError: as their messages say.
    """
    runs = read_runs(checkpoints, box, skip)
    found = {row: [_estimated(row, run) for run in runs] for row in ROWS}
    rows = []
    for row, estimates in found.items():
        given = [estimate for estimate in estimates if estimate is not None]
        if not given:
            continue
        value = properties.pooled(given)
        rows.append([row.name, str(value), EXPERIMENT.get(row.key, "")])
        if row.key == "diffusion" and viscosity is not None:
            rows.append(_corrected(runs, value, viscosity))
    pairs = np.mean([run.samples.pairs for run in runs], axis=0)
    peak = int(pairs.argmax())
    place = f"{pairs[peak]:.2f} at {runs[0].samples.distances[peak]:.3f}"
    rows.append(["first maximum of the pair distribution, nm", place, EXPERIMENT["peak"]])
    plan = runs[0].plan
    length = sum(float(np.ptp(run.log["Time (ps)"])) for run in runs)
    number = f"{len(runs)} runs" if len(runs) > 1 else "one run"
    title = f"{plan.title}, {number}, {length:.4g} ps in all"
    table(title, ("", "", "water, 298.15 K, 1 bar"), rows)
    if style.can_draw(REPORT):
        out.mkdir(parents=True, exist_ok=True)
        property_figure([run.samples for run in runs], title, out / "properties.png")
        REPORT.note(f"wrote {out / 'properties.png'}")


def _estimated(row: Row, run: Run) -> Estimate | None:
    try:
        return row.estimate(run)
    except properties.TooShortError as error:
        REPORT.note(f"{run.plan.out}: {error}")
        return None


def _corrected(runs: Sequence[Run], found: Estimate, viscosity: float) -> list[str]:
    edge = float(np.mean([run.samples.volumes.mean() ** (1 / 3) for run in runs]))
    value = properties.without_finite_size(found, runs[0].plan.temperature, edge, viscosity)
    return [f"self-diffusion without the box, viscosity {viscosity:g} mPa s", str(value), EXPERIMENT["diffusion"]]


def read_runs(checkpoints: Sequence[Path], given: Path | None, skip: float) -> list[Run]:
    """Runs that differ in their seeds alone; arguments and errors as those of `properties_of`."""
    runs: list[Run] = []
    boxes: dict[tuple, Box] = {}
    for path in checkpoints:
        checkpoint = path / "run.chk" if path.is_dir() else path
        _, notes = records.read_checkpoint(checkpoint)
        plan = noted_plan(checkpoint, notes["plan"])
        if runs:
            _check_alike(plan, runs[0].plan, checkpoint, checkpoints[0])
        file = given or (None if plan.box is None else Path(plan.box))
        if file is None:
            raise RunError(f"{checkpoint} does not know its PDB file: name it with --box")
        key = (file, str(plan.forcefield), plan.constraints)
        if key not in boxes:
            boxes[key] = read_box(file, plan.forcefield, plan.constraints)
            REPORT.note(f"{file}: {describe(boxes[key])}")
        box = boxes[key]
        interval = plan.interval(plan.every) * plan.dt / 1000
        samples = read_samples(Path(plan.out), box, interval, skip)
        runs.append(Run(plan, _log(Path(plan.report), skip), samples, box.topology.getNumResidues()))
    return runs


def _check_alike(plan: Plan, first: Plan, checkpoint: Path, reference: Path) -> None:
    for name in CONTINUED:
        if name in ("seed", "out", "report", "bodies", "bodies_every", "checkpoint_every"):
            continue
        if getattr(plan, name) != getattr(first, name):
            raise RunError(
                f"{checkpoint} has {name} {getattr(plan, name)}, {reference} has {getattr(first, name)}: properties "
                "are pooled over runs that differ in their seeds alone"
            )


def _log(path: Path, skip: float) -> dict[str, np.ndarray]:
    log = records.read_log(path)
    kept = log["Time (ps)"] >= skip
    if kept.sum() < 2:
        raise RunError(f"{path} has no rows after {skip:g} ps")
    return {name: values[kept] for name, values in log.items()}
