"""Energy error against cost: OpenMM's Verlet, schemes of the catalogue, LAMMPS and GROMACS where installed.

    python -m studies.bench.accuracy [BOX.pdb] [--platform CPU]

Programs are LAMMPS (lmp) and GROMACS (gmx, gmx_d) on the PATH, at the same liquid. Each point is one run from one
equilibrated start; set OPENMM_CPU_THREADS to 1 for processor times. `studies.speed` compares speeds at the settings
that each program recommends. Writes bench.json and bench.png.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path

import pandas as pd

from openmm_sier.analysis.observables import energy_error
from openmm_sier.dynamics import threads
from openmm_sier.dynamics.schemes import SIER4G
from studies import style, text
from studies.bench import peers
from studies.bench.timing import counts_processor_time
from studies.command import BoxSettings, command
from studies.methods import CONSTANT_ENERGY, Method
from studies.records import Record
from studies.report import SILENT, Report
from studies.sampling import INTERVAL, Energies, Liquid, Unstable, equilibrated_liquid, follow

#: fs per force evaluation: of methods of second order, and of those of fourth.
SECOND_ORDER = (0.25, 0.5, 1.0, 2.0)
FOURTH_ORDER = (0.75, 1.0, 1.5, 2.0, 2.5)
METHODS = dict.fromkeys(("verlet", "sier2"), SECOND_ORDER) | dict.fromkeys(("sier4", "sier4g", "sier4p"), FOURTH_ORDER)

#: Values of rms(H)/rms(V) in per cent at which costs are compared; 0.003 % is the floor of forces in single precision.
LEVELS = (0.02, 0.05, 0.1)


#: Of which the figure has multiples: the speed of Verlet at its usual step.
VERLET, USUAL = CONSTANT_ENERGY["verlet"].name, 2.0

POINTS = text.columns("method", "fs_per_force", "percent", "fs_per_second")
COSTS = text.columns("percent", "method", "fs_per_force", "forces_per_ps", "fs_per_second")


@dataclass(frozen=True, kw_only=True)
class BenchSettings(BoxSettings):
    """Settings of the benchmark.

    Attributes:
        time: of each run, ps.
        equilibrate: before them, ps.
    """

    time: float = 1.0
    equilibrate: float = 2.0


#: What is measured: energies, and simulated fs per second, of processor time if `counts_processor_time`.
Measured = tuple[Energies, float]


def measure(liquid: Liquid, methods: Mapping[str, tuple[float, ...]], time: float, report: Report) -> list[dict]:
    """Points of integrators in OpenMM, by their names in `CONSTANT_ENERGY`, for runs of some ps."""
    return [
        _point(CONSTANT_ENERGY[name].name, dt, partial(_of_openmm, liquid, CONSTANT_ENERGY[name], dt, time), report)
        for name, steps in methods.items()
        for dt in steps
    ]


def _point(method: str, dt: float, run: Callable[[], Measured], report: Report) -> dict:
    point = {"method": method, "fs_per_force": dt, "percent": math.nan, "fs_per_second": math.nan}
    try:
        energies, point["fs_per_second"] = run()
    except (Unstable, peers.PeerError) as error:
        report.note(f"{method} at {dt:g} fs per force: {error}")
        return point
    point["percent"] = 100 * energy_error(energies.total, energies.potential)
    report.note(f"{method} at {dt:g} fs per force: {point['percent']:.4f} %")
    return point


def _of_openmm(liquid: Liquid, method: Method, dt: float, time: float) -> Measured:
    result = follow(liquid, method, dt, time)
    of_processor = counts_processor_time(liquid.platform)
    return result.series, result.fs_per_processor_second if of_processor else result.fs_per_second


def _of_peer(peer: peers.Peer, water: peers.Liquid, dt: float, settings: BenchSettings) -> Measured:
    steps = max(1, round(1e3 * settings.time / dt))
    every = min(steps, max(1, round(INTERVAL / dt)))
    with tempfile.TemporaryDirectory() as directory:
        run = peer.simulate(water, dt, steps, every, Path(directory))
    return run.energies, steps * dt / (run.processor if counts_processor_time(settings.platform) else run.seconds)


def _peers(liquid: Liquid, report: Report) -> Iterator[tuple[peers.Peer, peers.Liquid]]:
    """The programs that are installed, each with the liquid."""
    programs = peers.installed()
    if not programs:
        report.note("no other program: neither lmp nor gmx is on the PATH")
        return
    water = peers.liquid_of(liquid.system, liquid.start)
    if water is None:
        report.note("no other program: they are compared at three-site water alone")
        return
    for peer in programs:
        report.note(f"{peer.name}: {peers.DIFFERENCES[peer.name.split()[0]]}; {peer.build}")
        yield peer, water


def step_at(points: pd.DataFrame, method: str, level: float) -> float:
    """fs per force evaluation at which a method reaches an error; NaN where its points do not enclose it.

    Between two points the error is taken as a power of the step. The longest such step is returned.

    Args:
        points: of `study`.
        method: name of it.
        level: rms(H)/rms(V) in per cent.
    """
    of_method = points[points["method"] == method].dropna(subset=["percent"]).sort_values("fs_per_force")
    for (h1, e1), (h2, e2) in reversed(
        list(pairwise(zip(of_method["fs_per_force"], of_method["percent"], strict=True)))
    ):
        if e1 <= level < e2:
            return float(h1 * (h2 / h1) ** (math.log(level / e1) / math.log(e2 / e1)))
    return math.nan


def costs_of(points: pd.DataFrame) -> pd.DataFrame:
    """For each method and each of `LEVELS` the step in fs per force, the forces per ps and the speed."""
    rows = []
    for level in LEVELS:
        for method, of_method in points.groupby("method", sort=False):
            dt = step_at(points, str(method), level)
            speed = (of_method["fs_per_second"] / of_method["fs_per_force"]).median()
            row = {"percent": level, "method": method, "fs_per_force": dt, "forces_per_ps": 1000 / dt}
            rows.append(row | {"fs_per_second": dt * speed})
    return pd.DataFrame(rows)


def figure(record: Record, path: Path) -> None:
    """Energy error against speed, one line per method, the title saying what SIER4G gains over Verlet."""
    points, costs = record.tables["points"], record.tables["costs"]
    usual = points[(points["method"] == VERLET) & (points["fs_per_force"] == USUAL)]["fs_per_second"].mean()
    speeds = costs.pivot(index="percent", columns="method", values="fs_per_second")
    gains = (speeds[SIER4G.name] / speeds[VERLET]).dropna()
    title = f"At the same energy error SIER4G simulates\n{gains.min():.1f} to {gains.max():.1f} times as much as Verlet"
    with style.one_message(path, title, height=6) as axes:
        shown = points.assign(speed=points["fs_per_second"] / usual)
        style.curves(axes, shown, "speed", "percent", lw=2, markersize=8)
        axes.set(xlabel=f"speed over Verlet's at {USUAL:g} fs", ylabel="energy error within 1 ps\n(% of rms(V))")
        style.logarithmic(axes)
        axes.annotate(
            "better", (0.97, 0.03), (0.86, 0.1), "axes fraction", fontsize=13, arrowprops={"arrowstyle": "->"}
        )
        axes.figure.legend(*axes.get_legend_handles_labels(), loc="outside right upper", fontsize=12)


def study(settings: BenchSettings, report: Report = SILENT) -> Record:
    """All methods at all their steps from one equilibrated start, and what an energy error costs.

    Writes bench.json and bench.png, with `points`, rms(H)/rms(V) in per cent and the simulated time per second, both
    NaN where a method broke down, and `costs`, see `costs_of`.
    """
    liquid = equilibrated_liquid(settings, settings.equilibrate, report)
    measured = measure(liquid, METHODS, settings.time, report)
    for peer, water in _peers(liquid, report):
        for dt in SECOND_ORDER:
            measured.append(_point(peer.name, dt, partial(_of_peer, peer, water, dt, settings), report))
    points = pd.DataFrame(measured)
    tables = {"points": points, "costs": costs_of(points)}
    report.table("Energy error and speed", text.table(points, POINTS))
    report.table("Cost of an accuracy; - where the steps do not enclose it", text.table(tables["costs"], COSTS))
    of_processor = counts_processor_time(settings.platform)
    builds = {peer.name: peer.build for peer in peers.installed()}
    notes = {"peers": builds, "clock": "processor" if of_processor else "wall", "threads": threads.count()}
    record = Record(settings.recorded(), tables, notes).write(settings.out / "bench.json")
    figure(record, settings.out / "bench.png")
    return record


main = command(BenchSettings, study, __doc__, __name__)
