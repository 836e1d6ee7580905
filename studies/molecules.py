#!/usr/bin/env python3
"""Energy error, cost, temperatures and dihedrals of molecules that are not rigid, beside OpenMM's own integrators.

    python -m studies.molecules start systems/peptide.pdb --out start.xml      equilibrate, and keep the phase point
    python -m studies.molecules energy systems/peptide.pdb --start start.xml --time 2 --step 1.5 2
    python -m studies.molecules cost systems/peptide.pdb --start start.xml     time of a step over its force calls
    python -m studies.molecules temperatures systems/peptide.pdb --start start.xml --step 2 --time 60 \\
        --methods sier4g langevin-sier4g langevinmiddle                           by kind of motion
    python systems/peptide.py --sequence VAL --dry --out valine.pdb
    python -m studies.molecules dihedrals valine.pdb --time 1000 --settle 20 --every 60 --temperature 400 \\
        --platform Reference

Steps are in fs for each force evaluation; `dihedrals` compares SIER4G at 2 fs with LangevinMiddle at 0.5 fs. Bonds to
hydrogen are constrained, PME is balanced (`--tolerance` is its ewaldErrorTolerance), and bonded forces act within the
drifts (`--kicks` leaves them in the kicks).
"""

import argparse
import sys
from pathlib import Path
from time import perf_counter, process_time

import mdtraj
import numpy as np
import openmm
from openmm_sier.measure.sampling import body_state

from openmm_sier import RigidBodies, SIERIntegrator, SIERLangevinIntegrator, prepare_system
from openmm_sier.dynamics import backend
from openmm_sier.dynamics.schemes import CATALOGUE
from openmm_sier.engines.temperature import MomentumConservation, temperatures
from openmm_sier.measure.force_clock import ForceClock
from openmm_sier.measure.forcefields import read_box
from openmm_sier.measure.observables import energy_drift, energy_error, energy_fluctuation
from openmm_sier.measure.starts import make_context
from openmm_sier.measure.statistics import block_means, mean_and_error
from openmm_sier.prepare.pme import meshed_forces

#: Bins of a dihedral's distribution, and blocks from which its errors are taken.
BINS, BLOCKS = 24, 40


def box_of(options):
    box = read_box(options.box, constraints="hbonds")
    for force in meshed_forces(box.system):
        force.setEwaldErrorTolerance(options.tolerance)
        force.setPMEParameters(0, 0, 0, 0)
    return box, prepare_system(box.system)


def start(options) -> None:
    """Equilibrate at constant temperature and keep the phase point."""
    box, prepared = box_of(options)
    integrator = SIERLangevinIntegrator(options.temperature, 5.0, 0.006, fastForceGroups=prepared.fastForceGroups)
    integrator.setRandomNumberSeed(options.seed)
    context = context_of(options, box, integrator)
    integrator.step(round(options.time / 0.006))
    print(integrator.computeTemperatures())
    options.out.write_text(openmm.XmlSerializer.serialize(context.getState(positions=True, velocities=True)))


def context_of(options, box, integrator):
    """A Context at the start, or minimized and with drawn velocities where there is none."""
    context = make_context(box.system, integrator, options.platform)
    if options.start is None:
        context.setPositions(box.positions)
        openmm.LocalEnergyMinimizer.minimize(context, 10, 100)
        context.setVelocitiesToTemperature(options.temperature, options.seed)
        return context
    state = openmm.XmlSerializer.deserialize(options.start.read_text())
    context.setPeriodicBoxVectors(*state.getPeriodicBoxVectors())
    context.setPositions(state.getPositions())
    context.setVelocities(state.getVelocities())
    return context


def integrator_of(name: str, per_force: float, options, groups):
    """An integrator by name, and its step in ps."""
    if name in ("verlet", "langevinmiddle"):
        integrator = openmm.VerletIntegrator(per_force)
        if name == "langevinmiddle":
            integrator = openmm.LangevinMiddleIntegrator(options.temperature, options.friction, per_force)
            integrator.setRandomNumberSeed(options.seed)
        integrator.setConstraintTolerance(1e-8)
        return integrator, per_force
    scheme = CATALOGUE[name.removeprefix("langevin-")]
    step = per_force * scheme.force_evaluations
    nested = {"substeps": options.substeps, "fastForceGroups": None if options.kicks else groups}
    if not name.startswith("langevin-"):
        return SIERIntegrator(step, scheme, **nested), step
    integrator = SIERLangevinIntegrator(options.temperature, options.friction, step, scheme, **nested)
    integrator.setRandomNumberSeed(options.seed)
    return integrator, step


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
            drift, uncertainty, _ = energy_drift(time, total)
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
    now = process_time if options.processor_time else perf_counter
    for name in options.methods:
        if name == "verlet":
            continue
        integrator, step = integrator_of(name, options.step[-1] / 1000, options, prepared.fastForceGroups)
        context = context_of(options, box, integrator)
        integrator.step(3)
        clock = ForceClock(context, now)
        ratios = []
        for _ in range(options.turns):
            before, begun = clock.seconds, now()
            integrator.step(4)
            ratios.append((now() - begun) / (clock.seconds - before))
        quartiles = np.percentile(ratios, [25, 50, 75])
        print(
            f"{name:8} {backend.active().name}: a step of {1000 * step:g} fs takes {quartiles[1]:.3f} of its forces "
            f"({quartiles[0]:.3f} to {quartiles[2]:.3f} for half of the turns)"
        )


def by_kind(options) -> None:
    """Mean temperatures of water's translation, water's rotation and the other molecules.

    Velocities of LangevinMiddle are those of its State: after the bath, in the middle between two kicks.
    """
    box, prepared = box_of(options)
    bodies = RigidBodies.from_system(box.system)
    for per_force in options.step:
        for name in options.methods:
            integrator, step = integrator_of(name, per_force / 1000, options, prepared.fastForceGroups)
            context = context_of(options, box, integrator)
            conserved = MomentumConservation.of_system(box.system, bodies).holds(integrator)
            every = max(1, round(options.every / 1000 / step))
            integrator.step(round(options.settle / step))
            rows, count = [], round(options.time / (every * step))
            for done in range(1, count + 1):
                integrator.step(every)
                state = context.getState(energy=True)
                H = state.getPotentialEnergy()._value + state.getKineticEnergy()._value
                found = temperatures(bodies, body_state(context, bodies), conserved)
                rows.append((state.getTime()._value, H, *found[1:]))
                if done % max(1, count // 5) == 0:
                    conserves = not hasattr(integrator, "getFriction")
                    print(f"{name} {per_force:g} fs per force, {_kinds(np.array(rows).T, conserves)}", flush=True)


def _kinds(rows: np.ndarray, conserves: bool) -> str:
    time, total, translation, rotation, flexible = rows
    kinds = {"water translation": translation, "water rotation": rotation, "others": flexible}
    kinds |= {"rotation - translation": rotation - translation, "others - translation": flexible - translation}
    averages = ((kind, *mean_and_error(values)[:2]) for kind, values in kinds.items())
    told = [f"{kind} {mean:.2f} +- {error:.2f} K" for kind, mean, error in averages if not np.isnan(mean)]
    if conserves:
        drift, uncertainty, _ = energy_drift(time, total)
        told.append(f"drift {drift:+.3f} +- {uncertainty:.3f} kJ/mol/ps")
        told.append(f"rms(H) {energy_fluctuation(time, total):.3f} kJ/mol")
    return f"{time[-1]:.1f} ps: {', '.join(told)}"


# --- dihedrals ---


def dihedrals(options) -> None:
    """Distributions of phi, psi and chi under SIER4G at 2 fs per force beside those under LangevinMiddle at 0.5 fs."""
    box, prepared = box_of(options)
    topology = mdtraj.Topology.from_openmm(box.topology)
    angles = []
    for name, per_force in (("langevin-sier4g", 0.002), ("langevinmiddle", 0.0005)):
        integrator, step = integrator_of(name, per_force, options, prepared.fastForceGroups)
        frames = _frames(options, box, integrator, step)
        trajectory = mdtraj.Trajectory(frames, topology)
        found = {f: getattr(mdtraj, f"compute_{f}")(trajectory)[1] for f in ("phi", "psi", "chi1")}
        angles.append({f"{f} {i + 1}": column for f, table in found.items() for i, column in enumerate(table.T)})
    for name in angles[0]:
        one, other = (found[name].astype(float) for found in angles)
        told = []
        for function in (np.cos, np.sin):
            (mean, error), (expected, known) = (mean_and_error(function(x))[:2] for x in (one, other))
            told.append(
                f"<{function.__name__}> {mean:+.4f} +- {error:.4f} and {expected:+.4f} +- {known:.4f} "
                f"({(mean - expected) / np.hypot(error, known):+.1f} errors)"
            )
        statistic, probability = _compared(*(_block_histograms(x) for x in (one, other)))
        told.append(f"chi^2 of {BINS} bins {statistic:.1f}, larger by chance with probability {probability:.2f}")
        print(f"{name}: {', '.join(told)}", flush=True)


def _frames(options, box, integrator, step: float) -> np.ndarray:
    """Positions (frames, N, 3) at equal intervals, after the time to settle."""
    context = context_of(options, box, integrator)
    every, frames = max(1, round(options.every / 1000 / step)), []
    integrator.step(round(options.settle / step))
    for _ in range(round(options.time / (every * step))):
        integrator.step(every)
        frames.append(context.getState(positions=True).getPositions(asNumpy=True)._value.astype(np.float32))
    return np.array(frames)


def _block_histograms(angles: np.ndarray) -> np.ndarray:
    """Fractions (blocks, bins) of a series."""
    bins = np.floor((angles + np.pi) / (2 * np.pi) * BINS).astype(int) % BINS
    return np.array([block_means(bins == b, BLOCKS) for b in range(BINS)]).T


def _compared(one: np.ndarray, other: np.ndarray, draws: int = 2000) -> tuple[float, float]:
    """chi^2 of the difference of two mean histograms, and how often blocks dealt at random have a larger one."""
    blocks = np.concatenate([one, other])
    rng = np.random.default_rng(1)

    def statistic(order: np.ndarray) -> float:
        halves = blocks[order[: len(one)]], blocks[order[len(one) :]]
        error = sum(half.var(axis=0, ddof=1) / len(half) for half in halves)
        gap = halves[0].mean(axis=0) - halves[1].mean(axis=0)
        return float(np.divide(gap**2, error, out=np.zeros(BINS), where=error > 0).sum())

    found = statistic(np.arange(len(blocks)))
    return found, float(np.mean([statistic(rng.permutation(len(blocks))) >= found for _ in range(draws)]))


COMMANDS = {"start": start, "energy": energy, "cost": cost, "temperatures": by_kind, "dihedrals": dihedrals}


def main(arguments=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=COMMANDS)
    parser.add_argument("box", type=Path)
    parser.add_argument("--start", type=Path, help="phase point to start from; without it a minimum, with velocities")
    parser.add_argument("--out", type=Path, default=Path("start.xml"))
    parser.add_argument("--methods", nargs="+", default=["verlet", "sier4g", "sier4p"])
    parser.add_argument("--step", nargs="+", type=float, default=[1.5, 2.0], help="fs for each force evaluation")
    parser.add_argument("--time", type=float, default=2.0, help="ps")
    parser.add_argument("--settle", type=float, default=0.0, help="ps before the first sample of temperatures, angles")
    parser.add_argument("--every", type=float, default=12.0, help="fs between two samples")
    parser.add_argument("--substeps", type=int, help="inner steps in the longest drift")
    parser.add_argument("--kicks", action="store_true", help="leave bonded forces in the kicks")
    parser.add_argument("--tolerance", type=float, default=1e-5, help="of PME")
    parser.add_argument("--processor-time", action="store_true", help="for `cost`, with OPENMM_CPU_THREADS=1")
    parser.add_argument("--turns", type=int, default=30)
    parser.add_argument("--temperature", type=float, default=297.0, help="K")
    parser.add_argument("--friction", type=float, default=2.0, help="1/ps, of the baths under which samples are taken")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--platform")
    options = parser.parse_args(arguments)
    COMMANDS[options.what](options)
    return 0


if __name__ == "__main__":
    sys.exit(main())
