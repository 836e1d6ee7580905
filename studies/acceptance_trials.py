"""Trials of hybrid Monte Carlo of one method in one box, and their results on disk."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.operators import Rotation
from openmm_sier.dynamics.rotation import exact, rattle
from openmm_sier.dynamics.schemes import CATALOGUE, SIER2, Scheme
from openmm_sier.integrators.hmc import SIERHMCIntegrator
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.measure.report import SILENT, Report
from openmm_sier.measure.starts import make_context, prepare
from openmm_sier.system.find_bodies import RigidBodies
from studies.bench.replicas import Replica
from studies.files import replace_file

#: Size in nm and number of the random displacements of molecules that tell the noise of the energy. Single precision
#: resolves the coordinates of a large box about as well.
NOISE_STEP, NOISE_SAMPLES = 1e-6, 16

#: Default number of trials in a box, which is `MOLECULES` over the molecules of the box, within the two bounds.
MOLECULES, FEWEST, MOST = 163840, 10, 400


@dataclass(frozen=True)
class AcceptanceSettings:
    """Settings of the measurement. Times in ps; `dt`, the simulated time per force evaluation, in fs.

    Attributes:
        sizes: numbers of molecules, multiples of that of the box or smaller.
        trials: their number at each size, or one number for all; None makes fewer in larger boxes.
        time: of each trajectory, rounded to a whole number of steps.
        equilibrate: at each size, for repeated boxes; cropped ones are equilibrated until they have settled.
    """

    box: Path
    forcefield: list[str] | None = None
    sizes: tuple[int, ...] = (64, 512, 4096, 32768)
    schemes: tuple[str, ...] | None = None
    dt: tuple[float, ...] = (2.0,)
    trials: tuple[int, ...] | None = None
    time: float = 0.06
    temperature: float = 297.0
    equilibrate: float = 1.0
    seed: int = 1
    platform: str | None = None

    def trials_of(self, molecules: int) -> int:
        """Number of trials in a box of this size."""
        if self.trials is None:
            return min(MOST, max(FEWEST, MOLECULES // molecules))
        return self.trials[self.sizes.index(molecules) if len(self.trials) > 1 else 0]


@dataclass(frozen=True)
class Method:
    """Trajectories of a scheme with a free-rotation map."""

    name: str
    scheme: Scheme
    rotation: Rotation = exact


#: Methods by the names that users give.
METHODS = {"verlet": Method("Verlet, RATTLE", SIER2, rattle)} | {
    name: Method(scheme.name, scheme) for name, scheme in CATALOGUE.items()
}


@dataclass(frozen=True)
class Member:
    """Trials of one method at one step in one box.

    Attributes:
        molecules: of the box.
        method: name.
        fs_per_force: step over its number of force evaluations.
        step: fs.
        steps: of each trial.
        errors: of the energy at the end of each trial, kT; None where a trajectory could not be followed.
        reversal: distance by which an atom missed its start when the first trajectory was followed back, nm.
        noise: standard deviation of the energy from rounding, kT.
        broken: why there are no trials.
    """

    molecules: int
    method: str
    fs_per_force: float
    step: float
    steps: int
    errors: tuple[float | None, ...] = ()
    reversal: float | None = None
    noise: float | None = None
    broken: str = ""


@dataclass(frozen=True)
class Start:
    """An equilibrated box.

    Attributes:
        replica: the box.
        bodies: its rigid bodies.
        noise: see `Member`.
    """

    replica: Replica
    bodies: RigidBodies
    noise: float


def start(
    replica: Replica, kept: Path, settings: AcceptanceSettings, time: float | None, report: Report = SILENT
) -> Start:
    """Equilibrate a box, or read the end of an earlier equilibration from a file.

    Args:
        replica: the box.
        kept: an NPZ file, which is made if it does not exist.
        settings: of the measurement.
        time: of the equilibration, ps; None goes on until the liquid has settled. Molecules that are too close are
            moved apart first.
        report: gets notes and progress.
    """
    context = make_context(replica.system, SIERIntegrator(0.001, SIER2), settings.platform)
    if kept.exists():
        context.setPositions(np.load(kept)["positions"])
    else:
        positions = replica.positions * unit.nanometer
        prepare(context, positions, settings.temperature, settings.seed, time, report=report)
        found = context.getState(positions=True).getPositions(asNumpy=True)
        replace_file(kept, lambda path: np.savez(path, positions=found.value_in_unit(unit.nanometer)))
    bodies = context.getIntegrator().bodies
    noise = energy_noise(context, settings.seed) / (GAS_CONSTANT * settings.temperature)
    positions = context.getState(positions=True).getPositions(asNumpy=True).value_in_unit(unit.nanometer)
    return Start(replica._replace(positions=positions), bodies, noise)


def energy_noise(context: openmm.Context, seed: int = 1) -> float:
    """Standard deviation of a Context's potential energy from rounding, kJ/mol.

    Molecules are displaced at random, by so little that their forces predict the change of the energy. The scatter
    about this prediction is from rounding alone, of positions and of sums.

    Args:
        context: of a SIERIntegrator, with positions. It is left as it was.
        seed: of the displacements.
    """
    state = context.getState(positions=True, energy=True, forces=True)
    positions = state.getPositions(asNumpy=True).value_in_unit(unit.nanometer)
    bodies = context.getIntegrator().bodies
    forces = state.getForces(asNumpy=True).value_in_unit(unit.kilojoule_per_mole / unit.nanometer)
    F, _ = bodies.forces_and_torques(forces, context.getIntegrator().getBodyState().A)
    owners, rng, found = bodies.owners, np.random.default_rng(seed), []
    try:
        for _ in range(NOISE_SAMPLES):
            moved = rng.normal(scale=NOISE_STEP, size=F.shape)
            context.setPositions(np.where(owners[:, None] >= 0, positions + moved.T[owners], positions))
            context.computeVirtualSites()
            energy = context.getState(energy=True).getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
            found.append(energy + float((F * moved).sum()))
    finally:
        context.setPositions(positions)
    return float(np.std(found, ddof=1))


def measure(
    begun: Start,
    method: Method,
    fs_per_force: float,
    trials: int,
    settings: AcceptanceSettings,
    report: Report = SILENT,
) -> Member:
    """Make trials, each from the last sample, with momenta drawn anew.

    Args:
        begun: the box.
        method: what makes trajectories.
        fs_per_force: step over its number of force evaluations.
        trials: how many.
        settings: of the measurement.
        report: gets progress.
    """
    step = fs_per_force * method.scheme.force_evaluations
    steps = max(1, round(1e3 * settings.time / step))
    member: dict[str, Any] = {
        "molecules": begun.replica.molecules,
        "method": method.name,
        "fs_per_force": fs_per_force,
        "step": step,
        "steps": steps,
    }
    integrator = SIERHMCIntegrator(
        settings.temperature, 1e-3 * step, method.scheme, steps, bodies=begun.bodies, rotation=method.rotation
    )
    integrator.setRandomNumberSeed(settings.seed)
    context = make_context(begun.replica.system, integrator, settings.platform)
    context.setPositions(begun.replica.positions)
    errors: list[float | None] = []
    what = f"{method.name}, {fs_per_force:g} fs per force, {begun.replica.molecules} molecules"
    try:
        with report.progress(what, trials) as show:
            for done in range(1, trials + 1):
                integrator.step(steps)
                error = integrator.lastEnergyError
                errors.append(error if math.isfinite(error) else None)
                show(done)
    except openmm.OpenMMException as error:
        return Member(**member, broken=" ".join(str(error).split()))
    return Member(**member, errors=tuple(errors), reversal=integrator.reversalError, noise=begun.noise)


# --- on disk ---


def keep(member: Member, path: Path) -> None:
    """Write a member to a JSON file, all of it or nothing."""
    replace_file(path, lambda temporary: temporary.write_text(json.dumps(vars(member), indent=1)))


def read(path: Path) -> Member:
    """A member that `keep` wrote."""
    found: dict[str, Any] = json.loads(path.read_text())
    return Member(**found | {"errors": tuple(found["errors"])})


def read_all(directory: Path) -> list[Member]:
    """All members that were kept in a directory."""
    return [read(path) for path in sorted(directory.glob("[0-9]*.json"))]
