#!/usr/bin/env python3
"""Energy error and cost of solvated molecules that are not rigid, beside OpenMM's Verlet.

    python benchmarks/molecules.py start systems/peptide.pdb --out start.xml      equilibrate, and keep the phase point
    python benchmarks/molecules.py energy systems/peptide.pdb --start start.xml --time 2 --step 1.5 2
    python benchmarks/molecules.py cost systems/peptide.pdb --start start.xml     time of a step over its force calls

Steps are in fs for each force evaluation. Bonds of hydrogen are constrained, PME is balanced at a tolerance of 1e-5,
and bonded forces act within the drifts (`--kicks` leaves them in the kicks).
"""

import argparse
import sys
from pathlib import Path
from time import perf_counter

import numpy as np
import openmm

from openmm_sier import SIERIntegrator, SIERLangevinIntegrator, prepare_system
from openmm_sier.dynamics import backend
from openmm_sier.dynamics.schemes import CATALOGUE
from openmm_sier.measure.force_clock import ForceClock
from openmm_sier.measure.forcefields import read_box
from openmm_sier.measure.observables import energy_drift, energy_error, energy_fluctuation
from openmm_sier.measure.starts import make_context

TEMPERATURE = 297.0


def box_of(options):
    box = read_box(options.box, constraints="hbonds")
    return box, prepare_system(box.system)


def start(options) -> None:
    """Equilibrate at constant temperature and keep the phase point."""
    box, prepared = box_of(options)
    integrator = SIERLangevinIntegrator(TEMPERATURE, 5.0, 0.006, fastForceGroups=prepared.fastForceGroups)
    integrator.setRandomNumberSeed(options.seed)
    context = make_context(box.system, integrator, options.platform)
    context.setPositions(box.positions)
    openmm.LocalEnergyMinimizer.minimize(context, 10, 100)
    context.setVelocitiesToTemperature(TEMPERATURE, options.seed)
    integrator.step(round(options.time / 0.006))
    print(integrator.computeTemperatures())
    options.out.write_text(openmm.XmlSerializer.serialize(context.getState(positions=True, velocities=True)))


def context_of(options, box, integrator):
    context = make_context(box.system, integrator, options.platform)
    state = openmm.XmlSerializer.deserialize(options.start.read_text())
    context.setPeriodicBoxVectors(*state.getPeriodicBoxVectors())
    context.setPositions(state.getPositions())
    context.setVelocities(state.getVelocities())
    return context


def integrator_of(name: str, per_force: float, options, groups):
    """An integrator by name, and its step in ps."""
    if name == "verlet":
        integrator = openmm.VerletIntegrator(per_force)
        integrator.setConstraintTolerance(1e-8)
        return integrator, per_force
    scheme = CATALOGUE[name]
    step = per_force * scheme.force_evaluations
    groups = None if options.kicks else groups
    return SIERIntegrator(step, scheme, substeps=options.substeps, fastForceGroups=groups), step


def energy(options) -> None:
    """rms(H)/rms(V), and the drift, of runs from one phase point."""
    box, prepared = box_of(options)
    reference: dict[float, float] = {}
    for per_force in options.step:
        for name in options.methods:
            integrator, step = integrator_of(name, per_force / 1000, options, prepared.fastForceGroups)
            context = context_of(options, box, integrator)
            every = max(1, round(options.every / 1000 / step))
            rows = []
            for _ in range(round(options.time / (every * step))):
                integrator.step(every)
                state = context.getState(energy=True)
                V, K = (e._value for e in (state.getPotentialEnergy(), state.getKineticEnergy()))
                rows.append((state.getTime()._value, V + K, V))
            time, total, potential = np.array(rows).T
            error = 100 * energy_error(time, total, potential)
            reference.setdefault(per_force, error)
            drift, uncertainty = energy_drift(time, total)
            print(
                f"{name:8} {per_force:4g} fs per force: rms(H)/rms(V) {error:.4f} %, Verlet's over it "
                f"{reference[per_force] / error:.1f}, rms(H) {energy_fluctuation(time, total):.4f} kJ/mol, "
                f"drift {drift:+.3f} +- {uncertainty:.3f} kJ/mol/ps",
                flush=True,
            )
            del context, integrator


def cost(options) -> None:
    """Time of steps over that of the force calls in them: medians over short turns."""
    box, prepared = box_of(options)
    for name in options.methods:
        if name == "verlet":
            continue
        integrator, _ = integrator_of(name, 0.002, options, prepared.fastForceGroups)
        context = context_of(options, box, integrator)
        integrator.step(3)
        clock = ForceClock(context)
        ratios = []
        for _ in range(options.turns):
            before, begun = clock.seconds, perf_counter()
            integrator.step(4)
            ratios.append((perf_counter() - begun) / (clock.seconds - before))
        quartiles = np.percentile(ratios, [25, 50, 75])
        print(
            f"{name:8} {backend.active().name}: a step takes {quartiles[1]:.3f} of its force calls "
            f"({quartiles[0]:.3f} to {quartiles[2]:.3f} for half of the turns)"
        )


def main(arguments=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("start", "energy", "cost"))
    parser.add_argument("box", type=Path)
    parser.add_argument("--start", type=Path, help="phase point to start from")
    parser.add_argument("--out", type=Path, default=Path("start.xml"))
    parser.add_argument("--methods", nargs="+", default=["verlet", "sier4g", "sier4p"])
    parser.add_argument("--step", nargs="+", type=float, default=[1.5, 2.0], help="fs for each force evaluation")
    parser.add_argument("--time", type=float, default=2.0, help="ps")
    parser.add_argument("--every", type=float, default=12.0, help="fs between two samples")
    parser.add_argument("--substeps", type=int, help="inner steps in the longest drift")
    parser.add_argument("--kicks", action="store_true", help="leave bonded forces in the kicks")
    parser.add_argument("--turns", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--platform")
    options = parser.parse_args(arguments)
    {"start": start, "energy": energy, "cost": cost}[options.what](options)
    return 0


if __name__ == "__main__":
    sys.exit(main())
