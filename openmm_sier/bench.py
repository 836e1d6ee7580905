"""What a step costs beyond its forces: the measurements behind `openmm-sier bench`.

All timings of one table come from one run. What is compared takes turns, several rounds of it, and ratios are taken
within a round, so that the drift of a machine's speed cancels; medians over the rounds are shown with half the range
between the quartiles.
"""

from __future__ import annotations

import json
import os
import platform
import resource
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier import baselines, compiled, console, rotor
from openmm_sier.bodies import GAS_CONSTANT
from openmm_sier.forcefields import load, pme_system, read_box
from openmm_sier.integrator import SIERIntegrator
from openmm_sier.preparation import make_context
from openmm_sier.schemes import SIER2, SIER4
from openmm_sier.version import __version__

#: Step per force evaluation of every method, ps.
STEP = 1e-3

WATER_MOMENTS = (0.0061, 0.0115, 0.0176)


@dataclass(frozen=True)
class Settings:
    """What is measured.

    Attributes:
        box: PDB file of the unit that larger boxes repeat.
        forcefield: of it; None picks one.
        copies: repetitions of the box along each edge, one size each.
        bodies: sizes of the sets of bodies for the rotation alone.
        rounds: how often everything takes its turn.
        platform: OpenMM platform; None takes the fastest.
    """

    box: Path
    forcefield: list[str] | None = None
    copies: tuple[int, ...] = (1, 2, 4)
    bodies: tuple[int, ...] = (512, 4096, 32768, 131072)
    rounds: int = 7
    platform: str | None = None


@dataclass(frozen=True)
class Ratio:
    """A cost relative to another: median over rounds and half the range between the quartiles."""

    name: str
    molecules: int
    median: float
    spread: float
    milliseconds: float


def run(settings: Settings, out: Path) -> dict:
    """Measure, print the tables, and write bench.json to a directory."""
    out.mkdir(parents=True, exist_ok=True)
    here = machine()
    record: dict[str, Any] = {"machine": here, "settings": asdict(settings) | {"box": settings.box.name}}
    console.note(", ".join(f"{name} {value}" for name, value in here.items()))
    record["steps"] = [asdict(ratio) for copies in settings.copies for ratio in _step_ratios(copies, settings)]
    record["rotations"] = rotations(settings)
    _show(record)
    (out / "bench.json").write_text(json.dumps(record, indent=1, default=str))
    return record


def machine() -> dict:
    """What the timings depend on."""
    model = platform.processor() or platform.machine()
    for line in Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []:
        if line.startswith("model name"):
            model = line.partition(":")[2].strip()
            break
    return {
        "processor": model,
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "openmm": openmm.__version__,
        "openmm_sier": __version__,
        "executor": "NumPy" if compiled.executor() is None else "Numba",
    }


def interleaved(actions: Mapping[str, Callable[[], None]], rounds: int) -> dict[str, np.ndarray]:
    """Seconds that each action took in each round; one round before is not counted."""
    times: dict[str, list[float]] = {name: [] for name in actions}
    for number in range(rounds + 1):
        for name, action in actions.items():
            start = time.perf_counter()
            action()
            if number:
                times[name].append(time.perf_counter() - start)
    return {name: np.array(values) for name, values in times.items()}


def summary(values: np.ndarray) -> tuple[float, float]:
    """Median, and half the range between the quartiles."""
    low, median, high = np.percentile(values, [25, 50, 75])
    return float(median), float(0.5 * (high - low))


# --- steps ---


def _step_ratios(copies: int, settings: Settings) -> list[Ratio]:
    topology, positions, system = repeated_box(settings, copies)
    molecules = topology.getNumResidues()
    evaluations = max(8, 4 * round(50 / copies**3))
    start = _start(system, positions, settings)
    frames = _frames(system, start, evaluations, settings)
    integrators = {
        "SIER2": SIERIntegrator(STEP, SIER2),
        "SIER4": SIERIntegrator(4 * STEP, SIER4),
        "OpenMM Verlet": openmm.VerletIntegrator(STEP),
        "OpenMM LangevinMiddle": openmm.LangevinMiddleIntegrator(297, 1, STEP),
    }
    contexts = {name: _context_at(system, integrator, start, settings) for name, integrator in integrators.items()}
    bare = _context_at(system, openmm.VerletIntegrator(STEP), start, settings)

    def forces():
        for frame in frames:
            bare.setPositions(frame)
            bare.getState(forces=True)

    actions = {"bare force": forces}
    for name, context in contexts.items():
        steps = evaluations // 4 if name == "SIER4" else evaluations
        actions[name] = partial(context.getIntegrator().step, steps)
    seconds = interleaved(actions, settings.rounds)
    pairs = [(name, "bare force") for name in integrators] + [("SIER2", "OpenMM Verlet")]
    ratios = []
    for name, base in pairs:
        median, spread = summary(seconds[name] / seconds[base])
        cost = 1e3 * float(np.median(seconds[name])) / evaluations
        ratios.append(Ratio(f"{name} / {base}", molecules, median, spread, cost))
        console.note(f"{molecules} molecules: {ratios[-1].name} = {median:.3f} ± {spread:.3f}")
    return ratios


def repeated_box(settings: Settings, copies: int):
    """Topology, positions (N, 3) and System of a box repeated along each edge."""
    box = read_box(settings.box, settings.forcefield)
    lengths = np.array(box.positions.value_in_unit(unit.nanometer))
    vectors = np.array(box.topology.getPeriodicBoxVectors().value_in_unit(unit.nanometer))
    if copies == 1:
        return box.topology, lengths, box.system
    model = app.Modeller(box.topology, box.positions)
    shifts = np.stack(np.meshgrid(*[np.arange(copies)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) @ vectors
    for shift in shifts[1:]:
        model.add(box.topology, (lengths + shift) * unit.nanometer)
    model.topology.setPeriodicBoxVectors(copies * vectors * unit.nanometer)
    positions = (lengths + shifts[:, None]).reshape(-1, 3)
    return model.topology, positions, pme_system(model.topology, load(box.choice.files, settings.box.parent))


def _start(system, positions, settings: Settings):
    context = make_context(system, openmm.VerletIntegrator(STEP), settings.platform)
    context.setPositions(positions)
    context.applyConstraints(1e-6)
    context.setVelocitiesToTemperature(297, 1)
    return context.getState(positions=True, velocities=True)


def _context_at(system, integrator, start, settings: Settings):
    context = make_context(system, integrator, settings.platform)
    context.setState(start)
    return context


def _frames(system, start, count: int, settings: Settings) -> list[np.ndarray]:
    """Positions of consecutive steps: forces at positions that do not move would be cheaper than in a simulation."""
    integrator = openmm.VerletIntegrator(STEP)
    context = _context_at(system, integrator, start, settings)
    frames = []
    for _ in range(count):
        integrator.step(1)
        state = context.getState(positions=True)
        frames.append(state.getPositions(asNumpy=True).value_in_unit(unit.nanometer).copy())
    return frames


# --- rotations ---


def rotations(settings: Settings) -> list[dict[str, Any]]:
    """Nanoseconds a body of each free-rotation map at the thermal motion of water, for several numbers of bodies."""
    rows = []
    for n in settings.bodies:
        repeats = max(1, 20000 // n)
        arguments = (*thermal_rotors(n), repeats)
        actions = {
            name: partial(_rotate, rotation, *arguments)
            for name, rotation in (("exact", rotor.exact), ("MRDL", baselines.mrdl), ("SEJ4", baselines.sej4))
        }
        if compiled.executor() is not None:
            actions["exact, NumPy"] = partial(_rotate_by_numpy, *arguments)
        seconds = interleaved(actions, settings.rounds)
        row: dict[str, Any] = {"bodies": n}
        row |= {name: summary(1e9 * values / (repeats * n)) for name, values in seconds.items()}
        numpy = seconds.get("exact, NumPy", seconds["exact"])
        row["exact / MRDL, both NumPy"] = summary(numpy / seconds["MRDL"])
        rows.append(row)
    return rows


def _rotate(rotation, A, L, repeats: int) -> None:
    for _ in range(repeats):
        rotation(A, L, WATER_MOMENTS, STEP)


def _rotate_by_numpy(A, L, repeats: int) -> None:
    with compiled.disabled():
        _rotate(rotor.exact, A, L, repeats)


def thermal_rotors(n: int, seed: int = 1):
    """Attitudes (3, 3, n) and angular momenta (3, n) of water molecules at 297 K."""
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.normal(size=(n, 3, 3)))
    A = q * np.sign(np.linalg.det(q))[:, None, None]
    tilde = rng.normal(size=(n, 3)) * np.sqrt(GAS_CONSTANT * 297 * np.array(WATER_MOMENTS))
    return np.ascontiguousarray(A.transpose(1, 2, 0)), np.ascontiguousarray(np.einsum("nab,na->bn", A, tilde))


def _show(record: dict) -> None:
    console.table(
        "Cost of a step, one force evaluation's worth of it",
        ["ratio", "molecules", "median", "± half the quartiles' range", "ms per force evaluation"],
        [
            [
                row["name"],
                str(row["molecules"]),
                f"{row['median']:.3f}",
                f"{row['spread']:.3f}",
                f"{row['milliseconds']:.3g}",
            ]
            for row in record["steps"]
        ],
    )
    names = [name for name in record["rotations"][0] if name != "bodies"]
    console.table(
        f"Free rotation, ns a body with {record['machine']['executor']} (MRDL and SEJ4: NumPy)",
        ["bodies", *names],
        [
            [str(row["bodies"]), *(f"{row[name][0]:.3g} ± {row[name][1]:.1g}" for name in names)]
            for row in record["rotations"]
        ],
        left=0,
    )
    console.note(f"largest memory so far: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")
