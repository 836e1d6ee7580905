"""Runs of a model in a heat bath, and their averages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import openmm

from openmm_sier import SIERHMCIntegrator
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.inputs.equilibration import make_context
from openmm_sier.integrators.integrator import SIERIntegrator
from studies import frame
from studies.domains.methods import METHODS, TRIAL, Made
from studies.domains.models import INTERACTIONS, SPRINGS, Model
from studies.records import replace_file
from studies.units import md

#: What a sample has. Temperatures in K, energies in kJ/mol without springs, nm, nm^3.
OBSERVED = ("temperature", "translation", "rotation", "linkers", "potential", "bonds", "gyration")

#: Step in ps and friction in 1/ps of equilibrations.
SETTLING, SETTLING_FRICTION = 0.01, 1.0

ALL_GROUPS = 2**32 - 1


def settled(model: Model, time: float, step: float, seed: int, platform: str, kept: Path) -> openmm.State:
    """The phase point of the rigid model after an equilibration, which is kept in a file for other runs.

    Args:
        model: its start is minimized, and followed for a tenth of the time in steps of up to 10 fs, then in the given
            ones.
        time: ps.
        step: fs.
        seed: of the bath.
        platform: of OpenMM.
        kept: XML file.
    """
    if kept.exists():
        return openmm.XmlSerializer.deserialize(kept.read_text())
    first = min(SETTLING, 1e-3 * step)
    moving = METHODS["sier2"].make(model, first, SETTLING_FRICTION, seed)
    context = make_context(moving.system, moving.integrator, platform)
    context.setPositions(moving.positions)
    openmm.LocalEnergyMinimizer.minimize(context, 10.0, 500)
    context.setVelocitiesToTemperature(model.temperature, seed)
    moving.integrator.step(round(0.1 * time / first))
    moving.integrator.setStepSize(1e-3 * step)
    moving.integrator.step(round(0.9 * time / (1e-3 * step)))
    state = context.getState(positions=True, velocities=True)
    replace_file(kept, openmm.XmlSerializer.serialize(state))
    return state


def context_at(moving: Made, model: Model, start: openmm.State, seed: int, platform: str) -> openmm.Context:
    """A Context at a phase point of the rigid model, with new velocities."""
    context = make_context(moving.system, moving.integrator, platform)
    positions = md(start.getPositions(asNumpy=True))
    context.setPeriodicBoxVectors(*start.getPeriodicBoxVectors())
    context.setPositions(placed(moving, positions))
    context.setVelocitiesToTemperature(model.temperature, seed)
    return context


def placed(moving: Made, positions: np.ndarray) -> np.ndarray:
    """Positions of all particles, those of frames included, from those of atoms."""
    if moving.framed is None:
        return positions
    return np.asarray(md(moving.framed.addFramePositions(positions)))


def averages(
    model: Model,
    name: str,
    step: float,
    time: float,
    interval: float,
    friction: float,
    start: openmm.State,
    seed: int,
    platform: str,
) -> dict[str, Any]:
    """Means of `OBSERVED` with errors, of a run whose first tenth is left out; `broken` says why it has none.

    Args:
        model, name: what is run, and by which of `METHODS`.
        step: fs.
        time: ps.
        interval: ps between two samples, or a step if that is longer.
        friction: 1/ps.
        start: positions of the rigid model.
        seed: of the bath and of the velocities.
        platform: of OpenMM.
    """
    moving = METHODS[name].make(model, 1e-3 * step, friction, seed)
    context = context_at(moving, model, start, seed, platform)
    duration = step * (TRIAL if isinstance(moving.integrator, SIERHMCIntegrator) else 1)
    observe = partial(sample, model, moving)
    try:
        table = frame.sampled(context, observe, duration, time, 1e3 * interval).table
    except (openmm.OpenMMException, ArithmeticError, ValueError, RuntimeError) as error:
        return {"broken": f"{model.name}, {METHODS[name].name} at {step:g} fs: {' '.join(str(error).split())[:120]}"}
    equilibrated = table[len(table) // 10 :]
    row: dict[str, Any] = {"broken": "", "samples": len(equilibrated)} | frame.means(equilibrated)
    if isinstance(moving.integrator, SIERHMCIntegrator):
        row["accepted"] = moving.integrator.acceptanceRate
    return row


def sample(model: Model, moving: Made, context: openmm.Context) -> dict[str, float]:
    """Return the observables of a Context, by `OBSERVED`."""
    state = context.getState(energy=True, positions=True, groups=ALL_GROUPS - (1 << SPRINGS))
    interactions = context.getState(energy=True, groups=1 << INTERACTIONS).getPotentialEnergy()
    positions = md(state.getPositions(asNumpy=True))[: len(model.positions)]
    potential = md(state.getPotentialEnergy()) - model.offset
    observed = dict.fromkeys(OBSERVED, math.nan)
    observed |= temperatures(moving, state)
    observed["potential"] = potential
    if model.chains:
        observed["bonds"] = potential - md(interactions)
        masses = np.array([md(model.rigid.getParticleMass(i)) for i in range(len(model.positions))])
        observed["gyration"] = gyration(positions, masses, model.chains)
    return observed


def temperatures(moving: Made, state: openmm.State) -> dict[str, float]:
    """Temperatures in K: of all motion and, with this package's integrators, of bodies and linkers."""
    if isinstance(moving.integrator, SIERIntegrator):
        kelvins = moving.integrator.computeTemperatures().in_kelvin()
        return {
            "temperature": kelvins.total,
            "translation": kelvins.translation,
            "rotation": kelvins.rotation,
            "linkers": kelvins.flexible,
        }
    return {"temperature": 2 * md(state.getKineticEnergy()) / (freedoms(moving.system) * GAS_CONSTANT)}


def freedoms(system: openmm.System) -> int:
    """Degrees of freedom in a bath that acts on the centre of mass too."""
    moving = sum(md(system.getParticleMass(i)) > 0 for i in range(system.getNumParticles()))
    return 3 * moving - system.getNumConstraints()


def gyration(positions: np.ndarray, masses: np.ndarray, chains: Sequence[Sequence[int]]) -> float:
    """The root of the mean square radius of gyration of chains that are whole, nm."""
    squares = []
    for chain in chains:
        x, weights = positions[chain], masses[chain] / masses[chain].sum()
        squares.append(weights @ ((x - weights @ x) ** 2).sum(axis=1))
    return float(np.sqrt(np.mean(squares)))
