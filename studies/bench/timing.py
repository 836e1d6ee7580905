"""Timings that allow for a machine's changing speed, with the machine and versions that they depend on."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import openmm

from openmm_sier.dynamics import backend
from openmm_sier.dynamics.backend import threads
from openmm_sier.measure.force_clock import ForceClock
from openmm_sier.version import __version__


@dataclass(frozen=True)
class BenchSettings:
    """Settings of the benchmark.

    Attributes:
        box: PDB file of the unit that larger boxes repeat.
        forcefield: of it; None picks one.
        copies: repetitions of the box along each edge, one number for each size.
        bodies: sizes of the sets of bodies for the rotation and the layer alone.
        rounds: how often everything takes its turn; steps in small boxes do so more often, in large ones less often.
        time: length of the runs that measure the energy error, ps.
        temperature, equilibrate: K, and ps before those runs.
        parts: names of what is measured, from `studies.bench.PARTS`; None takes `platform` if a platform is
            given, and all others if not.
        platform: OpenMM platform; None takes the fastest.
        molecules: numbers of molecules for the platform, multiples of that of the box.
        seed: of velocities.
    """

    box: Path
    forcefield: list[str] | None = None
    copies: tuple[int, ...] = (1, 2, 4)
    bodies: tuple[int, ...] = (512, 4096, 32768, 131072)
    rounds: int = 8
    time: float = 1.0
    temperature: float = 297.0
    equilibrate: float = 2.0
    parts: tuple[str, ...] | None = None
    platform: str | None = None
    molecules: tuple[int, ...] = (512, 4096, 32768, 98304)
    seed: int = 1


def machine() -> dict:
    """The machine and the versions that timings depend on."""
    model = platform.processor() or platform.machine()
    for line in Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []:
        if line.startswith("model name"):
            model = line.partition(":")[2].strip()
            break
    return {
        "processor": model,
        "cores": os.cpu_count(),
        "threads": threads.count(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "openmm": openmm.__version__,
        "openmm_sier": __version__,
        "backend": backend.active().name,
    }


def interleaved(actions: Mapping[str, Callable[[], None]], rounds: int) -> dict[str, np.ndarray]:
    """Seconds that each action took in each round; a first round is not counted.

    Actions to be compared should take their turns within some tenths of a second: a machine's speed changes over
    seconds.
    """
    times: dict[str, list[float]] = {name: [] for name in actions}
    for number in range(rounds + 1):
        for name, action in actions.items():
            start = time.perf_counter()
            action()
            if number:
                times[name].append(time.perf_counter() - start)
    return {name: np.array(values) for name, values in times.items()}


def apart(clock: ForceClock, action: Callable[[], object]) -> tuple[float, float]:
    """Seconds that an action takes outside and inside the force calls that a clock counts."""
    before, start = clock.seconds, time.perf_counter()
    action()
    total, inside = time.perf_counter() - start, clock.seconds - before
    return total - inside, inside
