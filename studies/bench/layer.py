"""Cost of the layer above the forces alone: time and memory against the number of bodies, and start-up."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
import openmm
import pandas as pd

from openmm_sier.integrators.named import SIER2Integrator
from openmm_sier.measure.force_clock import ForceClock
from studies import records
from studies.bench.timing import BenchSettings, apart, median_and_error
from studies.report import Report, Table

STEP = 1e-3
STEPS = 20

#: Sizes between which growth of cost and memory is measured; below, calls cost more than bodies.
SMALLEST, LARGEST = 4096, 131072

OH, HH = 0.09572, 0.15139


def free_water(n: int) -> tuple[openmm.System, np.ndarray]:
    """Water molecules without interactions: the System and positions (3 n, 3)."""
    system = openmm.System()
    for _ in range(n):
        oxygen, *hydrogens = (system.addParticle(mass) for mass in (15.99943, 1.007947, 1.007947))
        for hydrogen in hydrogens:
            system.addConstraint(oxygen, hydrogen, OH)
        system.addConstraint(*hydrogens, HH)
    half = np.arcsin(HH / 2 / OH)
    sites = OH * np.array([[0, 0, 0], [np.cos(half), np.sin(half), 0], [np.cos(half), -np.sin(half), 0]])
    places = np.random.default_rng(1).uniform(0, 10, (n, 1, 3))
    return system, (places + sites).reshape(-1, 3)


def context_of(n: int, integrator: openmm.Integrator) -> openmm.Context:
    """Free water at 297 K on the CPU platform."""
    system, positions = free_water(n)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("CPU"))
    context.setPositions(positions)
    context.setVelocitiesToTemperature(297, 1)
    return context


def find(settings: BenchSettings, report: Report) -> dict[str, pd.DataFrame]:
    """Nanoseconds of the layer per body and step, their growth, memory per molecule, seconds of start-up."""
    sizes = [n for n in settings.bodies if SMALLEST <= n <= LARGEST] or [settings.bodies[-1]]
    cost = _nanoseconds(sizes, settings.rounds)
    found = {f"{n} bodies, ns a body and step": measured for n, measured in cost.items()}
    if len(sizes) > 1:
        slope = np.polyfit(np.log(sizes), np.log([cost[n][0] * n for n in sizes]), 1)[0]
        found["exponent of its growth with the number of bodies"] = (float(slope), math.nan)
    if (memory := bytes_per_molecule(sizes[-1])) is not None:
        found["memory, bytes a molecule beyond OpenMM's"] = (memory, math.nan)
    found |= {f"{name}, s": (seconds, math.nan) for name, seconds in start_up().items()}
    return {"layer": pd.DataFrame([{"what": what, "value": v, "value_error": e} for what, (v, e) in found.items()])}


def tables(found: Mapping[str, pd.DataFrame]) -> list[Table]:
    """The costs, for the report."""
    title = "The layer above the forces, at free molecules"
    return [records.table(title, found["layer"], {"": "{what}", " ": "{value:.4g} ± {value_error:.1g}"})]


def _nanoseconds(sizes: list[int], rounds: int) -> dict[int, tuple[float, float]]:
    """Nanoseconds per body of a step of free bodies, outside the force calls. Sizes take turns of equal length."""
    contexts = {n: context_of(n, SIER2Integrator(STEP)) for n in sizes}
    clocks = {n: ForceClock(context) for n, context in contexts.items()}
    found, largest = np.empty((rounds + 1, len(sizes))), max(sizes)
    for turn in found:
        for i, n in enumerate(sizes):
            calls = largest // n
            outside, _ = apart(clocks[n], partial(_run, contexts[n].getIntegrator(), calls))
            turn[i] = 1e9 * outside / (calls * STEPS * n)
    # The first turn does the set-up for later ones, and does not count.
    return {n: median_and_error(values)[:2] for n, values in zip(sizes, found[1:].T, strict=True)}


def _run(integrator: openmm.Integrator, calls: int) -> None:
    for _ in range(calls):
        integrator.step(STEPS)


def bytes_per_molecule(n: int) -> float | None:
    """Memory of a Context with SIER2 beyond that of one with Verlet; None where the system does not report it.

    A first Context uses up what was free in the heap, so that the second and third show what they need.
    """
    if not Path("/proc/self/statm").exists():
        return None
    code = f"""
import resource
import openmm
from openmm_sier import SIER2Integrator
from studies.bench import layer

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * resource.getpagesize()

warm = layer.context_of(10, SIER2Integrator(0.001))
warm.getIntegrator().step(1)
system, positions = layer.free_water({n})
used, contexts = [], []
for make in (openmm.VerletIntegrator, openmm.VerletIntegrator, SIER2Integrator):
    context = openmm.Context(system, make(0.001), openmm.Platform.getPlatformByName("CPU"))
    context.setPositions(positions)
    context.setVelocitiesToTemperature(297, 1)
    context.getIntegrator().step(3)
    context.getState(forces=True)
    contexts.append(context)
    used.append(resident())
print((used[2] - used[1]) - (used[1] - used[0]))
"""
    return float(_printed(code)) / n


def start_up() -> dict[str, float]:
    """Seconds for imports, and for the first step of 512 molecules after them, with OpenMM's Verlet and with SIER2."""
    found = {
        "import of openmm.app": _least("", "import openmm.app"),
        "import of openmm_sier after it": _least("import openmm.app", "import openmm_sier"),
    }
    imports = "import openmm, openmm_sier, numpy; from studies.bench.layer import free_water, context_of"
    for name in ("openmm.VerletIntegrator", "openmm_sier.SIER2Integrator"):
        step = f"context = context_of(512, {name}(0.001)); context.getIntegrator().step(1)"
        found[f"Context and first step of 512 molecules, {name.partition('.')[2]}"] = _least(imports, step)
    return found


def _least(before: str, timed: str, repeats: int = 3) -> float:
    """The least wall time that a fresh interpreter takes for a piece of code, after another one."""
    code = f"{before}\nimport time\nstart = time.perf_counter()\n{timed}\nprint(time.perf_counter() - start)"
    return min(float(_printed(code)) for _ in range(repeats))


def _printed(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
