"""Simulated time per day of OpenMM's integrators and of these, each at its usual step.

    python -m studies.speed [--platform CUDA] [--boxes water-512 peptide]

takes boxes of water, a peptide and a protein, with OpenMM's default tolerance. OpenMM's integrators have the System as
OpenMM makes it, those of this package have it prepared; in a heat bath all have heavy hydrogens. All take turns; ratios
are those within a round, of processor time on the CPU platform and of wall time on others. For water it also gives the
speed at equal energy error: the steps that have it are found in the box of 512 molecules. Set OPENMM_CPU_THREADS to 1
for a machine that does other work: ns/day are then those of processor time too. Writes speed.json.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import openmm
import pandas as pd

from openmm_sier import RigidBodies, SIERIntegrator
from openmm_sier.dynamics import threads
from openmm_sier.dynamics.schemes import SIER2, SIER2P3, SIER4G, Scheme
from openmm_sier.inputs.equilibration import make_context
from studies import boxes, speed_boxes, text, timing
from studies.boxes import BoxSystem
from studies.command import BoxSettings, chosen, command
from studies.frame import Liquid, conserved, equilibrated
from studies.methods import (
    CONSTANT_ENERGY,
    HEAVY,
    MIDDLE,
    VERLET,
    Bath,
    Contestant,
    in_bath,
    middle_in_rigid_water,
    of_scheme,
    several_steps,
)
from studies.records import Record
from studies.report import SILENT, Report
from studies.speed_boxes import SOLUTES
from studies.timing import ON_PROCESSORS

#: What ratios are taken over: OpenMM's Verlet at its usual step.
REFERENCE = "OpenMM Verlet, 2 fs"

#: What those of a heat bath are taken over too: OpenMM's usual integrator there, with heavy hydrogens.
BATH_REFERENCE = "OpenMM LangevinMiddle, 4 fs"

#: Of heat baths, 1/ps.
FRICTION = 1.0

#: fs per force evaluation at which energy errors are measured, and the errors in per cent at which speeds are compared,
#: which these steps of all methods enclose: at OpenMM's default tolerance none has less than 0.06 %.
STEPS = {
    "verlet": (0.5, 1.0, 1.5, 2.0, 2.5),
    "sier2": (0.5, 1.0, 1.5, 2.0, 2.5),
    "sier2p3": (1.5, 2.0, 3.0, 3.5, 4.0, 5.0),
    "sier4g": (1.5, 2.0, 2.5, 3.0),
}
LEVELS = (0.3, 0.7)


@dataclass(frozen=True, kw_only=True)
class SpeedSettings(BoxSettings):
    """Settings of the comparison.

    Attributes:
        box: of 512 water molecules of three sites, which larger boxes repeat.
        boxes: water-N, N a multiple of the molecules of `box`, peptide, dhfr; water-512, water-4096, water-32768,
            peptide and dhfr unless given.
        methods: by name, beside the two that ratios are taken over; unless given all, and the speed at equal energy
            error.
        rounds: in which all methods take their turns.
        turn: least seconds of a turn.
        time: of each run that measures an energy error, ps.
        equilibrate: before these, ps.
        starts: of these.
    """

    boxes: tuple[str, ...] = ("water-512", "water-4096", "water-32768", "peptide", "dhfr")
    methods: tuple[str, ...] = ()
    rounds: int = 5
    turn: float = 0.5
    time: float = 1.0
    equilibrate: float = 2.0
    starts: int = 3


def contestants(has_solute: bool) -> list[Contestant]:
    """Return all of them; with solutes SIER2P3 has the step that bonds allow."""

    def bath(scheme: Scheme, step: float) -> Contestant:
        return in_bath(scheme, f"{scheme.name} in a bath").at(step, **HEAVY)

    middle, longer = MIDDLE.of_openmm(), 9 if has_solute else 12
    methods = [VERLET.of_openmm().at(step) for step in (1, 2)]
    methods += [of_scheme(each).at(step, prepared=True) for each, step in ((SIER2, 2), (SIER2P3, longer), (SIER4G, 4))]
    methods += [middle.at(step, hydrogens=3.0) for step in (2, 4, 5)]
    methods.append(several_steps(8).of_openmm())
    if not has_solute:
        methods += [middle_in_rigid_water(step).of_openmm() for step in (9, 10)]
        methods.append(bath(SIER2P3, 18))
    return [*methods, *(bath(SIER2, step) for step in (8, 9, 10))]


def compared(has_solute: bool, names: Sequence[str]) -> dict[str, Contestant]:
    """Return those that are named, and the two that ratios are taken over, by name; all where none is named."""
    wanted = {*names, REFERENCE, BATH_REFERENCE}
    return {each.name: each for each in contestants(has_solute) if not names or each.name in wanted}


def speeds(box: BoxSystem, state: openmm.State, settings: SpeedSettings, report: Report) -> list[dict[str, Any]]:
    """Return a row for each method in one box, from a phase point."""
    methods = compared(box.has_solute, settings.methods)
    contexts = {name: _context(method, box, state, settings) for name, method in methods.items()}
    durations = {name: method.step for name, method in methods.items()}
    references = {"over": REFERENCE, "over_middle": BATH_REFERENCE}
    rows = timing.speeds(contexts, durations, references, settings.rounds, settings.turn)
    for row in rows:
        method = methods[row["name"]]
        row |= {
            "box": box.name,
            "atoms": box.system.getNumParticles(),
            "method": method.method.name,
            "fs_per_force": method.step / method.forces,
        }
        report.note(text.cell("{box}: {name}, {ns_per_day:.3g} ns/day, {over:.2f} of Verlet's at 2 fs", row))
    return rows


def _context(method: Contestant, box: BoxSystem, state: openmm.State, settings: SpeedSettings) -> openmm.Context:
    system = copy.deepcopy(box.system)
    method.fit(system)
    context = make_context(system, method.integrator(Bath(settings.temperature, FRICTION)), settings.platform)
    context.setState(state)
    # Hydrogens that became heavy would be far too hot, and long steps would break the run.
    context.setVelocitiesToTemperature(settings.temperature, settings.seed)
    return context


# --- at equal energy error ---


def energy_errors(settings: SpeedSettings, report: Report) -> pd.DataFrame:
    """Return errors within a run of each method at each of `STEPS`, by the seed of their start, in prepared water."""
    rows = []
    for seed in range(settings.seed, settings.seed + settings.starts):
        liquid = _equilibrated(settings, seed, report)
        for name, steps in STEPS.items():
            method = CONSTANT_ENERGY[name]
            for dt in steps:
                row, _ = conserved(liquid, method, dt, settings.time)
                rows.append({"method": method.name, "fs_per_force": dt, "seed": seed} | row)
                report.note(text.cell("{method} at {fs_per_force:g} fs per force: {percent:.4f} %", rows[-1]))
    return pd.DataFrame(rows)


def _equilibrated(settings: SpeedSettings, seed: int, report: Report) -> Liquid:
    box = boxes.read(settings, tolerance=speed_boxes.TOLERANCE)
    context = make_context(box.system, SIERIntegrator(0.001, SIER2), settings.platform)
    state = equilibrated(context, box.positions, settings.temperature, seed, settings.equilibrate, report=report)
    return Liquid(box.system, RigidBodies.from_system(box.system, box.topology), state, settings.platform)


def at_equal_error(rows: pd.DataFrame, points: pd.DataFrame) -> pd.DataFrame:
    """Return the speed of each method in each box of water at each of `LEVELS`.

    The step that has an error is interpolated for each start; its mean and standard error are over the starts.
    """
    steps = {
        (method, level): _steps_at(points, method, level) for method in points["method"].unique() for level in LEVELS
    }
    results = []
    usual = rows.drop_duplicates(["box", "method"], keep="last").set_index(["box", "method"])
    for box in (name for name in rows["box"].unique() if name.startswith("water")):
        for (method, level), (dt, error) in sorted(steps.items(), key=lambda item: item[0][1]):
            own_row, verlet = usual.loc[(box, method)], usual.loc[(box, "OpenMM Verlet")]
            verlet_dt, verlet_error = steps["OpenMM Verlet", level]
            over = dt / verlet_dt * own_row["over"] / own_row["fs_per_force"] * verlet["fs_per_force"]
            shares = (error / dt, verlet_error / verlet_dt, own_row["over_error"] / own_row["over"])
            share = 0.0 if method == "OpenMM Verlet" else math.hypot(*shares)
            row = {"box": box, "percent": level, "method": method, "fs_per_force": dt, "fs_per_force_error": error}
            results.append(row | {"over": over, "over_error": over * share})
    return pd.DataFrame(results)


def step_at(points: pd.DataFrame, level: float) -> float:
    """Return the fs per force at which a method reaches an error; NaN where its points do not enclose it.

    Between two points the error is taken as a power of the step. The longest such step is returned.

    Args:
        points: of one method and start.
        level: rms(H)/rms(V) in per cent.
    """
    known = points.dropna(subset=["percent"]).sort_values("fs_per_force")
    for (h1, e1), (h2, e2) in reversed(list(pairwise(zip(known["fs_per_force"], known["percent"], strict=True)))):
        if e1 <= level < e2:
            return float(h1 * (h2 / h1) ** (math.log(level / e1) / math.log(e2 / e1)))
    return math.nan


def _steps_at(points: pd.DataFrame, method: str, level: float) -> tuple[float, float]:
    """Return the fs per force that have an error, with the error over starts; NaN where a start has none."""
    of_method = points[points["method"] == method]
    each = np.array([step_at(of_seed, level) for _, of_seed in of_method.groupby("seed")])
    return float(each.mean()), float(each.std(ddof=1) / math.sqrt(len(each))) if len(each) > 1 else math.nan


# --- the study ---


def tell(record: Record, report: Report) -> None:
    """Report speeds, with a row for each method and a column for each box."""
    rows = record.tables["speeds"]
    platform = rows["platform"].iloc[0]
    of_processor = platform in ON_PROCESSORS and record.notes["threads"] == 1
    speed = "{ns_per_day_processor:.3g}" if of_processor else "{ns_per_day:.3g}"
    unit = f"ns/day{' of processor time' if of_processor else ''}; {platform} platform"
    forms = {
        f"{unit}, and over Verlet at 2 fs": f"{speed}, {{over_text}}",
        f"Over {BATH_REFERENCE}": "{over_middle_text}",
    }
    for title, form in forms.items():
        report.table(title, text.table(rows, {"method": "{name}", "{box}": form}))
    if "equal" in record.tables:
        columns = text.columns("percent", "method", "fs_per_force") | {"{box}": "{over_text}"}
        report.table("At equal energy error, over Verlet", text.table(record.tables["equal"], columns))


def study(settings: SpeedSettings, report: Report = SILENT) -> Record:
    """Measure, and write speed.json.

    Raises:
        ValueError: a box or a method is unknown.
        ImportError: dhfr is to be measured without openmmtools.
    """
    with_solute = [name for name in settings.boxes if not name.startswith("water-")]
    chosen(with_solute, SOLUTES, "box")
    chosen(settings.methods, {method.name: method for has in (False, True) for method in contestants(has)}, "method")
    rows: list[dict[str, Any]] = []
    for name in settings.boxes:
        rows += speeds(*speed_boxes.start(name, settings, report), settings, report)
    tables = {"speeds": pd.DataFrame(rows)}
    if len(with_solute) < len(settings.boxes) and not settings.methods:
        tables["points"] = energy_errors(settings, report)
        tables["equal"] = at_equal_error(tables["speeds"], tables["points"])
    record = Record(settings.recorded(), tables, {"threads": threads.count()})
    tell(record, report)
    return record.write(settings.out / "speed.json")


main = command(SpeedSettings, study, __doc__, __name__)
