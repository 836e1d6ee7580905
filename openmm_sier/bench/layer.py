"""What the layer above the forces costs by itself: time and memory against the number of bodies, and start-up."""

from __future__ import annotations

import subprocess
import sys
import time
from functools import partial

import numpy as np
import openmm

from openmm_sier import console
from openmm_sier.bench.timing import Settings, interleaved, summary
from openmm_sier.integrator import SIER2Integrator

STEP = 1e-3
STEPS = 20

#: Sizes for the growth of cost and memory; below, calls cost more than bodies.
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


def context_of(n: int, integrator) -> openmm.Context:
    """Free water at 297 K on the CPU platform."""
    system, positions = free_water(n)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("CPU"))
    context.setPositions(positions)
    context.setVelocitiesToTemperature(297, 1)
    return context


def measure(settings: Settings) -> dict:
    """Nanoseconds a body and step of the layer, growth exponent, bytes a molecule, seconds of start-up."""
    sizes = [n for n in settings.bodies if SMALLEST <= n <= LARGEST] or [settings.bodies[-1]]
    cost = {n: _nanoseconds(n, settings.rounds) for n in sizes}
    record: dict = {"nanoseconds": cost}
    if len(sizes) > 1:
        slope = np.polyfit(np.log(sizes), np.log([cost[n][0] * n for n in sizes]), 1)[0]
        record["growth_exponent"] = float(slope)
    n = sizes[-1]
    peaks = {name: peak_memory(name, n) for name in ("VerletIntegrator", "SIER2Integrator")}
    record["bytes_per_molecule"] = (peaks["SIER2Integrator"] - peaks["VerletIntegrator"]) / n
    return record | {"seconds": start_up(settings)}


def _nanoseconds(n: int, rounds: int) -> tuple[float, float]:
    """Of a step of free bodies, less those of the calls that any force evaluation takes."""
    context = context_of(n, SIER2Integrator(STEP))
    bare = context_of(n, openmm.VerletIntegrator(STEP))
    positions = bare.getState(positions=True).getPositions(asNumpy=True)._value.copy()

    def forces():
        for _ in range(STEPS):
            bare.setPositions(positions)
            bare.getState(forces=True)

    seconds = interleaved({"bare": forces, "step": partial(context.getIntegrator().step, STEPS)}, rounds)
    return summary(1e9 * (seconds["step"] - seconds["bare"]) / (STEPS * n))


def peak_memory(integrator: str, n: int) -> int:
    """Bytes at the peak of a process that makes a Context of free water and goes some steps."""
    code = f"""
import resource, openmm
from openmm_sier import SIER2Integrator, compiled
from openmm_sier.bench import layer
compiled.executor()
make = {{"VerletIntegrator": openmm.VerletIntegrator, "SIER2Integrator": SIER2Integrator}}[{integrator!r}]
context = layer.context_of(10, SIER2Integrator(0.001))
context.getIntegrator().step(1)
context = layer.context_of({n}, make(0.001))
context.getIntegrator().step(3)
context.getState(forces=True)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""
    peak = int(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)
    return peak if sys.platform == "darwin" else 1024 * peak


def start_up(settings: Settings) -> dict[str, float]:
    """Seconds for the import, and from there to the end of the first step, with OpenMM's Verlet and with SIER2."""
    imports = {
        "import openmm.app": _seconds("import openmm.app"),
        "import openmm_sier besides": _seconds("import openmm.app, openmm_sier"),
    }
    imports["import openmm_sier besides"] -= imports["import openmm.app"]
    script = """
import openmm, openmm_sier
from openmm_sier.bench import layer
context = layer.context_of(512, {}(0.001))
context.getIntegrator().step(1)
"""
    alone = _seconds("import openmm, openmm_sier; from openmm_sier.bench import layer")
    for name in ("openmm.VerletIntegrator", "openmm_sier.SIER2Integrator"):
        imports[f"first step of 512 molecules, {name.partition('.')[2]}"] = _seconds(script.format(name)) - alone
    return imports


def _seconds(code: str, repeats: int = 3) -> float:
    """The least wall time of a fresh interpreter that executes the code, less that of an empty one."""

    def least(text: str) -> float:
        times = []
        for _ in range(repeats):
            start = time.perf_counter()
            subprocess.run([sys.executable, "-c", text], check=True, capture_output=True)
            times.append(time.perf_counter() - start)
        return min(times)

    return least(code) - least("pass")


def show(record: dict) -> None:
    """Print the table."""
    rows = [
        [f"{n} bodies, ns a body and step", f"{cost[0]:.3g} ± {cost[1]:.1g}"]
        for n, cost in record["nanoseconds"].items()
    ]
    if "growth_exponent" in record:
        rows.append(["exponent of its growth with the number of bodies", f"{record['growth_exponent']:.3f}"])
    rows.append(["memory, bytes a molecule beyond OpenMM's", f"{record['bytes_per_molecule']:.0f}"])
    rows += [[f"{name}, s", f"{value:.2f}"] for name, value in record["seconds"].items()]
    console.table("The layer above the forces, at free molecules", ["", ""], rows)
