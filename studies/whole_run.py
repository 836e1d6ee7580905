"""Energy conservation by scheme and step: energy error, random walk and drift, and temperatures of rotations.

    python -m studies.whole_run                                              64 molecules of TIP3P, every scheme
    python -m studies.whole_run --liquids TIP4P/2005 OPC --methods verlet sier4g --steps 1.5 4.5 6
    python -m studies.whole_run --molecules 512 --time 100 --methods sier4g --steps 4.5
    python -m studies.whole_run --molecules 512 --time 1 --starts 4 --per-force 1 2 3     errors within a picosecond
    python -m studies.whole_run --liquids BOX.pdb --methods verlet sier4g --time 20     rotations of your own liquid

The energy error is rms(H)/rms(V) about the mean of the whole run. The walk is the scatter of the means of H over 1 ps,
over rms(V). Verlet is compared with SIER4G at the same simulated time per force. Each run is kept in whole-run.jsonl as
soon as it is done, and is not repeated: a command that was stopped goes on where it was, and commands with other
liquids, methods, steps, sizes or lengths and one `--out` add to the same tables. Runs take turns on `--processes`
processes of one thread each. Writes whole-run.json and whole-run.png from all runs there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import openmm
import pandas as pd

from openmm_sier import prepare_system
from openmm_sier.analysis.statistics import mean_and_error
from openmm_sier.dynamics.schemes import CATALOGUE, SIER4G
from openmm_sier.inputs import forcefields
from openmm_sier.inputs.equilibration import make_context
from openmm_sier.prepare.pme import AT_CONSTANT_ENERGY
from openmm_sier.stability.step_rules import WATER
from openmm_sier.system import find_bodies
from studies import boxes, records, style, text
from studies.command import SYSTEMS, RunsSettings, chosen, command
from studies.experiment import Experiment, Made
from studies.frame import Liquid, conserved, equilibrated, over_starts
from studies.methods import CONSTANT_ENERGY
from studies.records import Record, Task

#: Liquids: the PDB file in `systems`, and a force field if it is not the one that the file names.
LIQUIDS: dict[str, tuple[str, ...]] = {
    "TIP3P": ("tip3p-512.pdb",),
    "SPC/E": ("spce-512.pdb",),
    "TIP4P/2005": ("tip4p2005-512.pdb",),
    "OPC": ("tip4p2005-512.pdb", "opc.xml"),
    "TIP5P": ("tip5p-512.pdb",),
    "peptide": ("peptide.pdb",),
}

#: fs between two samples of the energy. It is far below the 1 ps over which the walk is averaged.
INTERVAL = 24.0

#: Times in ps over which changes of H tell how fast it walks.
WALK_LAGS = (5, 20)

#: What a point of the table has in common; its runs differ in their seeds alone. `share` is the ratio of the tolerances
#: of PME's two sums, `prepare.pme.AT_CONSTANT_ENERGY`.
POINT = ["liquid", "molecules", "time", "tolerance", "share", "method", "step"]

PME = {"PME": "{tolerance:g}/{share:g}"}

COLUMNS = text.columns("liquid", "molecules", "time", "method", "step", "fs_per_force", "starts") | {
    "rms(H)/rms(V)/%": "{percent:.3g} ± {percent_error:.1g}",
    "walk/%": "{walk:.2g} ± {walk_error:.1g}",
    "drift of the box/kJ/mol/ps": "{drift:+.5f} ± {its_error:.5f}",
    **PME,
}

#: Of runs since it is kept.
WARMTH = {"T_rot - T_trans/K": "{difference_text}"}

GAINS = text.columns("liquid", "molecules", "time") | {
    **PME,
    "starts": "{starts}",
    "fs per force": "{per_force:.3g}",
    "OpenMM Verlet/%": "{percent_verlet:.3f} ± {percent_error_verlet:.1g}",
    "SIER4G/%": "{percent:.3f} ± {percent_error:.1g}",
    "gain": "{gain:.1f} ± {gain_error:.1f}",
    "speed over this Verlet": "{relative:.2f} ± {relative_error:.2f}",
    "drift, Verlet/kJ/mol/ps": "{drift_verlet:+.5f} ± {its_error_verlet:.5f}",
    "drift, SIER4G/kJ/mol/ps": "{drift:+.5f} ± {its_error:.5f}",
}

VERLET = CONSTANT_ENERGY["verlet"].name

#: Schemes whose walk follows one law, and the walks in % to which it is fitted: above the floor of single precision.
FOURTH_ORDER = [scheme.name for scheme in CATALOGUE.values() if scheme.order == 4]
FITTED = (0.025, 5.0)


@dataclass(frozen=True, kw_only=True)
class WholeRunSettings(RunsSettings):
    """Settings of the comparison; the seeds of the starts follow `seed`.

    Attributes:
        liquids: by name, TIP3P, SPC/E, TIP4P/2005, OPC, TIP5P or peptide; or PDB files that name their force field.
        molecules: of a box of water.
        methods: by name, all unless given.
        steps: of each method, fs; steps for the same simulated time per force evaluation unless given.
        per_force: simulated time per force evaluation, fs.
        starts: equilibrated phase points, from which all runs start.
        time: of each run, ps.
        equilibrate: before them, ps.
        temperature: K.
        tolerance: OpenMM's ewaldErrorTolerance.
        platform: of OpenMM.
    """

    liquids: tuple[str, ...] = ("TIP3P",)
    molecules: int = 64
    methods: tuple[str, ...] = ()
    steps: tuple[float, ...] = ()
    per_force: tuple[float, ...] = (1.0, 4 / 3, 1.5, 2.0)
    starts: int = 2
    time: float = 100.0
    equilibrate: float = 5.0
    temperature: float = 297.0
    tolerance: float = 1e-4
    platform: str = "CPU"

    SHARED = ("temperature", "equilibrate", "platform")


def tasks(settings: WholeRunSettings) -> Iterator[Task]:
    """Yield all runs that the settings ask for, seed by seed; boxes that are taken as they are have 0 molecules."""
    chosen([name for name in settings.liquids if not Path(name).is_file()], LIQUIDS, "liquid")
    chosen(settings.methods, CONSTANT_ENERGY, "method")
    shared = {"time": settings.time, "tolerance": settings.tolerance, "share": AT_CONSTANT_ENERGY.direct_share}
    seeds = range(settings.seed, settings.seed + settings.starts)
    for seed, liquid, name in product(seeds, settings.liquids, settings.methods or CONSTANT_ENERGY):
        method, repeated = CONSTANT_ENERGY[name], LIQUIDS.get(liquid, ("",))[0].endswith("-512.pdb")
        place = {
            "liquid": liquid if liquid in LIQUIDS else Path(liquid).stem,
            "molecules": settings.molecules if repeated else 0,
        } | shared
        for step in settings.steps or [method.forces * each for each in settings.per_force]:
            yield Task(settings, place | {"method": method.name, "step": round(step, 6), "seed": seed}, name)


def start(task: Task) -> Liquid:
    """Return the equilibrated phase point of a task, which is kept for the others of its liquid, size and seed."""
    settings, (liquid, molecules, seed) = task.settings, (task.point[name] for name in ("liquid", "molecules", "seed"))
    given = {Path(name).stem: (str(Path(name).resolve()),) for name in settings.liquids}
    file, *forcefield = (given | LIQUIDS)[liquid]
    path = settings.out / f"start of {liquid.replace('/', '-')}, {molecules}, seed {seed}.xml"
    box = forcefields.read_box(SYSTEMS / file, forcefield or None, None if molecules else "hbonds")
    topology, positions, system = box.topology, box.positions, box.system
    if molecules:
        replica = boxes.of_size(box, SYSTEMS, molecules)
        positions, system = replica.positions * openmm.unit.nanometer, replica.system
    boxes.with_tolerance(system, settings.tolerance)
    if not molecules:
        prepare_system(system)
    context = make_context(system, CONSTANT_ENERGY["sier4g"].make(0.003), settings.platform)
    state = equilibrated(context, positions, settings.temperature, seed, settings.equilibrate, path)
    bodies = find_bodies.RigidBodies.from_system(system, None if molecules else topology)
    return Liquid(system, bodies, state, settings.platform)


def run(task: Task) -> dict[str, Any]:
    """Return the energy error of a run, its walk and drift, see `studies.frame.conserved`, and its temperatures."""
    method = CONSTANT_ENERGY[task.method]
    row = task.point | {"forces": method.forces, "fs_per_force": task.point["step"] / method.forces}
    figures, table = conserved(start(task), method, row["fs_per_force"], task.settings.time, INTERVAL)
    if table is None:
        return row | figures
    H = (table["potential"] + table["kinetic"]).to_numpy()
    difference = mean_and_error((table["rotation"] - table["translation"]).to_numpy())
    further = {
        "rms_V": float(table["potential"].std(ddof=0)),
        "temperature": float(table["translation"].mean()),
        "difference": difference.value,
        "difference_error": difference.error,
        "means": np.round([each.mean() for each in np.array_split(H, max(1, round(task.settings.time)))], 4),
    }
    return row | figures | further


def points(runs: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each liquid, size, length, scheme and step: means over the starts with standard errors."""
    return pd.DataFrame([_point(group) for _, group in runs.groupby(POINT, sort=False)])


def _point(runs: pd.DataFrame) -> dict[str, Any]:
    point = {name: runs.iloc[0][name] for name in (*POINT, "forces", "fs_per_force")}
    walks = np.array([walk_slope(np.array(means, dtype=float)) for means in runs["means"] if np.ndim(means)])
    point["its_error"] = math.sqrt((runs["its_error"] ** 2).sum() + (walks**2).sum()) / len(runs)
    of_starts = over_starts(runs, ("percent", "walk", "drift", "fs_per_second"))
    return point | of_starts | records.pooled(runs, ("difference",))


def walk_slope(means: np.ndarray) -> float:
    """Return the standard deviation in kJ/mol/ps of the slope that a random walk of means of H over 1 ps has by chance.

    The mean square of what H changes by in a time grows with it by the diffusion D of the walk; what oscillates adds a
    constant. A straight line through a walk of the length T has a slope of the variance 6 D/(5 T).
    """
    short, long = WALK_LAGS
    if len(means) <= 2 * long:
        return 0.0
    squares = [np.mean((means[lag:] - means[:-lag]) ** 2) for lag in WALK_LAGS]
    return math.sqrt(1.2 * max(0.0, squares[1] - squares[0]) / (long - short) / len(means))


def made(settings: WholeRunSettings, runs: pd.DataFrame) -> Made:
    """Return the tables of all runs, and the law of the walk."""
    # Runs of an earlier version have no speed.
    runs = runs.assign(fs_per_second=runs.get("fs_per_second", math.nan))
    rows = points(runs).sort_values(POINT, kind="stable")
    return {"rows": rows, "runs": runs, "gains": gains(rows)}, {"law": law(rows)}


def gains(rows: pd.DataFrame) -> pd.DataFrame:
    """Return Verlet's error over SIER4G's in the same box, length and simulated time per force evaluation.

    `relative` is the simulated time of SIER4G over that of Verlet for the same processor time.
    """
    same = ["liquid", "molecules", "time", "tolerance", "share"]
    rows = rows.assign(per_force=rows["fs_per_force"].round(4))
    ours, theirs = rows[rows["method"] == SIER4G.name], rows[rows["method"] == VERLET]
    pairs = ours.merge(theirs, on=[*same, "per_force"], suffixes=("", "_verlet"))
    for ratio, over, under in (("gain", "_verlet", ""), ("relative", "", "_verlet")):
        name = "percent" if ratio == "gain" else "fs_per_second"
        pairs[ratio] = pairs[f"{name}{over}"] / pairs[f"{name}{under}"]
        spread = np.hypot(*(pairs[f"{name}_error{of}"] / pairs[f"{name}{of}"] for of in ("", "_verlet")))
        pairs[f"{ratio}_error"] = pairs[ratio] * spread
    return pairs


def law(rows: pd.DataFrame) -> dict[str, Any]:
    """Return how fast the walk of schemes of fourth order dies out with a shorter step.

    The walk is A exp(-c T/h) with an A for each scheme and one c, fitted to the logarithms where the walk is above the
    floor of forces in single precision and the run is still one of a liquid. T is the period of the fastest librations
    by the package's estimate.
    """
    rows = first_box(rows)
    rows = rows[rows["method"].isin(FOURTH_ORDER) & rows["walk"].between(*FITTED)]
    names = sorted(set(rows["method"]))
    if len(rows) <= len(names):
        return {}
    inverse = WATER / (rows["step"].to_numpy(dtype=float) / 1000)
    columns = np.column_stack([rows["method"] == name for name in names] + [-inverse]).astype(float)
    parameters, *_ = np.linalg.lstsq(columns, np.log(rows["walk"].to_numpy(dtype=float)), rcond=None)
    return {
        "period": WATER,
        "decay": parameters[-1],
        "at_infinity": dict(zip(names, np.exp(parameters[:-1]), strict=True)),
    }


def first_box(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the points of the box and the length of run that have the most of them."""
    return max((group for _, group in rows.groupby(POINT[:5], sort=False)), key=len)


def figure(record: Record, path: Path) -> None:
    """Draw the walk against the step, with its law."""
    with style.figure(path, 1) as (picture, (axes,)):
        rows = first_box(record.tables["rows"])
        style.curves(axes, rows.assign(walk_error=rows["walk_error"].fillna(0)), "step", "walk")
        law = record.notes["law"]
        for name, scale in law.get("at_infinity", {}).items():
            fitted = rows[(rows["method"] == name) & rows["walk"].between(*FITTED)]["step"]
            steps = np.linspace(fitted.min() - 0.7, fitted.max() + 0.5)
            curve = scale * np.exp(-law["decay"] * 1000 * law["period"] / steps)
            axes.plot(steps, curve, color=style.of_method(name)["color"], lw=4, alpha=0.25)
        axes.set(yscale="log", xlabel="step (fs)", ylabel="walk of the energy (% of rms(V))")
        axes.set_title("Fourth order: a quarter off the step\ntakes away most of the walk", fontweight="bold")
        axes.yaxis.set_major_formatter("{x:g}")
        style.shared_legend(picture, axes)


def energies(record: Record, path: Path) -> None:
    """Draw the energy of Verlet and SIER4G over the longest run that both made with as many forces."""
    pairs, runs = record.tables["gains"].dropna(subset="gain"), record.tables["runs"]
    pair = pairs.sort_values("time", kind="stable").iloc[-1]
    time = f"{pair['time'] / 1000:g} ns" if pair["time"] >= 1000 else f"{pair['time']:g} ps"
    title = f"Over {time} SIER4G holds the energy {pair['gain']:.0f} times as well as Verlet,\nwith as many forces"
    with style.one_message(path, title) as axes:
        for step, method in ((pair["step_verlet"], VERLET), (pair["step"], SIER4G.name)):
            conditions = pair[POINT].to_dict() | {"method": method, "step": step}
            run = runs[(runs[POINT] == pd.Series(conditions)).all(axis=1) & (runs["broken"] == "")].iloc[0]
            means = 100 * (np.array(run["means"]) - np.mean(run["means"])) / run["rms_V"]
            # What the means over 1 ps leave out: oscillations within each.
            inner = math.sqrt(max(0.0, run["percent"] ** 2 - means.var()))
            at, colour = np.arange(len(means)) + 0.5, style.of_method(method)["color"]
            axes.fill_between(at, means - inner, means + inner, color=colour, alpha=0.3, lw=0)
            label = f"{method}, {step:.3g} fs: energy error {run['percent']:#.2g} %"
            axes.plot(at, means, color=colour, lw=1.2, label=label)
        axes.set(xlabel="time (ps)", ylabel="energy, from its mean\n(% of rms(V))", xlim=(0, len(means)))
        least, most = axes.get_ylim()
        axes.set_ylim(least - 0.3 * (most - least), most)  # room for the legend
        lines = axes.legend(loc="lower left", fontsize=13, title_fontsize=12, alignment="left")
        lines.set_title(f"{pair['liquid']}, {pair['molecules']} molecules; lines: means over 1 ps, bands: ± rms within")
        for line in lines.get_lines():
            line.set_linewidth(4)


study = Experiment(
    "whole-run",
    tasks,
    run,
    "{liquid}, {molecules}, {method}, {step:g} fs, seed {seed}: {percent:.3f} %, walk {walk:.3f} %",
    made,
    (
        ("rows", "Conservation of energy over whole runs", COLUMNS | WARMTH),
        ("gains", "Gain over Verlet with as many forces", GAINS),
    ),
    figure,
)

main = command(WholeRunSettings, study, __doc__, __name__)
