"""Averages of liquid water at 1 bar by hybrid Monte Carlo and by Langevin dynamics, and what a sample costs.

    python -m studies.hmc.liquid run hmc --step 2 --time 400 --out hmc-2.npz
    python -m studies.hmc.liquid run sier2 --step 4 --time 400 --out sier2-4.npz
    python -m studies.hmc.liquid run langevin --step 0.25 --time 400 --out langevin-0.25.npz
    python -m studies.hmc.liquid table *.npz        runs with several seeds are pooled

Steps are in fs for each force evaluation. `hmc` and `sier4g` make steps of SIER4G, `langevin` is OpenMM's
LangevinMiddleIntegrator with its MonteCarloBarostat. All have the same System: PME with a cut-off of 0.7 nm, so that
many samples can be afforded.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from time import perf_counter

import numpy as np
import openmm
from openmm import app, unit
from pymbar.timeseries import statistical_inefficiency

from openmm_sier import SIER2, SIER4G, RigidBodies, SIERHMCIntegrator, SIERLangevinIntegrator, balance_pme
from openmm_sier.measure.sampling import observe
from openmm_sier.measure.starts import make_context

SYSTEMS = Path(__file__).resolve().parents[2] / "systems"
TEMPERATURE, CUTOFF, TOLERANCE = 297.0, 0.7, 1e-4

#: ps: from one sample to the next, which is the length of a trial; what is left out at the beginning.
EVERY, SETTLING = 0.12, 10.0

#: g/cm3 in daltons per nm3.
DENSITY = 1.66053907e-3


def water() -> tuple[app.PDBFile, openmm.System]:
    """512 molecules of TIP3P."""
    pdb = app.PDBFile(str(SYSTEMS / "tip3p-512.pdb"))
    system = app.ForceField("amber14/tip3p.xml").createSystem(
        pdb.topology,
        nonbondedMethod=app.PME,
        nonbondedCutoff=CUTOFF,
        switchDistance=CUTOFF - 0.15,
        ewaldErrorTolerance=TOLERANCE,
        removeCMMotion=False,
    )
    balance_pme(system)
    return pdb, system


def integrator_of(options: argparse.Namespace, system: openmm.System) -> tuple[openmm.Integrator, int]:
    """An integrator at 1 bar, and its number of steps in a sample."""
    scheme = {"sier2": SIER2, "langevin": None}.get(options.method, SIER4G)
    step = options.step / 1000 * (scheme.force_evaluations if scheme else 1)
    steps = round(EVERY / step)
    if options.method == "hmc":
        return SIERHMCIntegrator(TEMPERATURE, step, scheme, steps, pressure=1), steps
    if scheme:
        bath = SIERLangevinIntegrator(TEMPERATURE, options.friction, step, scheme, pressure=1, barostatInterval=steps)
        return bath, steps
    system.addForce(openmm.MonteCarloBarostat(1 * unit.bar, TEMPERATURE * unit.kelvin, steps))
    return openmm.LangevinMiddleIntegrator(TEMPERATURE, options.friction, step), steps


def run(options: argparse.Namespace) -> None:
    """One run; results so far are saved every 2 ps."""
    pdb, system = water()
    bodies = RigidBodies.from_system(system, pdb.topology)
    nonbonded = next(force for force in system.getForces() if isinstance(force, openmm.NonbondedForce))
    charges = np.array([nonbonded.getParticleParameters(i)[0]._value for i in range(system.getNumParticles())])
    integrator, steps = integrator_of(options, system)
    integrator.setRandomNumberSeed(options.seed)
    context = make_context(system, integrator, options.platform)
    context.setPositions(pdb.positions)
    context.setVelocitiesToTemperature(TEMPERATURE, options.seed)
    integrator.step(round(SETTLING / EVERY) * steps)
    if options.method == "hmc":
        integrator.resetStatistics()
    rows, begun = [], perf_counter()
    for _ in range(round(options.time / EVERY)):
        integrator.step(steps)
        dipole = charges @ context.getState(positions=True).getPositions(asNumpy=True)._value
        rows.append([*observe(context, bodies, False), *dipole])
        if len(rows) % 17 == 0:
            accepted = integrator.acceptanceRate if options.method == "hmc" else np.nan
            mass = sum(system.getParticleMass(i)._value for i in range(system.getNumParticles()))
            np.savez(
                options.out,
                rows=np.array(rows),
                method=options.method,
                per_force=options.step,
                mass=mass,
                accepted=accepted,
                seconds=perf_counter() - begun,
            )


def mean(series: list[np.ndarray]) -> tuple[float, float]:
    """Mean and standard error over all samples of independent runs, from the number of independent samples in each."""
    lengths = np.array([len(values) for values in series])
    variances = [values.var() * statistical_inefficiency(values) / len(values) for values in series]
    weights = lengths / lengths.sum()
    return float(weights @ [values.mean() for values in series]), float(np.sqrt(weights**2 @ variances))


def inefficiency(series: list[np.ndarray]) -> float:
    """Samples per independent sample, averaged over the runs by their lengths."""
    return float(np.average([statistical_inefficiency(x) for x in series], weights=[len(x) for x in series]))


def table(options: argparse.Namespace) -> None:
    """A row for each method and step; runs that differ in their seeds are pooled."""
    runs: dict[tuple[str, float], list[dict[str, np.ndarray]]] = {}
    for path in options.files:
        with np.load(path) as data:
            runs.setdefault((str(data["method"]), float(data["per_force"])), []).append(dict(data))
    print("| run | ps | accepted | V, kJ/mol | T_trans, K | T_rot, K | g/cm³ | forces per independent V | per dipole |")
    print("|---|---|---|---|---|---|---|---|---|")
    for (method, per_force), several in sorted(runs.items()):
        columns = [[run["rows"][:, i] for run in several] for i in range(several[0]["rows"].shape[1])]
        time, potential, _, translation, rotation, volume, *dipole = columns
        mass, forces = float(several[0]["mass"]), EVERY * 1000 / per_force
        density = [mass * DENSITY / values for values in volume]
        cells = " | ".join(
            f"{value:.{digits}f} ± {error:.{digits}f}"
            for digits, (value, error) in zip(
                (1, 2, 2, 4), map(mean, (potential, translation, rotation, density)), strict=True
            )
        )
        lengths = [values[-1] - values[0] for values in time]
        accepted = f"{np.average([run['accepted'] for run in several], weights=lengths):.3f}" if method == "hmc" else ""
        turning = np.mean([inefficiency(component) for component in dipole])
        print(
            f"| {method} {per_force:g} fs | {sum(lengths):.0f} | {accepted} | {cells} | "
            f"{inefficiency(potential) * forces:.0f} | {turning * forces:.0f} |"
        )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    one = commands.add_parser("run")
    one.add_argument("method", choices=("hmc", "sier4g", "sier2", "langevin"))
    one.add_argument("--step", type=float, default=2.0, help="fs for each force evaluation")
    one.add_argument("--time", type=float, default=400.0, help="ps")
    one.add_argument("--friction", type=float, default=2.0, help="1/ps")
    one.add_argument("--seed", type=int, default=1)
    one.add_argument("--platform")
    one.add_argument("--out", type=Path, default=Path("liquid.npz"))
    one.set_defaults(does=run)
    several = commands.add_parser("table")
    several.add_argument("files", nargs="+", type=Path)
    several.set_defaults(does=table)
    options = parser.parse_args()
    options.does(options)
    return 0


if __name__ == "__main__":
    sys.exit(main())
