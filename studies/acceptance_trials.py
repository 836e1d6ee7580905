"""Trials of hybrid Monte Carlo of one method in one box, and the noise of energies."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.schemes import SIER2
from openmm_sier.integrators.hmc import SIERHMCIntegrator
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.measure.starts import make_context, prepare
from openmm_sier.system.find_bodies import RigidBodies
from studies.boxes import Replica
from studies.command import BoxSettings
from studies.methods import OwnMethod
from studies.report import SILENT, Report

#: Size in nm and number of the random displacements of molecules that tell the noise of the energy. Single precision
#: resolves the coordinates of a large box about as well.
NOISE_STEP, NOISE_SAMPLES = 1e-6, 16

#: Default number of trials in a box, which is `MOLECULES` over the molecules of the box, within the two bounds.
MOLECULES, FEWEST, MOST = 163840, 10, 400


@dataclass(frozen=True)
class AcceptanceSettings(BoxSettings):
    """Settings of the measurement.

    Attributes:
        sizes: numbers of molecules, multiples of that of the box or smaller.
        schemes: by name; all unless given.
        dt: simulated time per force evaluation, fs.
        trials: their number at each size, or one number for all; fewer in larger boxes unless given.
        time: of each trajectory, ps, rounded to a whole number of steps.
        equilibrate: at each size, ps, for repeated boxes; cropped ones are equilibrated until they have settled.
    """

    sizes: tuple[int, ...] = (64, 512, 4096, 32768)
    schemes: tuple[str, ...] = ()
    dt: tuple[float, ...] = (2.0,)
    trials: tuple[int, ...] = ()
    time: float = 0.06
    equilibrate: float = 1.0

    def trials_of(self, molecules: int) -> int:
        """Number of trials in a box of this size."""
        if not self.trials:
            return min(MOST, max(FEWEST, MOLECULES // molecules))
        return self.trials[self.sizes.index(molecules) if len(self.trials) > 1 else 0]


@dataclass(frozen=True)
class Start:
    """An equilibrated box, its rigid bodies, and the noise of its energy in kT."""

    replica: Replica
    bodies: RigidBodies
    noise: float


def start(
    replica: Replica, kept: Path, settings: AcceptanceSettings, time: float | None, report: Report = SILENT
) -> Start:
    """Equilibrate a box, or read the end of an earlier equilibration from a file.

    Args:
        replica: the box.
        kept: an NPY file of positions, which is made if it does not exist.
        settings: of the measurement.
        time: of the equilibration, ps; None goes on until the liquid has settled. Molecules that are too close are
            moved apart first.
        report: gets notes and progress.
    """
    context = make_context(replica.system, SIERIntegrator(0.001, SIER2), settings.platform)
    if kept.exists():
        context.setPositions(np.load(kept))
    else:
        prepare(context, replica.positions * unit.nanometer, settings.temperature, settings.seed, time, report=report)
        temporary = kept.with_name("new-" + kept.name)
        np.save(temporary, _positions(context))
        temporary.replace(kept)
    noise = energy_noise(context, settings.seed) / (GAS_CONSTANT * settings.temperature)
    return Start(replica._replace(positions=_positions(context)), context.getIntegrator().bodies, noise)


def _positions(context: openmm.Context) -> np.ndarray:
    return context.getState(positions=True).getPositions(asNumpy=True).value_in_unit(unit.nanometer)


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
    method: OwnMethod,
    fs_per_force: float,
    trials: int,
    settings: AcceptanceSettings,
    report: Report = SILENT,
) -> dict[str, Any]:
    """Make trials, each from the last sample, with momenta drawn anew.

    Args:
        begun: the box.
        method: what makes trajectories.
        fs_per_force: step over its number of force evaluations.
        trials: how many.
        settings: of the measurement.
        report: gets progress.

    Returns:
        What can be written as JSON: `molecules`, `method`, `fs_per_force`, `step` in fs, `length` of a trial in fs; the
        `errors` of the energy at the end of each trial in kT, None where a trajectory could not be followed;
        `reversal`, the distance in nm by which an atom missed its start when the first trajectory was followed back;
        the `noise` of the energy in kT; and `broken`, why there are no trials.
    """
    step = fs_per_force * method.forces
    steps = max(1, round(1e3 * settings.time / step))
    made: dict[str, Any] = {
        "molecules": begun.replica.molecules,
        "method": method.name,
        "fs_per_force": fs_per_force,
        "step": step,
        "length": step * steps,
        "errors": [],
        "reversal": None,
        "noise": begun.noise,
        "broken": "",
    }
    integrator = SIERHMCIntegrator(
        settings.temperature, 1e-3 * step, method.scheme, steps, bodies=begun.bodies, rotation=method.rotation
    )
    integrator.setRandomNumberSeed(settings.seed)
    context = make_context(begun.replica.system, integrator, settings.platform)
    context.setPositions(begun.replica.positions)
    what = f"{method.name}, {fs_per_force:g} fs per force, {begun.replica.molecules} molecules"
    try:
        with report.progress(what, trials) as show:
            for done in range(1, trials + 1):
                integrator.step(1)
                error = integrator.lastEnergyError
                made["errors"].append(error if math.isfinite(error) else None)
                show(done)
    except openmm.OpenMMException as error:
        return made | {"errors": [], "broken": " ".join(str(error).split())}
    return made | {"reversal": integrator.reversalError}
