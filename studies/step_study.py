"""Properties of a liquid against the step, from runs of `openmm-sier run` at constant pressure.

    python -m studies.step_study
    python -m studies.step_study --methods hmc --per-force 3 2 --times 44 30
    python -m studies.step_study --boxes tip3p-512 --methods sier2p3 --per-force 5 --times 50 --out long-steps

Density, energy, diffusion and temperatures by box, method and step, with standard errors, and how far density and
energy are from the exact averages of hybrid Monte Carlo, and diffusion from that at the shortest step. Each run has a
directory in `--out`, and its numbers are kept in step-study.jsonl: it is not repeated, and runs of other calls count in
the same tables. Runs that differ in their seeds alone count as one. Runs take turns on `--processes` processes of one
thread each. Writes step-study.json and step-study.png.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, ClassVar

import mdtraj
import numpy as np
import pandas as pd

from openmm_sier.analysis import transport
from openmm_sier.analysis.statistics import Estimate, mean_and_error
from openmm_sier.cli.methods import METHODS
from studies import command_runs, records, style, text
from studies.command import SYSTEMS, RunsSettings, chosen, command
from studies.records import Record, Task
from studies.report import SILENT, Report

#: Properties by their keys in rows, with their names in the table and labels in the figure.
PROPERTIES = {
    "density": ("density, g/cm³", "density (g/cm³)"),
    "energy": ("potential energy, kJ/mol", "potential energy (kJ/mol)"),
    "diffusion": ("self-diffusion in the box, 10⁻⁹ m²/s", "self-diffusion (10⁻⁹ m²/s)"),
}

#: What follows from runs, with its heading in the table.
MEASURED = {"translation": "T_trans, K", "rotation": "T_rot, K"} | {key: name for key, (name, _) in PROPERTIES.items()}

COLUMNS = text.columns("box", "method", "step", "fs_per_force", "runs", "time") | {
    heading: f"{{{key}_text}}" for key, heading in MEASURED.items()
}

#: Columns of the log.
LOGGED = {
    "translation": "Translational Temperature (K)",
    "rotation": "Rotational Temperature (K)",
    "density": "Density (g/mL)",
    "energy": "Potential Energy (kJ/mole)",
}

#: What makes a point; its runs differ in their seeds alone.
POINT = ["box", "method", "step"]

#: ps between frames.
EVERY = 0.5

#: Options of all runs.
OPTIONS = {
    "pressure": 1.0,
    "every": EVERY,
    "report_every": 0.1,
    "checkpoint_every": 2.0,
    "platform": "CPU",
}

#: The method that is hybrid Monte Carlo, and its scheme.
TRIALS, SCHEME = "hmc", "sier4g"

#: What the figure says.
TITLE = "Verlet with AndersenThermostat leaves the exact averages;\nthe others stay near them (grey: two errors)"

#: What ends the name of a method whose averages have no error of the step.
EXACT = " HMC"

#: Left out of the reference: its bath heats the liquid at any step (`tests/system/test_openmm_heat_baths.py`).
HEATED = "OpenMM Verlet"

#: fs by which the points of different methods are shifted apart.
APART = 0.06


@dataclass(frozen=True, kw_only=True)
class StepSettings(RunsSettings):
    """Choose what is run.

    Attributes:
        boxes: of the repository, by name.
        methods: schemes of `openmm-sier run` at constant pressure, or hmc, by SIER4G.
        per_force: simulated times for a force evaluation, fs.
        times: of runs at each of them, ps.
        starts: runs of each kind, whose seeds follow `seed`.
        skip: ps to leave out at the beginning of each run.
    """

    boxes: tuple[str, ...] = ("spce-512", "tip3p-512", "tip4p2005-512")
    methods: tuple[str, ...] = ("langevinmiddle", "verlet", "sier2", "sier4g")
    per_force: tuple[float, ...] = (4.0, 3.0, 2.0, 1.0)
    times: tuple[float, ...] = (60.0, 44.0, 30.0, 20.0)
    starts: int = 1
    skip: float = 5.0

    ANY_SIGN: ClassVar[tuple[str, ...]] = ("skip",)
    SHARED = ("skip",)


def tasks(settings: StepSettings) -> Iterator[Task]:
    """Yield all runs that the settings ask for, seed by seed, long steps first."""
    chosen(settings.methods, METHODS | {TRIALS: None}, "method")
    seeds = range(settings.seed, settings.seed + settings.starts)
    lengths = zip(settings.per_force, settings.times, strict=True)
    for seed, (per_force, length), box, name in product(seeds, lengths, settings.boxes, settings.methods):
        method = METHODS[SCHEME if name == TRIALS else name]
        step = per_force * (method.scheme.force_evaluations if method.scheme else 1)
        point = {"box": box, "method": method.name + (EXACT if name == TRIALS else ""), "step": step, "seed": seed}
        yield Task(settings, point | {"length": length, "fs_per_force": per_force}, name)


def run(task: Task) -> dict[str, Any]:
    """Return the properties of a run; unknown ones are NaN."""
    step, seed, skip = task.point["step"], task.point["seed"], task.settings.skip
    directory = task.settings.out / f"{task.point['box']}-{task.method}-{step:g}fs-seed{seed}"
    box = SYSTEMS / f"{task.point['box']}.pdb"
    # Of ten steps, as those of the record.
    trials = {"scheme": SCHEME, "ensemble": "hmc", "steps_per_trial": 10}
    method = trials if task.method == TRIALS else {"scheme": task.method, "ensemble": "npt"}
    command_runs.carry_out(directory, box, method | {"dt": step, "time": task.point["length"], "seed": seed} | OPTIONS)
    log = command_runs.read_log(directory, skip)
    frames = command_runs.read_frames(directory, box)
    estimates = {name: mean_and_error(log[column]) for name, column in LOGGED.items()}
    estimates["energy"] = estimates["energy"].times(1 / frames.n_residues)
    # Momenta that are drawn anew tell no diffusion.
    if task.method != TRIALS:
        estimates["diffusion"] = diffusion(frames, 1e-3 * step, skip)
    row = task.point | {"time": float(np.ptp(log["Time (ps)"]))}
    for name, estimate in estimates.items():
        row |= {name: estimate.value, f"{name}_error": estimate.error}
    return row


def diffusion(frames: mdtraj.Trajectory, step: float, skip: float) -> Estimate:
    """Return the self-diffusion in the box, 10^-9 m^2/s, by the first atoms of molecules; NaN for short runs.

    Args:
        frames: of the run.
        step: ps.
        skip: ps to leave out.
    """
    interval = step * round(EVERY / step)
    first = [residue.atom(0).index for residue in frames.topology.residues]
    masses = [atom.element.mass for atom in frames.topology.atoms]
    later = frames[round(skip / interval) :]
    paths = transport.unwrapped(later.xyz, later.unitcell_lengths, masses)
    try:
        return transport.self_diffusion(paths[:, first], interval)
    except transport.TooShortError:
        return Estimate(math.nan, math.nan)


def study(settings: StepSettings, report: Report = SILENT) -> Record:
    """Make the runs that are missing in the directory `out`, and write step-study.json and step-study.png.

    Raises:
        RunFailed: a run ended with an error.
        ValueError: there is no such method, or `per_force` and `times` are not of one length.
    """
    form = "{box}, {method}, {step:g} fs, seed {seed}: {density_text} g/cm³, {energy_text} kJ/mol"
    runs = records.all_runs(settings, "step-study", tasks(settings), run, report, form)
    rows = in_order(with_shared_errors(averaged(runs)))
    record = Record(settings.recorded(), {"rows": rows}, {})
    report.table("Water against the step, 297 K, 1 bar", text.table(rows, COLUMNS))
    differences = deviations(rows)
    for key, (name, _) in PROPERTIES.items():
        report.table(f"{name}, less the reference", beside_reference(differences, key))
    record.write(settings.out / "step-study.json")
    figure(record, settings.out / "step-study.png")
    return record


def averaged(runs: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each point; of a run that was made longer only the longer one counts."""
    longest = runs.sort_values("length").drop_duplicates([*POINT, "seed"], keep="last")
    rows = []
    for point, of_point in longest.groupby(POINT):
        row = dict(zip(POINT, point, strict=True)) | {"fs_per_force": of_point.iloc[0]["fs_per_force"]}
        rows.append(row | {"runs": len(of_point), "time": of_point["time"].sum()} | records.pooled(of_point, MEASURED))
    return pd.DataFrame(rows)


def with_shared_errors(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows whose errors fall as the root of their length, with one factor for each box, method and property.

    A run of a few correlation times underestimates the correlation, and so its own error. Liquids relax alike at all
    steps, except by hybrid Monte Carlo with shorter trials. So the square of the factor is the mean over rows of one
    box and method, weighted by their lengths.
    """
    rows = rows.copy()
    for _, alike in rows.groupby(["box", "method"]):
        for key in MEASURED:
            complete = alike.dropna(subset=[f"{key}_error"])
            if len(complete):
                square = np.average(complete["time"] * complete[f"{key}_error"] ** 2, weights=complete["time"])
                shared = (square / alike["time"]) ** 0.5
                rows.loc[alike.index, f"{key}_error"] = shared.where(alike[key].notna())
    return rows


def in_order(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows by box and method, in the order in which these first appear, and by step."""
    boxes, methods = (list(rows[name].unique()) for name in ("box", "method"))
    places = {"box": boxes.index, "method": methods.index, "fs_per_force": float}
    return rows.sort_values(list(places), key=lambda column: column.map(places[column.name]), ignore_index=True)


def deviations(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the differences of properties from the exact averages, by box.

    Hybrid Monte Carlo has no error of the step, so that the mean over its rows is exact. It has no dynamics: the
    diffusion is compared with the mean over the rows of the shortest step at which it is known, without those whose
    bath heats the liquid. Rows of a reference are chosen by their method and step, not by their results, and weighted
    by the inverse squares of their errors. What has no reference is left out.

    Returns:
        For each property, box, method and step the `reference` and its error, and the `difference` from it with that of
        the row alone; rows of which the reference is made have their own difference too.
    """
    tables = []
    for key in PROPERTIES:
        for _, of_box in rows.dropna(subset=[key]).groupby("box", sort=False):
            of = _reference(of_box[np.isfinite(of_box[f"{key}_error"])])
            if of.empty:
                continue
            weights = of[f"{key}_error"] ** -2
            mean, doubt = np.average(of[key], weights=weights), weights.sum() ** -0.5
            compared = of_box[["box", "method", "fs_per_force"]].assign(
                property=key, reference=mean, reference_error=doubt
            )
            tables.append(compared.assign(difference=of_box[key] - mean, difference_error=of_box[f"{key}_error"]))
    return pd.concat(tables, ignore_index=True)


def _reference(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of one box and property of which the reference is the mean."""
    exact = rows[rows["method"].str.endswith(EXACT)]
    cold = rows[rows["method"] != HEATED]
    return exact if len(exact) else cold[cold["fs_per_force"] == cold["fs_per_force"].min()]


def beside_reference(differences: pd.DataFrame, key: str) -> pd.DataFrame:
    """Return a table of text of the `deviations` of one property, with a line for each method and step.

    Errors have that of the reference in them.
    """
    differences = differences[differences["property"] == key]
    error = np.hypot(differences["difference_error"], differences["reference_error"])
    own_rows = differences.assign(
        box=differences["box"].replace(style.MODELS), value=differences["difference"], value_error=error
    )
    reference = own_rows.drop_duplicates("box").assign(method="reference", fs_per_force=text.UNKNOWN)
    reference = reference.assign(value=reference["reference"], value_error=reference["reference_error"])
    columns = text.columns("method", "fs_per_force") | {"{box}": "{value_text}"}
    return text.table(pd.concat([reference, own_rows]), columns)


def figure(record: Record, path: Path) -> None:
    """Draw a row of panels for each property and one for each box: differences from the exact averages, by step.

    The band is two errors of the reference, and so are the bars.
    """
    from matplotlib.figure import Figure

    differences = deviations(record.tables["rows"])
    differences = differences[~differences["method"].str.endswith(EXACT)].assign(
        difference_error=2 * differences["difference_error"]
    )
    boxes = list(differences["box"].unique())
    with style.context():
        picture = Figure(figsize=(3.1 * len(boxes) + 1, 0.9 + 2.4 * len(PROPERTIES)), layout="constrained")
        picture.suptitle(TITLE, x=0.01, ha="left", fontsize=16, fontweight="bold")
        grid = picture.subplots(len(PROPERTIES), len(boxes), squeeze=False, sharex=True, sharey="row")
        for key, line in zip(PROPERTIES, grid, strict=True):
            line[0].set_ylabel(f"Δ {PROPERTIES[key][1]}")
            for box, axes in zip(boxes, line, strict=True):
                of_box = differences[(differences["box"] == box) & (differences["property"] == key)]
                for doubt in of_box["reference_error"][:1]:
                    axes.axhspan(-2 * doubt, 2 * doubt, color="0.85", zorder=0)
                axes.axhline(0, color=style.GREY, lw=1)
                style.curves(axes, of_box, "fs_per_force", "difference", apart=APART, lw=1, capsize=0)
        for box, axes in zip(boxes, grid[0], strict=True):
            axes.set_title(style.MODELS.get(box, box))
        for axes in grid[-1]:
            axes.set_xlabel("fs per force")
        handles, labels = grid[0][0].get_legend_handles_labels()
        picture.legend(handles, labels, loc="outside lower center", ncols=max(1, len(labels)), fontsize=12)
        picture.savefig(path)


main = command(StepSettings, study, __doc__, __name__)
