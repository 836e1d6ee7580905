"""Temperatures of rotations and translations by integrator and step.

    python -m studies.equipartition [BOX.pdb] [--ensemble nvt] [--methods verlet sier2] [--dt 1 2]

compares T_trans, T_rot, mean potential energy and density with OpenMM's integrators and ours. Each run is kept in
equipartition.jsonl as soon as it is done, and is not repeated: commands with other methods, steps, seeds or lengths and
one `--out` add to the same table. Writes equipartition.json and equipartition.png from all runs there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import openmm
import pandas as pd
from openmm import unit

from openmm_sier.analysis.statistics import mean_and_error, slope_and_error
from openmm_sier.dynamics.schemes import SIER2
from openmm_sier.inputs.equilibration import make_context
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.observe.conservation import density
from studies import records, sampling, style, text
from studies.command import chosen, command
from studies.methods import CONSTANT_ENERGY, Bath, Method, with_bath
from studies.records import Record, Task
from studies.report import SILENT, Report
from studies.sampling import GridSettings, Liquid, Unstable, follow

#: Samples of the forces that predict the bias, steps of SIER2 before each, and their length in ps.
FORCE_SAMPLES, FORCE_INTERVAL, FORCE_STEP = 20, 10, 0.001

#: What is measured, each with its standard error: temperatures in K, kJ/mol, g/cm^3.
MEASURED = ("translation", "rotation", "difference", "potential", "density")

COLUMNS = text.columns(
    "method", "step", "fs_per_force", "time", "translation", "rotation", "difference", "predicted", "density"
) | {"V per body/kJ/mol": "{potential_text}"}


@dataclass(frozen=True, kw_only=True)
class EquipartitionSettings(GridSettings):
    """Settings of the comparison.

    Attributes:
        dt: simulated time per force evaluation, fs.
        methods: by name; all of the ensemble unless given.
        ensemble: of the runs.
        settle: start of every run that is left out, ps.
        friction: of heat baths, 1/ps.
        pressure: bar.
    """

    dt: tuple[float, ...] = (0.5, 1.0, 2.0, 3.0, 4.0)
    methods: tuple[str, ...] = ()
    ensemble: Literal["nve", "nvt", "npt"] = "nve"
    starts: int = 1
    time: float = 20.0
    equilibrate: float = 10.0
    settle: float = 2.0
    friction: float = 1.0
    pressure: float = 1.0

    ANY_SIGN: ClassVar[tuple[str, ...]] = ("pressure",)
    SHARED = ("box", "forcefield", "ensemble", "temperature", "equilibrate", "friction", "pressure")

    def known(self, seed: int) -> dict[str, Method]:
        """The methods of the ensemble, by name."""
        return CONSTANT_ENERGY if self.ensemble == "nve" else with_bath(Bath(self.temperature, self.friction), seed)


def run(task: Task) -> dict[str, Any]:
    """A run: what is `MEASURED`, the drift of the energy, `broken`, why it ended early, and `predicted`.

    The latter is the difference of the temperatures to leading order in the step, NaN where that is not known; see
    `studies.methods.Method`.
    """
    settings, seed, row = task.settings, task.point["seed"], dict(task.point)
    method, liquid = settings.known(seed)[task.method], settings.start(seed)
    # Forces are needed only where the method has a law (NaN is not above 0).
    slope = _slope(liquid) if method.bias > 0 else math.nan
    row["predicted"] = -method.bias * (1e-3 * row["step"]) ** 2 * slope
    surrounded = replace(liquid, system=_surrounded(liquid.system, settings))
    try:
        series = follow(surrounded, method, row["fs_per_force"], settings.time, settings.settle).series
    except Unstable as error:
        unknown = {name: math.nan for each in MEASURED for name in (each, f"{each}_error")}
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


def study(settings: EquipartitionSettings, report: Report = SILENT) -> Record:
    """Make the runs that are missing in the directory `out`, and write equipartition.json and equipartition.png.

    Raises:
        ValueError: a method is unknown, or the directory has runs of other settings.
    """
    times = settings.known(settings.seed)
    chosen(settings.methods, times, f"method of the {settings.ensemble} ensemble")
    tasks = []
    for name, dt, seed in product(settings.methods or times, settings.dt, settings.seeds):
        step = {"step": dt * times[name].forces, "fs_per_force": dt}
        tasks.append(Task(settings, {"method": times[name].name, **step, "time": settings.time, "seed": seed}, name))
    form = "{method} at {fs_per_force:g} fs per force: T_rot - T_trans = {difference_text} K"
    runs = records.all_runs(settings, "equipartition", tasks, run, report, form)
    rows = pooled(runs)
    title = f"Equipartition, {settings.ensemble.upper()}; velocities at whole steps"
    report.table(title, text.table(rows, COLUMNS))
    record = Record(settings.shared(), {"rows": rows, "runs": runs}, {}).write(settings.out / "equipartition.json")
    figure(record, settings.out / "equipartition.png")
    return record


def figure(record: Record, path: Path) -> None:
    """T_rot - T_trans against the step per force evaluation, one line per method, and the prediction for SIER2."""
    rows = record.tables["rows"]
    with style.figure(path, 1) as (_, (axes,)):
        style.curves(axes, rows, "fs_per_force", "difference", apart=0.05)
        measured = rows[rows["predicted"] < 0]
        if len(measured):
            h = np.linspace(0, measured["fs_per_force"].max(), 100)
            law = (measured["predicted"] / measured["fs_per_force"] ** 2).mean() * h**2
            axes.plot(h, law, color=style.GREY, lw=1, ls=":", label="SIER2, predicted", zorder=0)
        axes.axhline(0, color=style.GREY, lw=1)
        axes.set(xlabel="simulated time per force evaluation (fs)", ylabel=r"$T_\mathrm{rot} - T_\mathrm{trans}$ (K)")
        ensemble = record.settings["ensemble"].upper()
        title = f"Rotations are too cold at second order, not at fourth\n(liquid water, {ensemble})"
        axes.set_title(title, fontweight="bold")
        axes.legend()


main = command(EquipartitionSettings, study, __doc__, __name__)
