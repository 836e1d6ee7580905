#!/usr/bin/env python3
"""Energy error by the settings of the System: tolerance and balance of PME, cut-off, switch; SIER4G beside Verlet.

    python -m studies.checks.defaults                                 the whole table: 192 runs of 1 ps, half an hour
    python -m studies.checks.defaults --tolerance 5e-4 --starts 1     some of it

Each run is kept in `--out` as soon as it is done, and is not repeated: a command that was stopped goes on where it was.
"""

import argparse
import json
import sys
import warnings
from itertools import product
from pathlib import Path

import numpy as np
import openmm
from openmm import app

from openmm_sier import RigidBodies, SIERLangevinIntegrator
from openmm_sier.measure.forcefields import Interactions, pme_system, read_box, shipped_box
from openmm_sier.measure.observables import energy_error
from openmm_sier.measure.starts import make_context
from studies.sampling import CONSTRAINT_TOLERANCE, nve_methods, sample

#: Steps in fs of the integrators, which have the same simulated time per force evaluation; and between two samples.
STEPS = {"verlet": 2, "sier4g": 6}
EVERY = 12

TEMPERATURE, EQUILIBRATION = 297.0, 2.0


def start(box, seed: int, out: Path, platform: str | None) -> openmm.State:
    """A phase point of the equilibrated box, which is kept beside the table."""
    path = out.with_suffix(f".start-{seed}.xml")
    if not path.exists():
        integrator = SIERLangevinIntegrator(TEMPERATURE, 5.0, 0.006)
        integrator.setRandomNumberSeed(seed)
        context = make_context(box.system, integrator, platform)
        context.setPositions(box.positions)
        context.setVelocitiesToTemperature(TEMPERATURE, seed)
        integrator.step(round(EQUILIBRATION / 0.006))
        path.write_text(openmm.XmlSerializer.serialize(context.getState(positions=True, velocities=True)))
    return openmm.XmlSerializer.deserialize(path.read_text())


def error_of(system: openmm.System, method: str, state: openmm.State, options: argparse.Namespace) -> float:
    """rms(H)/rms(V) in percent over a run from a state."""
    integrator = nve_methods()[method].make(STEPS[method] / 1000)
    integrator.setConstraintTolerance(CONSTRAINT_TOLERANCE)
    context = make_context(system, integrator, options.platform)
    context.setPositions(state.getPositions())
    context.setVelocities(state.getVelocities())
    steps = round(1000 * options.time / STEPS[method])
    found = sample(context, RigidBodies.from_system(system), steps, EVERY // STEPS[method])
    return 100 * energy_error(found.time, found.total, found.potential)


def rows_of(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def table(rows: list[dict]) -> str:
    """Means over the starts, with their ranges, in Markdown."""
    cells: dict[tuple, dict[str, list[float]]] = {}
    for row in rows:
        key = tuple(row[name] for name in ("tolerance", "cutoff", "switch", "balanced"))
        cells.setdefault(key, {name: [] for name in STEPS})[row["method"]].append(row["error"])
    lines = [
        "| ewaldErrorTolerance | cut-off, nm | switch | PME | OpenMM Verlet, 2 fs | SIER4G, 6 fs |",
        "|---|---|---|---|---|---|",
    ]
    for (tolerance, cutoff, switch, balanced), found in sorted(cells.items(), key=lambda cell: (-cell[0][0], *cell[0])):
        words = f"{tolerance:g} | {cutoff:g} | {'yes' if switch else 'no'} | {'balanced' if balanced else 'as it is'}"
        lines.append(f"| {words} | {' | '.join(_mean(found[name]) for name in STEPS)} |")
    return "\n".join(lines)


def _mean(errors: list[float]) -> str:
    return f"{np.mean(errors):.3g} ({min(errors):.2g} to {max(errors):.2g})" if errors else ""


def main(arguments=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tolerance", nargs="+", type=float, default=[5e-4, 1e-4, 1e-5])
    parser.add_argument("--cutoff", nargs="+", type=float, default=[0.9, 1.0], help="nm")
    parser.add_argument("--switch", nargs="+", choices=("yes", "no"), default=["no", "yes"])
    parser.add_argument("--balanced", nargs="+", choices=("yes", "no"), default=["no", "yes"])
    parser.add_argument("--methods", nargs="+", choices=STEPS, default=list(STEPS))
    parser.add_argument("--starts", type=int, default=4)
    parser.add_argument("--time", type=float, default=1.0, help="ps")
    parser.add_argument("--out", type=Path, default=Path("defaults.jsonl"))
    parser.add_argument("--platform")
    options = parser.parse_args(arguments)
    # The notice of PME that is not balanced is what is measured here.
    warnings.filterwarnings("ignore", "PME is split as OpenMM does it")
    box = read_box(shipped_box())
    forcefield = app.ForceField(*box.choice.files)
    done = {tuple(row.items())[:-1] for row in rows_of(options.out)}
    for tolerance, cutoff, switch, balanced in product(
        options.tolerance, options.cutoff, options.switch, options.balanced
    ):
        settings = Interactions(cutoff, None if switch == "yes" else 0.0, tolerance, balanced=balanced == "yes")
        system = pme_system(box.topology, forcefield, None, settings)
        for seed, method in product(range(1, options.starts + 1), options.methods):
            row = {"tolerance": tolerance, "cutoff": cutoff, "switch": switch == "yes", "balanced": balanced == "yes"}
            row |= {"method": method, "seed": seed, "time": options.time}
            if tuple(row.items()) not in done:
                row["error"] = error_of(system, method, start(box, seed, options.out, options.platform), options)
                with options.out.open("a") as file:
                    print(json.dumps(row), file=file)
                print(row, flush=True)
    print(table([row for row in rows_of(options.out) if row["time"] == options.time]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
