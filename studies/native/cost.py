"""Cost of a step by the native engine over that by the exact one, on the CPU or Reference platform.

    python -m studies.native.cost [--box systems/tip3p-512.pdb] [--on CPU] [--rounds 20]

Both take turns of 12 force evaluations in one process; ratios are those within a round, shown as their median and its
standard error. Times are processor times of the process, so other work on the machine counts little.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import openmm

from openmm_sier import SIERIntegrator
from openmm_sier.dynamics.schemes import CATALOGUE
from openmm_sier.measure import forcefields
from openmm_sier.measure.statistics import median_and_error
from studies.native.accuracy import SYSTEMS, TEMPERATURE, context_on

#: ps for each force evaluation, and force evaluations in a turn.
STEP, EVALUATIONS = 0.002, 12


def in_turns(actions: dict[str, Callable[[], object]], rounds: int) -> dict[str, np.ndarray]:
    """Seconds of processor time that each action took in each round; a first round is not counted."""
    times: dict[str, list[float]] = {name: [] for name in actions}
    for number in range(rounds + 1):
        for name, action in actions.items():
            begun = time.process_time()
            action()
            if number:
                times[name].append(time.process_time() - begun)
    return {name: np.array(values) for name, values in times.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--box", default=str(SYSTEMS / "tip3p-512.pdb"))
    parser.add_argument("--on", default="CPU")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--schemes", nargs="+", default=["sier2", "sier4g", "sier4p"], choices=CATALOGUE)
    options = parser.parse_args()
    box = forcefields.read_box(options.box)
    integrators: dict[str, tuple[int, openmm.Integrator]] = {"Verlet": (1, openmm.VerletIntegrator(STEP))}
    for scheme in map(CATALOGUE.__getitem__, options.schemes):
        n = scheme.force_evaluations
        for engine in ("exact", "native"):
            integrators[f"{scheme.name} {engine}"] = n, SIERIntegrator(n * STEP, scheme, engine=engine)
    actions, contexts = {}, []
    for name, (n, integrator) in integrators.items():
        context = context_on(options.on, box.system, integrator)
        context.setPositions(box.positions)
        context.applyConstraints(1e-6)
        context.setVelocitiesToTemperature(TEMPERATURE, 1)
        contexts.append(context)
        actions[name] = partial(integrator.step, EVALUATIONS // n)
    seconds = in_turns(actions, options.rounds)
    print(f"{Path(options.box).stem} on {options.on}")
    for name in options.schemes:
        exact, native = (seconds[f"{CATALOGUE[name].name} {engine}"] for engine in ("exact", "native"))
        for title, ratios in (("native / exact", native / exact), ("native / Verlet", native / seconds["Verlet"])):
            print(f"{CATALOGUE[name].name:7} {title:16} {median_and_error(ratios)}")


if __name__ == "__main__":
    main()
