"""Temperatures of rotations and translations by integrator: the comparison behind `openmm-sier equipartition`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.schemes import SIER2
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.measure import sampling
from openmm_sier.measure.forcefields import read_box
from openmm_sier.measure.observables import energy_drift
from openmm_sier.measure.report import SILENT, Report, Table
from openmm_sier.measure.starts import equilibrated, make_context
from openmm_sier.measure.statistics import mean_and_error
from openmm_sier.observe.conservation import density
from openmm_sier.system.find_bodies import RigidBodies
from openmm_sier.version import __version__
from studies import figures, style

#: Time in fs between two samples. Water's angular velocities decorrelate in some 20 fs.
INTERVAL = 12.0

#: Start of every run that is left out, ps.
SETTLING = 2.0

#: Samples of the forces that predict the bias, steps of SIER2 before each, and their length in ps.
FORCE_SAMPLES, FORCE_INTERVAL, FORCE_STEP = 20, 10, 0.001

#: The file of the numbers.
FILE = "equipartition.json"


@dataclass(frozen=True)
class EquipartitionSettings:
    """Settings of the comparison. Times in ps; steps per force evaluation in fs; seeds of replicas follow the first."""

    box: Path
    forcefield: list[str] | None = None
    dt: tuple[float, ...] = (0.5, 1.0, 2.0, 3.0, 4.0)
    methods: tuple[str, ...] | None = None
    ensemble: str = "nve"
    time: float = 20.0
    equilibrate: float = 10.0
    temperature: float = 297.0
    friction: float = 1.0
    pressure: float = 1.0
    seed: int = 1
    replicas: int = 1
    platform: str | None = None


@dataclass(frozen=True)
class Row:
    """One method at one step; temperatures in K, energies in kJ/mol, density in g/cm^3, each mean with standard error.

    Attributes:
        fs_per_force: step over its number of force evaluations.
        broken: why the run ended early; the means are NaN then.
        predicted: the difference to leading order in the step, NaN where that is not known; see
            `openmm_sier.measure.sampling.Method`.
    """

    method: str
    step: float
    fs_per_force: float
    time: float
    translation: tuple[float, float]
    rotation: tuple[float, float]
    difference: tuple[float, float]
    potential: tuple[float, float]
    density: tuple[float, float]
    drift: float
    broken: str = ""
    predicted: float = float("nan")

    @property
    def resolution(self) -> float:
        """The difference over its standard error."""
        return abs(self.difference[0]) / self.difference[1]


def compare(settings: EquipartitionSettings, report: Report = SILENT) -> list[Row]:
    """Run every method at every step from equilibrated starts, one for each replica, and pool the replicas."""
    methods(settings)
    box = read_box(settings.box, settings.forcefield)
    bodies = RigidBodies.from_system(box.system, box.topology)
    system = openmm.XmlSerializer.clone(box.system)
    system.addForce(openmm.CMMotionRemover())
    if settings.ensemble == "npt":
        system.addForce(openmm.MonteCarloBarostat(settings.pressure * unit.bar, settings.temperature))
    rows = []
    for seed in range(settings.seed, settings.seed + settings.replicas):
        mine = replace(settings, seed=seed)
        for barostat in (force for force in system.getForces() if isinstance(force, openmm.MonteCarloBarostat)):
            barostat.setRandomNumberSeed(seed)
        start = equilibrated(box, mine.temperature, mine.seed, mine.equilibrate, mine.platform, report)
        chosen = methods(mine)
        # Forces are needed only where some method has a law (NaN is not above 0).
        lawful = any(method.bias > 0 for method in chosen)
        slope = _slope(box.system, bodies, start, mine) if lawful else float("nan")
        for method in chosen:
            for dt in settings.dt:
                row = _run_method(method, dt, system, bodies, start, mine, report)
                rows.append(replace(row, predicted=-method.bias * (1e-3 * row.step) ** 2 * slope))
                report.note(_line(rows[-1]))
    return pooled(rows)


def _slope(system: openmm.System, bodies: RigidBodies, start: openmm.State, settings: EquipartitionSettings) -> float:
    """Excess steepness of the potential for rotations: the difference of `sampling.steepness`, K/ps^2."""
    context = make_context(system, SIERIntegrator(FORCE_STEP, SIER2, bodies), settings.platform)
    context.setState(start)
    translation, rotation = sampling.steepness(context, bodies, FORCE_SAMPLES, FORCE_INTERVAL)
    return rotation - translation


def pooled(rows: list[Row]) -> list[Row]:
    """One row for each method and step, the runs weighted by their lengths; independent errors add up in squares."""
    groups: dict[tuple, list[Row]] = {}
    for row in rows:
        groups.setdefault((row.method, row.step, row.fs_per_force), []).append(row)
    return [_pool_of(group) for group in groups.values()]


def _pool_of(rows: list[Row]) -> Row:
    if len(rows) == 1:
        return rows[0]
    if broken := [row for row in rows if row.broken]:
        return broken[0]
    times = np.array([row.time for row in rows])
    weights = times / times.sum()

    def together(name: str) -> tuple[float, float]:
        means, errors = np.array([getattr(row, name) for row in rows]).T
        return float(weights @ means), float(np.sqrt(((weights * errors) ** 2).sum()))

    names = ("translation", "rotation", "difference", "potential", "density")
    means: dict[str, Any] = {name: together(name) for name in names}
    drift = float(weights @ [row.drift for row in rows])
    known = [row.predicted for row in rows if not np.isnan(row.predicted)]
    predicted = float(np.mean(known)) if known else float("nan")
    return replace(rows[0], time=float(times.sum()), drift=drift, predicted=predicted, **means)


def methods(settings: EquipartitionSettings) -> list[sampling.Method]:
    """The methods that the settings name; all of their ensemble where they name none.

    Raises:
        ValueError: a name is unknown.
    """
    known = (
        sampling.nve_methods()
        if settings.ensemble == "nve"
        else sampling.nvt_methods(settings.temperature, settings.friction, settings.seed)
    )
    chosen = settings.methods or tuple(known)
    for name in chosen:
        if name not in known:
            raise ValueError(
                f"unknown method {name!r} in the {settings.ensemble} ensemble; known are {', '.join(known)}"
            )
    return [known[name] for name in chosen]


def _run_method(
    method: sampling.Method,
    dt: float,
    system: openmm.System,
    bodies: RigidBodies,
    start: openmm.State,
    settings: EquipartitionSettings,
    report: Report,
) -> Row:
    step = dt * method.force_evaluations
    integrator = method.make(1e-3 * step)
    integrator.setConstraintTolerance(sampling.CONSTRAINT_TOLERANCE)
    context = make_context(system, integrator, settings.platform)
    context.setState(start)
    steps = max(1, round(settings.time * 1e3 / step))
    every = min(steps, max(1, round(INTERVAL / step)))
    try:
        with report.progress(f"{method.name}, {dt:g} fs per force", steps, 1e-3 * step) as show:
            integrator.step(round(SETTLING * 1e3 / step))
            series = sampling.sample(context, bodies, steps, every, show)
    except (sampling.Unstable, openmm.OpenMMException) as error:
        none = (float("nan"), float("nan"))
        return Row(method.name, step, dt, settings.time, none, none, none, none, none, float("nan"), str(error))
    return Row(
        method.name,
        step,
        dt,
        settings.time,
        mean_and_error(series.translation),
        mean_and_error(series.rotation),
        mean_and_error(series.rotation - series.translation),
        mean_and_error(series.potential / bodies.n),
        mean_and_error(density(bodies.masses.sum(), series.volume)),
        energy_drift(series.time, series.total)[0],
    )


def _line(row: Row) -> str:
    if row.broken:
        return f"{row.method} at {row.fs_per_force:g} fs per force: unstable ({row.broken})"
    return (
        f"{row.method} at {row.fs_per_force:g} fs per force: T_rot - T_trans = "
        f"{row.difference[0]:+.2f} +- {row.difference[1]:.2f} K"
    )


def run(settings: EquipartitionSettings, out: Path, report: Report = SILENT) -> list[Row]:
    """Compare, and write equipartition.json and, with matplotlib, equipartition.png to a directory.

    Args:
        settings: what is compared.
        out: the directory, which is made if it does not exist.
        report: gets the table, notes and progress.
    """
    out.mkdir(parents=True, exist_ok=True)
    rows = compare(settings, report)
    _publish(rows, asdict(settings) | {"box": settings.box.name}, out, report)
    return rows


def pool(directories: Sequence[Path], out: Path, report: Report = SILENT) -> list[Row]:
    """Pool the runs of earlier comparisons, and write what `run` does.

    Args:
        directories: of these comparisons, all with the same box, ensemble, temperature, friction and pressure.
        out: directory for the result.
        report: gets the table and notes.

    Raises:
        ValueError: two of them were made with different settings, or have runs with the same seed.
    """
    records = [json.loads((directory / FILE).read_text()) for directory in directories]
    for directory, record in zip(directories, records, strict=True):
        for name in ("box", "forcefield", "ensemble", "temperature", "friction", "pressure"):
            if (one := record["settings"][name]) != (other := records[0]["settings"][name]):
                raise ValueError(
                    f"{directory} and {directories[0]} cannot be pooled: their settings of {name} are {one} and {other}"
                )
    _refuse_repetitions(directories, records)
    out.mkdir(parents=True, exist_ok=True)
    rows = pooled([row for directory in directories for row in load(directory / FILE)])
    settings = records[0]["settings"] | {"pooled": [record["settings"] for record in records]}
    _publish(rows, settings, out, report)
    return rows


def _refuse_repetitions(directories: Sequence[Path], records: Sequence[dict[str, Any]]) -> None:
    """Raise ValueError where a run would count twice as if it were independent."""
    seen: dict[tuple, Path] = {}
    for directory, record in zip(directories, records, strict=True):
        for settings in record["settings"].get("pooled", [record["settings"]]):
            seeds = range(settings["seed"], settings["seed"] + settings.get("replicas", 1))
            for key in {(row["method"], row["step"], seed) for row in record["rows"] for seed in seeds}:
                if seen.setdefault(key, directory) is not directory:
                    raise ValueError(
                        f"{directory} and {seen[key]} cannot be pooled: both have {key[0]} at {key[1]:g} fs with seed "
                        f"{key[2]}, which is one run and not two"
                    )


def _publish(rows: list[Row], settings: dict, out: Path, report: Report) -> None:
    report.table(table(rows, settings["ensemble"]))
    for row in rows:
        if row.broken:
            report.note(f"{row.method} at {row.fs_per_force:g} fs per force broke down: {row.broken}")
    record = {"version": __version__, "openmm": openmm.__version__, "settings": settings}
    record["rows"] = [asdict(row) for row in rows]
    (out / FILE).write_text(json.dumps(record, indent=1, default=str))
    if style.can_draw(report):
        figures.equipartition_figure(rows, settings["ensemble"], out / "equipartition.png")


def load(path: Path) -> list[Row]:
    """Rows that `run` wrote."""
    rows: list[dict[str, Any]] = json.loads(path.read_text())["rows"]
    return [Row(**dict[str, Any]((k, tuple(v) if isinstance(v, list) else v) for k, v in row.items())) for row in rows]


def table(rows: list[Row], ensemble: str) -> Table:
    """The rows as text."""

    def cell(pair: tuple[float, float], digits: int) -> str:
        return "-" if np.isnan(pair[0]) else f"{pair[0]:.{digits}f} ± {pair[1]:.{digits}f}"

    return Table(
        f"Equipartition, {ensemble.upper()}; velocities at whole steps",
        [
            "method",
            "step/fs",
            "fs per force",
            "ps",
            "T_trans/K",
            "T_rot/K",
            "T_rot - T_trans/K",
            "predicted",
            "V per body/kJ/mol",
            "g/cm³",
        ],
        [
            [
                row.method,
                f"{row.step:g}",
                f"{row.fs_per_force:g}",
                f"{row.time:g}",
                cell(row.translation, 1),
                cell(row.rotation, 1),
                cell(row.difference, 2),
                "-" if np.isnan(row.predicted) else f"{row.predicted:.2f}",
                cell(row.potential, 3),
                cell(row.density, 4),
            ]
            for row in rows
        ],
    )
