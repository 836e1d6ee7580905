"""Temperatures of rotations and translations by integrator and step.

    python -m studies.equipartition [BOX.pdb] [--ensemble nvt] [--methods verlet sier2] [--dt 1 2]
    python -m studies.equipartition --pool DIR DIR

compares T_trans, T_rot, mean potential energy and density with OpenMM's integrators and ours, or pools what earlier
comparisons wrote, and writes equipartition.json and equipartition.png.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import openmm
import pandas as pd
from openmm import unit

from openmm_sier.dynamics.schemes import SIER2
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.measure.starts import make_context
from openmm_sier.measure.statistics import mean_and_error, slope_and_error
from openmm_sier.observe.conservation import density
from studies import records, sampling, style
from studies.command import BoxSettings, chosen, command
from studies.methods import CONSTANT_ENERGY, Method, with_bath
from studies.records import Record
from studies.report import SILENT, Report
from studies.sampling import Liquid, Unstable, equilibrated_liquid, follow

#: Start of every run that is left out, ps.
SETTLING = 2.0

#: Samples of the forces that predict the bias, steps of SIER2 before each, and their length in ps.
FORCE_SAMPLES, FORCE_INTERVAL, FORCE_STEP = 20, 10, 0.001

#: The file of the numbers.
FILE = "equipartition.json"

#: Settings that comparisons must share to be pooled.
SHARED = ("box", "forcefield", "ensemble", "temperature", "friction", "pressure")

#: What is measured, each with its standard error: temperatures in K, kJ/mol, g/cm^3.
MEASURED = ("translation", "rotation", "difference", "potential", "density")

COLUMNS = {
    "method": "{method}",
    "step/fs": "{step:g}",
    "fs per force": "{fs_per_force:g}",
    "ps": "{time:g}",
    "T_trans/K": "{translation:.1f} ± {translation_error:.1f}",
    "T_rot/K": "{rotation:.1f} ± {rotation_error:.1f}",
    "T_rot - T_trans/K": "{difference:.2f} ± {difference_error:.2f}",
    "predicted": "{predicted:.2f}",
    "V per body/kJ/mol": "{potential:.3f} ± {potential_error:.3f}",
    "g/cm³": "{density:.4f} ± {density_error:.4f}",
}


@dataclass(frozen=True)
class EquipartitionSettings(BoxSettings):
    """Settings of the comparison.

    Attributes:
        dt: simulated time per force evaluation, fs.
        methods: by name; all of the ensemble unless given.
        ensemble: of the runs.
        time: of each run, ps.
        equilibrate: before them, ps.
        friction: of heat baths, 1/ps.
        pressure: bar.
        replicas: runs of each, with seeds that follow the first.
        pool: directories of earlier comparisons, which are pooled instead of making runs.
    """

    dt: tuple[float, ...] = (0.5, 1.0, 2.0, 3.0, 4.0)
    methods: tuple[str, ...] = ()
    ensemble: Literal["nve", "nvt", "npt"] = "nve"
    time: float = 20.0
    equilibrate: float = 10.0
    friction: float = 1.0
    pressure: float = 1.0
    replicas: int = 1
    pool: tuple[Path, ...] = ()

    ANY_SIGN: ClassVar[tuple[str, ...]] = ("pressure",)


def compare(settings: EquipartitionSettings, report: Report = SILENT) -> pd.DataFrame:
    """Run every method at every step from equilibrated starts, one for each replica, and pool the replicas.

    Returns:
        A row for each method and step, with what is `MEASURED`, the drift of the energy, `broken`, why the run ended
        early, and `predicted`, the difference of the temperatures to leading order in the step, NaN where that is not
        known; see `studies.methods.Method`.

    Raises:
        ValueError: a method is unknown.
    """
    rows = []
    for seed in range(settings.seed, settings.seed + settings.replicas):
        mine = replace(settings, seed=seed)
        known = CONSTANT_ENERGY
        if mine.ensemble != "nve":
            known = with_bath(mine.temperature, mine.friction, seed)
        methods = chosen(mine.methods, known, f"method of the {mine.ensemble} ensemble")
        liquid = equilibrated_liquid(mine, mine.equilibrate, report)
        # Forces are needed only where some method has a law (NaN is not above 0).
        slope = _slope(liquid) if any(method.bias > 0 for method in methods) else math.nan
        surrounded = replace(liquid, system=_surrounded(liquid.system, mine))
        for method in methods:
            for dt in mine.dt:
                row = _row(surrounded, method, dt, mine.time, report)
                rows.append(row | {"predicted": -method.bias * (1e-3 * row["step"]) ** 2 * slope})
                found = records.cell("T_rot - T_trans = {difference:+.2f} ± {difference_error:.2f} K", row)
                told = f"unstable ({row['broken']})" if row["broken"] else found
                report.note(f"{method.name} at {dt:g} fs per force: {told}")
    return pooled(pd.DataFrame(rows))


def _surrounded(system: openmm.System, settings: EquipartitionSettings) -> openmm.System:
    """A copy with its centre of mass at rest, and with a barostat at constant pressure."""
    system = openmm.XmlSerializer.clone(system)
    system.addForce(openmm.CMMotionRemover())
    if settings.ensemble == "npt":
        barostat = openmm.MonteCarloBarostat(settings.pressure * unit.bar, settings.temperature)
        barostat.setRandomNumberSeed(settings.seed)
        system.addForce(barostat)
    return system


def _slope(liquid: Liquid) -> float:
    """Excess steepness of the potential for rotations: the difference of `sampling.steepness`, K/ps^2."""
    context = make_context(liquid.system, SIERIntegrator(FORCE_STEP, SIER2, liquid.bodies), liquid.platform)
    context.setState(liquid.start)
    translation, rotation = sampling.steepness(context, liquid.bodies, FORCE_SAMPLES, FORCE_INTERVAL)
    return rotation - translation


def _row(liquid: Liquid, method: Method, dt: float, time: float, report: Report) -> dict[str, Any]:
    row: dict[str, Any] = {"method": method.name, "step": dt * method.forces, "fs_per_force": dt, "time": time}
    unknown = {name: math.nan for each in MEASURED for name in (each, f"{each}_error")}
    try:
        series = follow(liquid, method, dt, time, SETTLING, report).series
    except Unstable as error:
        return row | unknown | {"drift": math.nan, "broken": str(error)}
    measured = (
        series.translation,
        series.rotation,
        series.rotation - series.translation,
        series.potential / liquid.bodies.n,
        density(liquid.bodies.masses.sum(), series.volume),
    )
    for name, values in zip(MEASURED, measured, strict=True):
        row[name], row[f"{name}_error"], _ = mean_and_error(values)
    return row | {"drift": slope_and_error(series.time, series.total).value, "broken": ""}


def pooled(rows: pd.DataFrame) -> pd.DataFrame:
    """One row for each method and step, the runs weighted by their lengths; independent errors add up in squares."""
    return pd.DataFrame([_pool(group) for _, group in rows.groupby(["method", "step"], sort=False)])


def _pool(rows: pd.DataFrame) -> dict[str, Any]:
    first = rows.iloc[0].to_dict()
    if len(rows) == 1:
        return first
    if (broken := rows[rows["broken"] != ""]).size:
        return broken.iloc[0].to_dict()
    weights = rows["time"] / rows["time"].sum()
    for name in (*MEASURED, "drift"):
        first[name] = float((weights * rows[name]).sum())
    for name in MEASURED:
        first[f"{name}_error"] = float(np.sqrt(((weights * rows[f"{name}_error"]) ** 2).sum()))
    return first | {"time": float(rows["time"].sum()), "predicted": float(rows["predicted"].mean())}


def pool(directories: Sequence[Path]) -> Record:
    """The runs of earlier comparisons together.

    Args:
        directories: of these comparisons, all with the same `SHARED` settings.

    Raises:
        ValueError: two of them were made with different settings, or have runs with the same seed.
    """
    found = [records.read(directory / FILE) for directory in directories]
    for directory, record in zip(directories, found, strict=True):
        for name in SHARED:
            if (one := record.settings[name]) != (other := found[0].settings[name]):
                raise ValueError(
                    f"{directory} and {directories[0]} cannot be pooled: their settings of {name} are {one} and {other}"
                )
    _refuse_repetitions(directories, found)
    rows = pooled(pd.concat([record.tables["rows"] for record in found]))
    return Record(found[0].settings, {"rows": rows}, {"pooled": [record.settings for record in found]})


def _refuse_repetitions(directories: Sequence[Path], found: Sequence[Record]) -> None:
    """Raise ValueError where a run would count twice as if it were independent."""
    seen: dict[tuple, Path] = {}
    for directory, record in zip(directories, found, strict=True):
        for settings in record.notes.get("pooled", [record.settings]):
            seeds = range(settings["seed"], settings["seed"] + settings["replicas"])
            runs = set(record.tables["rows"][["method", "step"]].itertuples(index=False, name=None))
            for key in ((*run, seed) for run in runs for seed in seeds):
                if seen.setdefault(key, directory) is not directory:
                    raise ValueError(
                        f"{directory} and {seen[key]} cannot be pooled: both have {key[0]} at {key[1]:g} fs with seed "
                        f"{key[2]}, which is one run and not two"
                    )


def study(settings: EquipartitionSettings, report: Report = SILENT) -> Record:
    """Compare or pool, and write equipartition.json and equipartition.png."""
    if settings.pool:
        record = pool(settings.pool)
    else:
        record = Record(settings.recorded(), {"rows": compare(settings, report)}, {})
    title = f"Equipartition, {record.settings['ensemble'].upper()}; velocities at whole steps"
    report.table(records.table(title, record.tables["rows"], COLUMNS))
    record.write(settings.out / FILE)
    figure(record, settings.out / "equipartition.png")
    return record


def figure(record: Record, path: Path) -> None:
    """T_rot - T_trans against the step per force evaluation, one line per method, and the prediction for SIER2."""
    rows = record.tables["rows"]
    with style.figure(path, 1) as (_, (axes,)):
        style.curves(axes, rows, "fs_per_force", "difference", apart=0.05)
        known = rows[rows["predicted"] < 0]
        if len(known):
            h = np.linspace(0, known["fs_per_force"].max(), 100)
            law = (known["predicted"] / known["fs_per_force"] ** 2).mean() * h**2
            axes.plot(h, law, color=style.GREY, lw=1, ls=":", label="SIER2, predicted", zorder=0)
        axes.axhline(0, color=style.GREY, lw=1)
        axes.set(xlabel="simulated time per force evaluation (fs)", ylabel=r"$T_\mathrm{rot} - T_\mathrm{trans}$ (K)")
        ensemble = record.settings["ensemble"].upper()
        title = f"Rotations are too cold at second order, not at fourth\n(liquid water, {ensemble})"
        axes.set_title(title, fontweight="bold")
        axes.legend()


main = command(EquipartitionSettings, study, __doc__, __name__)
