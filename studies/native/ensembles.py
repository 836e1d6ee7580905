"""Temperatures and density with the native engine beside the exact one, at 2 fs per force evaluation.

    python -m studies.native.ensembles nvt | npt [--engines native exact] [--box systems/tip3p-512.pdb]
        [--molecules 125] [--time 100] [--friction 50] [--on CPU] [--seed 5]

SIER4G with a heat bath; in npt at 1 bar, by OpenMM's MonteCarloBarostat with the native engine and by `pressure=` with
the exact one. Prints T_trans, T_rot and the density with their standard errors from block averages.

A box of 125 molecules is as good as a large one here: errors depend on molecules times simulated time, and both
engines have the same box.
"""

from __future__ import annotations

import argparse

import numpy as np
import openmm
from openmm import unit

from openmm_sier import SIER4G, SIERLangevinIntegrator
from openmm_sier.measure.statistics import mean_and_error
from studies.native.accuracy import SYSTEMS, TEMPERATURE, context_on, start

#: ps: the step, and what is left out at the beginning; steps between two moves of the volume.
STEP, SETTLING, MOVES = 0.006, 2.0, 5

TOLERANCE = 1e-4


def run(engine: str, options: argparse.Namespace) -> None:
    """Print the line of one engine."""
    system, state, _ = start(options.box, options.molecules, TOLERANCE)
    pressure = None
    if options.ensemble == "npt" and engine == "native":
        system.addForce(openmm.MonteCarloBarostat(1 * unit.bar, TEMPERATURE, MOVES))
    elif options.ensemble == "npt":
        pressure = 1 * unit.bar
    integrator = SIERLangevinIntegrator(
        TEMPERATURE, options.friction, STEP, SIER4G, engine=engine, pressure=pressure, barostatInterval=MOVES
    )
    integrator.setRandomNumberSeed(options.seed)
    context = context_on(options.on, system, integrator)
    context.setState(state)
    integrator.step(round(SETTLING / STEP) * (10 if options.ensemble == "npt" else 1))
    mass = sum(system.getParticleMass(i)._value for i in range(system.getNumParticles()))
    rows = []
    for _ in range(round(options.time / STEP)):
        integrator.step(1)
        found = integrator.computeTemperatures()
        density = mass / context.getState().getPeriodicBoxVolume()._value * 1.66053907e-3
        rows.append([found.translation, found.rotation, found.rotation - found.translation, density])
    cells = [mean_and_error(values)[:2] for values in np.array(rows).T]
    text = "  ".join(
        f"{name} {mean:.{digits}f} ± {error:.{digits}f}"
        for name, (mean, error), digits in zip(
            ("T_trans", "T_rot", "T_rot - T_trans", "g/cm³"), cells, (2, 2, 2, 4), strict=True
        )
    )
    print(f"{options.ensemble} {engine:6} {options.time:g} ps: {text}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ensemble", choices=("nvt", "npt"))
    parser.add_argument("--engines", nargs="+", default=["native", "exact"])
    parser.add_argument("--box", default=str(SYSTEMS / "tip3p-512.pdb"))
    parser.add_argument("--molecules", type=int, default=125)
    parser.add_argument("--time", type=float, default=100.0)
    parser.add_argument("--friction", type=float, default=50.0)
    parser.add_argument("--on", default="CPU")
    parser.add_argument("--seed", type=int, default=5)
    options = parser.parse_args()
    for engine in options.engines:
        run(engine, options)


if __name__ == "__main__":
    main()
