"""Acceptance of hybrid Monte Carlo against the number of molecules.

    python -m studies.acceptance [BOX.pdb] [--sizes 64 512] [--schemes verlet sier4g]

All schemes follow trajectories of the same length from the same boxes, Verlet among them: kick, drift, kick with a
step of RATTLE that is solved to rounding, so that it is reversible and can be accepted or rejected exactly. Boxes and
trials are kept in --out as soon as they are done: a stopped study goes on where it was, and one with further sizes,
schemes or steps adds to them. Writes acceptance.json and acceptance.png. The default takes an hour or two of one core.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import openmm
import pandas as pd
from openmm import unit

from openmm_sier.dynamics.acceptance import spread_at
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.schemes import SIER2, SIER4G
from openmm_sier.inputs.starts import make_context
from openmm_sier.integrators.hmc import SIERHMCIntegrator
from openmm_sier.integrators.integrator import SIERIntegrator
from studies import boxes, records, style, text
from studies.command import BoxSettings, RunsSettings, chosen, command
from studies.methods import REVERSIBLE
from studies.records import Record, Task
from studies.report import SILENT, Report
from studies.sampling import equilibrated
from studies.units import md

#: Spreads of boxes below this size are not pooled with those of larger ones, since cut-offs are shorter in boxes that
#: are narrower than twice the usual cut-off.
SMALLEST_POOLED = 512

#: Factor by which the points of one method are beside those of the one before, in the figure, and the relative
#: difference of two laws below which one line would hide the other.
APART, ALIKE = 1.12, 0.03

#: Number of molecules up to which lines of acceptance are drawn.
LARGEST_DRAWN = 262144

COLUMNS = text.columns(
    "molecules", "method", "fs_per_force", "length", "trials", "acceptance", "spread", "mean", "noise"
)

LIMITS = text.columns("method", "fs_per_force") | {
    "sd for one molecule/kT": "{spread:.5f} ± {spread_error:.5f}",
    "largest box measured": "{measured}",
    "by sd ~ sqrt(N)": "{largest:.0f} ± {largest_error:.0f}",
}


#: Size in nm and number of the random displacements of molecules that tell the noise of the energy. Single precision
#: resolves the coordinates of a large box about as well.
NOISE_STEP, NOISE_SAMPLES = 1e-6, 16

#: Default number of trials in a box, which is `MOLECULES` over the molecules of the box, within the two bounds.
MOLECULES, FEWEST, MOST = 163840, 10, 400


@dataclass(frozen=True)
class AcceptanceSettings(BoxSettings, RunsSettings):
    """Settings of the measurement.

    Attributes:
        sizes: numbers of molecules, multiples of that of the box or smaller.
        schemes: by name; all unless given.
        dt: simulated time per force evaluation, fs.
        trials: their number; fewer in larger boxes unless given.
        time: of each trajectory, ps, rounded to a whole number of steps.
        equilibrate: at each size, ps, for repeated boxes; cropped ones are equilibrated until they have settled.
    """

    sizes: tuple[int, ...] = (64, 512, 4096, 32768)
    schemes: tuple[str, ...] = ()
    dt: tuple[float, ...] = (2.0,)
    trials: int | None = None
    time: float = 0.06
    equilibrate: float = 1.0

    SHARED = ("box", "forcefield", "temperature", "platform", "seed", "time", "equilibrate")

    def trials_of(self, molecules: int) -> int:
        """Number of trials in a box of this size."""
        return self.trials or min(MOST, max(FEWEST, MOLECULES // molecules))


def run(task: Task) -> dict[str, Any]:
    """Trials, each from the last sample, with momenta drawn anew.

    Returns:
        Besides the point `step` in fs, `length` of a trial in fs; the `errors` of the energy at the end of each trial
        in kT, None where a trajectory could not be followed; `reversal`, the distance in nm by which an atom missed its
        start when the first trajectory was followed back; the `noise` of the energy in kT, from rounding, which enters
        each trial twice; and `broken`, why there are no trials.
    """
    settings, method, molecules = task.settings, REVERSIBLE[task.method], task.point["molecules"]
    box = boxes.read(settings)
    replica = boxes.of_size(box, settings.box.parent, molecules)
    context = make_context(replica.system, SIERIntegrator(0.001, SIER2), settings.platform)
    # A cropped box has new faces, so it is equilibrated until it has settled.
    time: Any = None if molecules < box.topology.getNumResidues() else settings.equilibrate
    kept, positions = settings.out / f"start of {molecules}.xml", replica.positions * unit.nanometer
    context.setState(equilibrated(context, positions, settings.temperature, settings.seed, time, kept))
    bodies, noise = context.getIntegrator().bodies, energy_noise(context, settings.seed)
    step = task.point["fs_per_force"] * method.forces
    steps = max(1, round(1e3 * settings.time / step))
    made: dict[str, Any] = task.point | {"step": step, "length": step * steps, "errors": [], "reversal": None}
    made |= {"noise": noise / (GAS_CONSTANT * settings.temperature), "broken": ""}
    integrator = SIERHMCIntegrator(
        settings.temperature, 1e-3 * step, method.scheme, steps, bodies=bodies, rotation=method.rotation, extraChances=0
    )
    integrator.setRandomNumberSeed(settings.seed)
    tried = make_context(replica.system, integrator, settings.platform)
    tried.setPositions(context.getState(positions=True).getPositions())
    try:
        for _ in range(made["trials"]):
            integrator.step(1)
            error = integrator.lastEnergyError
            made["errors"].append(error if math.isfinite(error) else None)
    except openmm.OpenMMException as error:
        return made | {"errors": [], "broken": " ".join(str(error).split())}
    return made | {"reversal": integrator.reversalError}


def energy_noise(context: openmm.Context, seed: int = 1) -> float:
    """Standard deviation of a Context's potential energy from rounding, kJ/mol.

    Molecules are displaced at random, by so little that their forces predict the change of the energy. The scatter
    about this prediction is from rounding alone, of positions and of sums.

    Args:
        context: of a SIERIntegrator, with positions. It is left as it was.
        seed: of the displacements.
    """
    state = context.getState(positions=True, energy=True, forces=True)
    positions = md(state.getPositions(asNumpy=True))
    bodies = context.getIntegrator().bodies
    F, _ = bodies.forces_and_torques(md(state.getForces(asNumpy=True)), context.getIntegrator().getBodyState().A)
    owners, rng, found = bodies.owners, np.random.default_rng(seed), []
    try:
        for _ in range(NOISE_SAMPLES):
            moved = rng.normal(scale=NOISE_STEP, size=F.shape)
            context.setPositions(np.where(owners[:, None] >= 0, positions + moved.T[owners], positions))
            context.computeVirtualSites()
            found.append(md(context.getState(energy=True).getPotentialEnergy()) + float((F * moved).sum()))
    finally:
        context.setPositions(positions)
    return float(np.std(found, ddof=1))


def statistics(errors: Sequence[float | None]) -> dict[str, Any]:
    """What energy errors of trials in kT tell; an error is None or NaN where a trajectory could not be followed.

    Returns:
        The number of `trials`; `acceptance`, the mean of min(1, exp(-error)); `spread`, the standard deviation of the
        energy error; `mean` of the error, half the square of the spread if errors are normal; each with its standard
        error, and NaN where there are too few trials.
    """
    found = np.array(errors, dtype=float)
    followed = found[np.isfinite(found)]
    chances = np.exp(-np.maximum(np.where(np.isfinite(found), found, math.inf), 0))
    n, m = len(found), len(followed)
    sd = float(followed.std(ddof=1)) if m > 1 else math.nan
    return {
        "trials": n,
        "acceptance": chances.mean() if n else math.nan,
        "acceptance_error": chances.std(ddof=1) / math.sqrt(n) if n > 1 else math.nan,
        "spread": sd,
        "spread_error": sd / math.sqrt(2 * (m - 1)) if m > 1 else math.nan,
        "mean": followed.mean() if m else math.nan,
        "mean_error": sd / math.sqrt(m) if m > 1 else math.nan,
    }


def row_of(member: dict[str, Any]) -> dict[str, Any]:
    """The row for trials of `run`, see `statistics`."""
    row = {key: value for key, value in member.items() if key not in ("errors", "reversal")}
    return row | statistics(member["errors"])


def measure(settings: AcceptanceSettings, report: Report = SILENT) -> pd.DataFrame:
    """Make the trials that the directory lacks; all of its results are returned, see `row_of`.

    Raises:
        ValueError: a scheme is unknown, a size does not fit the box, or the directory has results of other settings.
    """
    chosen(settings.schemes, REVERSIBLE, "scheme")
    tasks = []
    for molecules, scheme, dt in product(settings.sizes, settings.schemes or REVERSIBLE, settings.dt):
        place = {"molecules": molecules, "method": REVERSIBLE[scheme].name, "fs_per_force": dt}
        tasks.append(Task(settings, place | {"trials": settings.trials_of(molecules)}, scheme))
    form = "{trials} trials of {method} at {fs_per_force:g} fs per force, {molecules} molecules"
    runs = records.all_runs(settings, "acceptance", tasks, run, report, form)
    order = [method.name for method in REVERSIBLE.values()]
    rows = pd.DataFrame([row_of(each) for each in runs.to_dict("records")])
    # More trials begin with those that there were.
    rows = rows.sort_values("trials").drop_duplicates(["molecules", "method", "fs_per_force"], keep="last")
    rows = rows.sort_values("method", key=lambda names: names.map(order.index), kind="stable")
    return rows.sort_values(["molecules", "fs_per_force"], kind="stable", ignore_index=True)


# --- how large a box may be ---


def limits(rows: pd.DataFrame, accepted: float = 0.5) -> pd.DataFrame:
    """How large a box may be, for each method and step with trials in boxes of `SMALLEST_POOLED` molecules or more.

    Molecules that are far from each other contribute to the energy error independently, so its variance is proportional
    to their number; `openmm_sier.dynamics.acceptance` computes the acceptance that follows.

    Returns:
        For each method and step the `spread` of the energy error for one molecule in kT; `measured`, the largest box
        that was measured with an acceptance above the one asked for, 0 if there is none; `largest`, the number of
        molecules with that acceptance by this law; and standard errors.
    """
    found = []
    for (method, dt), mine in rows[rows["spread"] > 0].groupby(["method", "fs_per_force"], sort=False):
        large = mine[mine["molecules"] >= SMALLEST_POOLED]
        if large.empty:
            continue
        spread, error = pooled_spread(large)
        largest = (spread_at(accepted) / spread) ** 2
        row = {"method": method, "fs_per_force": dt, "spread": spread, "spread_error": error}
        row["measured"] = max(mine.loc[mine["acceptance"] > accepted, "molecules"], default=0)
        found.append(row | {"largest": largest, "largest_error": 2 * largest * error / spread})
    return pd.DataFrame(found, columns=list(found[0]) if found else ["method", "fs_per_force", "largest"])


def expected_acceptance(spread: float) -> float:
    """Mean of min(1, exp(-error)) for normally distributed energy errors with this standard deviation in kT."""
    return math.erfc(spread / math.sqrt(8))


def pooled_spread(rows: pd.DataFrame) -> tuple[float, float]:
    """The spread for one molecule and its standard error, from boxes of several sizes, weighted by their trials.

    For n molecules it is sqrt(n) times as large.
    """
    freedom = rows["trials"] - 1
    value = math.sqrt((freedom * rows["spread"] ** 2 / rows["molecules"]).sum() / freedom.sum())
    return value, value / math.sqrt(2 * freedom.sum())


# --- the study ---


def study(settings: AcceptanceSettings, report: Report = SILENT) -> Record:
    """Measure, and write acceptance.json and acceptance.png."""
    rows = measure(settings, report)
    found = limits(rows)
    report.table("Energy error of trajectories, and acceptance", text.table(rows, COLUMNS))
    report.table("Largest box with an acceptance above 0.5", text.table(found, LIMITS))
    record = Record(settings.recorded(), {"rows": rows, "limits": found}, {})
    record.write(settings.out / "acceptance.json")
    figure(record, settings.out / "acceptance.png")
    return record


def figure(record: Record, path: Path) -> None:
    """Acceptance and spread of the energy error against the number of molecules, one line per method and step."""
    rows = record.tables["rows"]
    steps, limits = sorted(rows["fs_per_force"].unique()), record.tables["limits"].to_dict("records")
    with style.figure(path, 2, _title(record.tables["limits"])) as (made, (accepted, spread)):
        for i, limit in enumerate(limits):
            method, dt = limit["method"], limit["fs_per_force"]
            mine = rows[(rows["method"] == method) & (rows["fs_per_force"] == dt)]
            look = style.of_method(method) | {"ls": ("-", "--", ":", "-.")[steps.index(dt) % 4]}
            if any(abs(limit["spread"] / earlier["spread"] - 1) < ALIKE for earlier in limits[:i]):
                look |= {"ls": (0, (5, 5))}  # so that the line below shows between the dashes
            beside = mine.assign(molecules=mine["molecules"] * APART ** (i - (len(limits) - 1) / 2))
            style.curves(accepted, beside, "molecules", "acceptance", ls="", label="_", zorder=3)
            style.curves(spread, beside, "molecules", "spread", ls="", label="_", zorder=3)
            along = np.geomspace(mine["molecules"].min(), max(LARGEST_DRAWN, mine["molecules"].max()), 200)
            spreads = limit["spread"] * np.sqrt(along)
            spread.plot(along, spreads, **look | {"marker": ""})
            accepted.plot(along, [expected_acceptance(each) for each in spreads], **look | {"marker": ""})
            accepted.plot([], [], label=method if len(steps) == 1 else f"{method}, {dt:g} fs per force", **look)
        accepted.axhline(0.5, color=style.GREY, lw=1, zorder=0)
        accepted.set(xscale="log", ylim=(0, 1.03), ylabel="acceptance", title="Acceptance, and erfc(sd/√8)")
        style.logarithmic(spread)
        spread.set(ylabel="standard deviation of the energy error (kT)", title="Energy error, and sd ~ √N")
        for axes in (accepted, spread):
            axes.set_xlabel("molecules of water")
            style.plain_ticks(axes.xaxis, [8**n for n in (2, 4, 6)])
        style.shared_legend(made, accepted)


def _title(limits: pd.DataFrame) -> str:
    """How much larger boxes may be with SIER4G than with Verlet, at their first steps that were measured."""
    largest = limits.drop_duplicates("method").set_index("method")["largest"] if len(limits) else pd.Series()
    names = SIER4G.name, REVERSIBLE["verlet"].name
    if not set(names) <= set(largest.index):
        return "Hybrid Monte Carlo by the size of the box"
    times = largest[names[0]] / largest[names[1]]
    return f"Half of the trials are accepted in boxes {times:.0f} times as large with SIER4G as with Verlet"


main = command(AcceptanceSettings, study, __doc__, __name__)
