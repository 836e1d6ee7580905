"""The command `openmm-sier properties`: properties of a liquid from runs, beside experiment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from openmm_sier.cli.console import REPORT, table
from openmm_sier.cli.files.records import RecordError
from openmm_sier.cli.finished_runs import FinishedRun, check_alike, open_runs
from openmm_sier.cli.plan import Plan, RunError
from openmm_sier.dynamics.constants import BAR
from openmm_sier.measure import properties
from openmm_sier.measure.figures import Curve, can_draw, property_curves, property_figure
from openmm_sier.measure.forcefields import Box, describe
from openmm_sier.measure.inputs import read_input
from openmm_sier.measure.liquid_samples import LiquidSamples, NoLiquidError, molecules_of_liquid, read_samples
from openmm_sier.measure.statistics import Estimate, mean_and_error, pooled
from openmm_sier.observe import conservation, pressure

#: Columns of the log.
TRANSLATION, ROTATION, FLEXIBLE = conservation.TEMPERATURES


class Row(NamedTuple):
    """A property.

    Attributes:
        key: by which it is known.
        name: with the unit.
        estimate: how a run gives it.
        water: its value in water.
        of_motion: whether it needs motion.
        of_liquid: whether it is one of a liquid of one kind of molecule; otherwise any box has it.
    """

    key: str
    name: str
    estimate: Callable[[Run], Estimate | None]
    water: str = ""
    of_motion: bool = False
    of_liquid: bool = True


class Run(NamedTuple):
    """A finished run.

    Attributes:
        plan: of the command.
        log: columns of the log, without the skipped part.
        samples: of the trajectory; None where the box is not a liquid of one kind of molecule.
        molecules: their number.
        tensors: columns of the file of pressure tensors, without the skipped part; None where there is no file.
    """

    plan: Plan
    log: dict[str, np.ndarray]
    samples: LiquidSamples | None
    molecules: int
    tensors: dict[str, np.ndarray] | None

    @property
    def temperature(self) -> float:
        """K, of the heat bath; the mean temperature where there is no bath."""
        nve = self.plan.ensemble == "nve"
        return float(self.log["Temperature (K)"].mean()) if nve else self.plan.temperature

    @property
    def liquid(self) -> LiquidSamples:
        """The samples of a run that has some."""
        if self.samples is None:
            raise RunError(f"{self.plan.out} is not that of a liquid of one kind of molecule")
        return self.samples

    @property
    def stress(self) -> tuple[np.ndarray, float, float, float]:
        """The arguments of `measure.properties.shear_viscosity`."""
        columns = self.tensors or {}
        tensors = np.stack([columns[name] for name in pressure.COLUMNS[2:-1]], axis=1)
        interval = self.plan.interval(self.plan.pressure_tensor_every) * self.plan.step_time
        return tensors, interval, float(columns["Box Volume (nm^3)"].mean()), self.temperature


def _temperature(run: Run) -> Estimate | None:
    """The mean temperature, where there is no heat bath."""
    return mean_and_error(run.log["Temperature (K)"]) if run.plan.ensemble == "nve" else None


def _mean_column(column: str, run: Run) -> Estimate | None:
    """None where there is no such thing: points do not rotate, and without a box there is no density."""
    values = run.log[column]
    return mean_and_error(values) if np.isfinite(values).all() else None


def _energy_of_mixture(run: Run) -> Estimate | None:
    """None in a liquid of one kind, which has it for each molecule."""
    return mean_and_error(run.log["Potential Energy (kJ/mole)"]) if run.samples is None else None


def _capacity(run: Run) -> Estimate | None:
    """From the enthalpy where the volume changes; none without a heat bath."""
    energy, plan = run.log["Total Energy (kJ/mole)"], run.plan
    if plan.ensemble == "nve":
        return None
    if plan.moves_volume:
        energy = energy + (plan.pressure or 0.0) * BAR * run.log["Box Volume (nm^3)"]
    return properties.heat_capacity(energy, run.temperature, run.molecules)


def _vaporization(run: Run) -> Estimate:
    potential = mean_and_error(run.log["Potential Energy (kJ/mole)"])
    return properties.vaporization_enthalpy(potential, run.temperature, run.molecules)


def _dielectric(run: Run) -> Estimate | None:
    samples = run.liquid
    if samples.dipoles is None:
        return None
    return properties.dielectric_constant(samples.dipoles, samples.volumes, run.temperature)


def _diffusion(run: Run) -> Estimate:
    return properties.self_diffusion(run.liquid.centres, run.liquid.interval)


def _rotation(run: Run) -> Estimate:
    return properties.rotation_time(run.liquid.directions, run.liquid.interval)


def _maximum_of_pairs(which: int, run: Run) -> Estimate:
    return properties.maximum_of_pairs(run.liquid.distances, run.liquid.pairs_by_frame)[which]


def _viscosity(run: Run) -> Estimate | None:
    return None if run.tensors is None else properties.shear_viscosity(*run.stress)


#: Liquid water is at 298.15 K and 1 bar. Density, heat capacity, enthalpy of vaporization, dielectric constant and
#: viscosity are by the IAPWS formulations; self-diffusion of Holz et al., Phys. Chem. Chem. Phys. 2, 4740 (2000); the
#: first maximum of the O-O distribution of Skinner et al., J. Chem. Phys. 138, 074506 (2013).
ROWS = (
    Row("", "temperature, K", _temperature, of_liquid=False),
    Row("translation", "temperature of translation, K", partial(_mean_column, TRANSLATION), of_liquid=False),
    Row("rotation", "temperature of rotation, K", partial(_mean_column, ROTATION), of_liquid=False),
    Row("", "temperature of flexible molecules, K", partial(_mean_column, FLEXIBLE), of_liquid=False),
    Row("density", "density, g/cm³", partial(_mean_column, "Density (g/mL)"), "0.9970", of_liquid=False),
    Row("", "potential energy of the box, kJ/mol", _energy_of_mixture, of_liquid=False),
    Row(
        "energy",
        "potential energy, kJ/mol of molecules",
        lambda run: mean_and_error(run.log["Potential Energy (kJ/mole)"] / run.molecules),
    ),
    Row("vaporization", "enthalpy of vaporization, kJ/mol, rigid and without polarization", _vaporization, "43.99"),
    Row("capacity", "heat capacity (total energy or enthalpy), classical, J/mol/K", _capacity, "75.3"),
    Row("dielectric", "static dielectric constant", _dielectric, "78.4"),
    Row("viscosity", "shear viscosity, mPa s", _viscosity, "0.890", of_motion=True, of_liquid=False),
    Row("diffusion", "self-diffusion in the box, 10⁻⁹ m²/s", _diffusion, "2.30", of_motion=True),
    Row("", "rotational correlation time of second order, ps", _rotation, of_motion=True),
    Row("peak", "maximum of the pair distribution", partial(_maximum_of_pairs, 0), "2.57"),
    Row("peak distance", "its distance, nm", partial(_maximum_of_pairs, 1), "0.280"),
)


def properties_of(runs: Sequence[Path], box: Path | None, skip: float, viscosity: float | None, out: Path) -> None:
    """Run `openmm-sier properties`.

    Args:
        runs: their checkpoints or directories.
        box: the PDB file; None takes that of the checkpoints.
        skip: ps to leave out at the beginning of each run.
        viscosity: mPa s, for the size correction of diffusion; None takes that of the runs, if they give one.
        out: directory for the figure.

    Raises:
        RunError: runs differ in more than the seed and the length.
        RecordError, OSError: as their messages say.
    """
    found = read_runs(open_runs(runs), box, skip)
    moving = found[0].plan.ensemble != "hmc"
    if not moving:
        REPORT.note("trials of hybrid Monte Carlo are no motion: they give no diffusion, viscosity and rotation")
    rows, stressed = _rows(found, None if viscosity is None else Estimate(viscosity, 0.0))
    title = title_of(found)
    table(title, ("", "", "water, 298.15 K, 1 bar"), rows)
    curves = curves_of(found, stressed)
    if curves and can_draw(REPORT):
        out.mkdir(parents=True, exist_ok=True)
        property_figure(curves, title, out / "properties.png")
        REPORT.note(f"wrote {out / 'properties.png'}")


def title_of(runs: Sequence[Run]) -> str:
    """What was run, how often and for how long."""
    length = sum(float(np.ptp(run.log["Time (ps)"])) for run in runs)
    number = f"{len(runs)} runs" if len(runs) > 1 else "one run"
    return f"{runs[0].plan.title}, {number}, {length:.4g} ps in all"


def curves_of(runs: Sequence[Run], stressed: Sequence[Run]) -> dict[str, Curve]:
    """What the figure shows.

    Args:
        runs: all of them.
        stressed: those among them that give a viscosity.
    """
    samples = [run.samples for run in _written_as_often(runs) if run.samples is not None]
    viscosities = None
    if stressed:
        integrals = [properties.viscosity_integrals(*run.stress) for run in _written_as_often(stressed)]
        times = np.arange(integrals[0].shape[1]) * stressed[0].stress[1]
        viscosities = times, np.concatenate(integrals)
    return property_curves(samples, viscosities, runs[0].plan.ensemble != "hmc")


def _written_as_often(runs: Sequence[Run]) -> list[Run]:
    """The runs whose frames and pressures are as far apart as those of the first: a figure has one axis of time."""

    def intervals(run: Run) -> tuple[float, float]:
        return run.plan.every, run.plan.pressure_tensor_every

    return [run for run in runs if intervals(run) == intervals(runs[0])]


def _rows(runs: Sequence[Run], viscosity: Estimate | None) -> tuple[list[list[str]], list[Run]]:
    """Rows of the table, and the runs that gave a viscosity; one in mPa s that is given corrects diffusion instead."""
    rows, stressed = [], []
    for row in ROWS:
        found = estimated(row, runs)
        given = [estimate for estimate in found.values() if estimate is not None]
        if not given:
            continue
        value = pooled(given)
        rows.append([row.name, str(value), row.water])
        if row.key == "viscosity":
            stressed = [run for run in runs if found[run.plan.out] is not None]
            _note_tail(stressed)
            viscosity = viscosity or value
        if row.key == "diffusion" and viscosity is not None and viscosity.value > 2 * viscosity.error:
            name = f"self-diffusion without the box, viscosity {viscosity} mPa s"
            rows.append([name, str(_without_the_box(runs, value, viscosity)), row.water])
    return rows, stressed


def estimated(row: Row, runs: Sequence[Run]) -> dict[Path, Estimate | None]:
    """A property of each run, by trajectory; None where a run has none. Runs that are too short share a note."""
    found: dict[Path, Estimate | None] = {}
    short: dict[str, list[Path]] = {}
    for run in runs:
        found[run.plan.out] = None
        if (row.of_motion and run.plan.ensemble == "hmc") or (row.of_liquid and run.samples is None):
            continue
        try:
            found[run.plan.out] = row.estimate(run)
        except properties.TooShortError as error:
            short.setdefault(str(error), []).append(run.plan.out)
    for message, (first, *more) in short.items():
        REPORT.note(f"{first}{f' and {len(more)} more' if more else ''}: {message}")
    return found


def _note_tail(runs: Sequence[Run]) -> None:
    """Print a note if the Green-Kubo integral has not converged."""
    tail = pooled([properties.viscosity_tail(*run.stress) for run in runs])
    if tail.value > 3 * tail.error:
        REPORT.note(
            f"{tail} mPa s of the viscosity come from the second half of the {properties.MEMORY:g} ps to which the "
            "correlation of the pressure is integrated: this liquid relaxes more slowly, and its viscosity is higher"
        )


def _without_the_box(runs: Sequence[Run], diffusion: Estimate, viscosity: Estimate) -> Estimate:
    edge = float(np.mean([run.liquid.volumes.mean() ** (1 / 3) for run in runs]))
    return properties.without_finite_size(diffusion, runs[0].temperature, edge, viscosity)


def read_runs(runs: Sequence[FinishedRun], given: Path | None, skip: float) -> list[Run]:
    """Logs and trajectories of runs that may be pooled; arguments are those of `properties_of`."""
    names = [name for name in runs[0].settings() if given is None or name != "box"]
    for run in runs:
        check_alike(run, runs[0], names, "properties are pooled over runs that differ in their seeds alone")
    file = given or (None if runs[0].plan.box is None else Path(runs[0].plan.box))
    if file is None:
        raise RunError(f"{runs[0].checkpoint} does not know its coordinates: name it with --box")
    plan = runs[0].plan
    box = read_input(file, plan.topology, plan.forcefield, plan.constraints, edges=plan.edges)
    REPORT.note(f"{file}: {describe(box)}")
    try:
        molecules_of_liquid(box)
    except NoLiquidError as error:
        REPORT.note(f"properties of molecules and of their motion are left out: {error}")
        return [Run(run.plan, run.log(skip), None, box.topology.getNumResidues(), run.tensors(skip)) for run in runs]
    return [_read(run, box, skip) for run in runs]


def _read(run: FinishedRun, box: Box, skip: float) -> Run:
    # Logs come first: they are quickly read, and tell whether a run still goes on.
    log, tensors = run.log(skip), run.tensors(skip)
    interval = run.plan.interval(run.plan.every) * run.plan.step_time
    samples = read_samples(Path(run.plan.out), box, interval, skip)
    frames, noted = len(samples.volumes) + round(skip / interval), run.notes["trajectory"]["count"]
    if frames != noted:
        raise RecordError(f"{run.plan.out} has {frames} frames, {run.checkpoint} notes {noted}")
    return Run(run.plan, log, samples, box.topology.getNumResidues(), tensors)
