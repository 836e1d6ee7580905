"""Energy error, cost, temperatures and dihedrals of molecules that are not rigid, beside OpenMM's own integrators.

    python -m studies.molecules systems/peptide.pdb start       equilibrate, and keep the phase point
    python -m studies.molecules systems/peptide.pdb energy --start out/start.xml --time 2 --step 1.5 2
    python -m studies.molecules systems/peptide.pdb cost --start out/start.xml     time of a step over its force calls
    python -m studies.molecules systems/peptide.pdb temperatures --start out/start.xml --step 2 --time 60 \\
        --methods sier4g langevin-sier4g langevinmiddle                           by kind of motion
    python systems/peptide.py --sequence VAL --dry --out valine.pdb
    python -m studies.molecules valine.pdb dihedrals --time 1000 --settle 20 --every 60 --temperature 400 \\
        --platform Reference

Steps are in fs for each force evaluation; `dihedrals` compares SIER4G at 2 fs with LangevinMiddle at 0.5 fs. Bonds to
hydrogen are constrained, PME is balanced (`--tolerance` is its ewaldErrorTolerance), and bonded forces act within the
drifts (`--kicks` leaves them in the kicks).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from time import perf_counter, process_time
from typing import Any, ClassVar, Literal

import mdtraj
import numpy as np
import openmm
from tyro.conf import Positional

from openmm_sier import RigidBodies, SIERIntegrator, SIERLangevinIntegrator, prepare_system
from openmm_sier.dynamics import backend
from openmm_sier.dynamics.schemes import CATALOGUE
from openmm_sier.engines.temperature import MomentumConservation, temperatures
from openmm_sier.measure.force_clock import ForceClock
from openmm_sier.measure.forcefields import Box
from openmm_sier.measure.observables import energy_error
from openmm_sier.measure.starts import make_context
from openmm_sier.measure.statistics import block_means, mean_and_error, rms, slope_and_error
from studies import boxes
from studies.command import BoxSettings, command
from studies.report import SILENT, Report
from studies.sampling import body_state
from studies.units import md

#: Bins of a dihedral's distribution, and blocks from which its errors are taken.
BINS, BLOCKS = 24, 40


@dataclass(frozen=True)
class MoleculeSettings(BoxSettings):
    """What is measured.

    Attributes:
        what: of the measurements above.
        start: phase point to start from; without it a minimum, with velocities.
        methods: by name.
        step: fs for each force evaluation.
        time: ps.
        settle: ps before the first sample of temperatures and angles.
        every: fs between two samples.
        substeps: inner steps in the longest drift; the usual ones unless given.
        kicks: leave bonded forces in the kicks.
        tolerance: of PME.
        processor_time: for `cost`, with OPENMM_CPU_THREADS=1.
        turns: for `cost`.
        friction: of the baths under which samples are taken, 1/ps.
    """

    what: Positional[Literal["start", "energy", "cost", "temperatures", "dihedrals"]] = "energy"
    start: Path | None = None
    methods: tuple[str, ...] = ("verlet", "sier4g", "sier4p")
    step: tuple[float, ...] = (1.5, 2.0)
    time: float = 2.0
    settle: float = 0.0
    every: float = 12.0
    substeps: int | None = None
    kicks: bool = False
    tolerance: float = 1e-5
    processor_time: bool = False
    turns: int = 30
    friction: float = 2.0

    ANY_SIGN: ClassVar[tuple[str, ...]] = ("settle",)


class Prepared:
    """The box of a study, prepared for long steps, with bonds to hydrogen constrained."""

    def __init__(self, settings: MoleculeSettings):
        self.settings = settings
        self.box: Box = boxes.read(settings, "hbonds", settings.tolerance)
        self.groups = prepare_system(self.box.system).fastForceGroups

    def context(self, integrator: openmm.Integrator) -> openmm.Context:
        """A Context at the start, or minimized and with drawn velocities where there is none."""
        settings = self.settings
        context = make_context(self.box.system, integrator, settings.platform)
        if settings.start is None:
            context.setPositions(self.box.positions)
            openmm.LocalEnergyMinimizer.minimize(context, 10, 100)
            context.setVelocitiesToTemperature(settings.temperature, settings.seed)
            return context
        state = openmm.XmlSerializer.deserialize(settings.start.read_text())
        context.setPeriodicBoxVectors(*state.getPeriodicBoxVectors())
        context.setPositions(state.getPositions())
        context.setVelocities(state.getVelocities())
        return context

    def integrator(self, name: str, per_force: float) -> tuple[openmm.Integrator, float]:
        """An integrator by name, and its step in ps."""
        settings = self.settings
        if name in ("verlet", "langevinmiddle"):
            integrator = openmm.VerletIntegrator(per_force)
            if name == "langevinmiddle":
                integrator = openmm.LangevinMiddleIntegrator(settings.temperature, settings.friction, per_force)
                integrator.setRandomNumberSeed(settings.seed)
            integrator.setConstraintTolerance(1e-8)
            return integrator, per_force
        scheme = CATALOGUE[name.removeprefix("langevin-")]
        step = per_force * scheme.force_evaluations
        nested: dict[str, Any] = {"substeps": settings.substeps}
        nested["fastForceGroups"] = None if settings.kicks else self.groups
        if not name.startswith("langevin-"):
            return SIERIntegrator(step, scheme, **nested), step
        integrator = SIERLangevinIntegrator(settings.temperature, settings.friction, step, scheme, **nested)
        integrator.setRandomNumberSeed(settings.seed)
        return integrator, step


def start(settings: MoleculeSettings, report: Report) -> None:
    """Equilibrate at constant temperature and keep the phase point."""
    prepared = Prepared(settings)
    integrator = SIERLangevinIntegrator(settings.temperature, 5.0, 0.006, fastForceGroups=prepared.groups)
    integrator.setRandomNumberSeed(settings.seed)
    context = prepared.context(integrator)
    integrator.step(round(settings.time / 0.006))
    report.note(str(integrator.computeTemperatures()))
    state = context.getState(positions=True, velocities=True)
    (settings.out / "start.xml").write_text(openmm.XmlSerializer.serialize(state))


def energy(settings: MoleculeSettings, report: Report) -> None:
    """rms(H)/rms(V), and the drift, of runs from one phase point."""
    prepared = Prepared(settings)
    reference: dict[float, float] = {}
    for per_force in settings.step:
        for name in settings.methods:
            integrator, step = prepared.integrator(name, per_force / 1000)
            context = prepared.context(integrator)
            every = max(1, round(settings.every / 1000 / step))
            rows = []
            for _ in range(round(settings.time / (every * step))):
                integrator.step(every)
                state = context.getState(energy=True)
                V, K = (md(e) for e in (state.getPotentialEnergy(), state.getKineticEnergy()))
                rows.append((md(state.getTime()), V + K, V))
            time, total, potential = np.array(rows).T
            error = 100 * energy_error(total, potential)
            reference.setdefault(per_force, error)
            drift, uncertainty, _ = slope_and_error(time, total)
            report.note(
                f"{name:8} {per_force:4g} fs per force: rms(H)/rms(V) {error:.4f} %, Verlet's over it "
                f"{reference[per_force] / error:.1f}, rms(H) {rms(total):.4f} kJ/mol, "
                f"drift {drift:+.3f} +- {uncertainty:.3f} kJ/mol/ps",
            )
            del context, integrator


def cost(settings: MoleculeSettings, report: Report) -> None:
    """Time of steps over that of the force calls in them: medians over short turns."""
    prepared = Prepared(settings)
    now = process_time if settings.processor_time else perf_counter
    for name in settings.methods:
        if name == "verlet":
            continue
        integrator, step = prepared.integrator(name, settings.step[-1] / 1000)
        context = prepared.context(integrator)
        integrator.step(3)
        clock = ForceClock(context, now)
        ratios = []
        for _ in range(settings.turns):
            before, begun = clock.seconds, now()
            integrator.step(4)
            ratios.append((now() - begun) / (clock.seconds - before))
        quartiles = np.percentile(ratios, [25, 50, 75])
        report.note(
            f"{name:8} {backend.active().name}: a step of {1000 * step:g} fs takes {quartiles[1]:.3f} of its forces "
            f"({quartiles[0]:.3f} to {quartiles[2]:.3f} for half of the turns)"
        )


def by_kind(settings: MoleculeSettings, report: Report) -> None:
    """Mean temperatures of water's translation, water's rotation and the other molecules.

    Velocities of LangevinMiddle are those of its State: after the bath, in the middle between two kicks.
    """
    prepared = Prepared(settings)
    bodies = RigidBodies.from_system(prepared.box.system)
    for per_force in settings.step:
        for name in settings.methods:
            integrator, step = prepared.integrator(name, per_force / 1000)
            context = prepared.context(integrator)
            conserved = MomentumConservation.of_system(prepared.box.system, bodies).holds(integrator)
            every = max(1, round(settings.every / 1000 / step))
            integrator.step(round(settings.settle / step))
            rows, count = [], round(settings.time / (every * step))
            for done in range(1, count + 1):
                integrator.step(every)
                state = context.getState(energy=True)
                H = md(state.getPotentialEnergy()) + md(state.getKineticEnergy())
                found = temperatures(bodies, body_state(context, bodies), conserved)
                rows.append((md(state.getTime()), H, *found[1:]))
                if done % max(1, count // 5) == 0:
                    conserves = not hasattr(integrator, "getFriction")
                    report.note(f"{name} {per_force:g} fs per force, {_kinds(np.array(rows).T, conserves)}")


def _kinds(rows: np.ndarray, conserves: bool) -> str:
    time, total, translation, rotation, flexible = rows
    kinds = {"water translation": translation, "water rotation": rotation, "others": flexible}
    kinds |= {"rotation - translation": rotation - translation, "others - translation": flexible - translation}
    averages = ((kind, *mean_and_error(values)[:2]) for kind, values in kinds.items())
    told = [f"{kind} {mean:.2f} +- {error:.2f} K" for kind, mean, error in averages if not np.isnan(mean)]
    if conserves:
        drift, uncertainty, _ = slope_and_error(time, total)
        told.append(f"drift {drift:+.3f} +- {uncertainty:.3f} kJ/mol/ps")
        told.append(f"rms(H) {rms(total):.3f} kJ/mol")
    return f"{time[-1]:.1f} ps: {', '.join(told)}"


# --- dihedrals ---


def dihedrals(settings: MoleculeSettings, report: Report) -> None:
    """Distributions of phi, psi and chi under SIER4G at 2 fs per force beside those under LangevinMiddle at 0.5 fs."""
    prepared = Prepared(settings)
    topology = mdtraj.Topology.from_openmm(prepared.box.topology)
    angles = []
    for name, per_force in (("langevin-sier4g", 0.002), ("langevinmiddle", 0.0005)):
        integrator, step = prepared.integrator(name, per_force)
        frames = _frames(prepared, integrator, step)
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
        statistic, probability = _compared(_block_histograms(one), _block_histograms(other))
        told.append(f"chi^2 of {BINS} bins {statistic:.1f}, larger by chance with probability {probability:.2f}")
        report.note(f"{name}: {', '.join(told)}")


def _frames(prepared: Prepared, integrator: openmm.Integrator, step: float) -> np.ndarray:
    """Positions (frames, N, 3) at equal intervals, after the time to settle."""
    settings, context = prepared.settings, prepared.context(integrator)
    every, frames = max(1, round(settings.every / 1000 / step)), []
    integrator.step(round(settings.settle / step))
    for _ in range(round(settings.time / (every * step))):
        integrator.step(every)
        frames.append(md(context.getState(positions=True).getPositions(asNumpy=True)).astype(np.float32))
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


def study(settings: MoleculeSettings, report: Report = SILENT) -> None:
    """Carry out one of the measurements."""
    COMMANDS[settings.what](settings, report)


main = command(MoleculeSettings, study, __doc__, __name__)
