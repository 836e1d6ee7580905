"""Averages of energies and temperatures over a run."""

from __future__ import annotations

from typing import Any

import numpy as np
import openmm
import pandas as pd

from openmm_sier import SIERHMCIntegrator
from openmm_sier.analysis.statistics import mean_and_error
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.constraints.graph import joined
from openmm_sier.inputs.equilibration import make_context
from openmm_sier.system import tables
from studies.gpu.calls import advance
from studies.gpu.settings import GpuSettings
from studies.methods import Contestant
from studies.units import md

#: Time between two samples, ps.
EVERY = 0.2

#: Forces whose energies are averaged, by the names of the columns.
BONDED = {
    "bonds": openmm.HarmonicBondForce,
    "angles": openmm.HarmonicAngleForce,
    "torsions": openmm.PeriodicTorsionForce,
}


class Observed:
    """Observe energies and temperatures of a Context of a box.

    Bonded energies are those of another Context, without the Forces that take time.
    """

    def __init__(self, system: openmm.System, has_solute: bool, platform: str | None):
        self._masses = tables.masses(system)
        self._waters = _waters(system)
        self._bonded = _bonded_context(system, platform) if has_solute else None

    def sample(self, context: openmm.Context) -> dict[str, float]:
        """Return the observables, energies in kJ/mol and temperatures in K."""
        context.applyVelocityConstraints(1e-6)
        state = context.getState(positions=True, velocities=True, energy=True)
        row = {"potential": md(state.getPotentialEnergy())}
        row |= self._temperatures(md(state.getVelocities(asNumpy=True)))
        if self._bonded is not None:
            self._bonded.setPositions(state.getPositions(asNumpy=True))
            for group, name in enumerate(BONDED):
                row[name] = md(self._bonded.getState(energy=True, groups=1 << group).getPotentialEnergy())
        return row

    def _temperatures(self, velocities: np.ndarray) -> dict[str, float]:
        """Return those of translation and rotation of water."""
        masses, velocities = self._masses[self._waters], velocities[self._waters]
        whole = masses.sum(axis=1)
        centres = np.einsum("na,nax->nx", masses, velocities) / whole[:, None]
        moving = 0.5 * float(whole @ (centres**2).sum(axis=1))
        kinetic = 0.5 * float(np.einsum("na,nax,nax->", masses, velocities, velocities))
        freedoms = 3 * len(self._waters) * GAS_CONSTANT
        return {"translation": 2 * moving / freedoms, "rotation": 2 * (kinetic - moving) / freedoms}


def _bonded_context(system: openmm.System, platform: str | None) -> openmm.Context:
    """Return a Context of the bonded Forces alone, each in the group of its place in `BONDED`."""
    bonded = openmm.XmlSerializer.clone(system)
    for index in reversed(range(bonded.getNumForces())):
        if not isinstance(bonded.getForce(index), tuple(BONDED.values())):
            bonded.removeForce(index)
    for force in bonded.getForces():
        force.setForceGroup(list(BONDED.values()).index(type(force)))
    return make_context(bonded, openmm.VerletIntegrator(0.001), platform)


def _waters(system: openmm.System) -> np.ndarray:
    """Return the atoms of molecules of three atoms that three constraints hold, (m, 3)."""
    pairs = tables.constraints(system).pairs
    molecules = joined(system.getNumParticles(), pairs)
    numbers, sizes = np.unique(molecules, return_counts=True)
    counts = np.bincount(molecules[pairs[:, 0]], minlength=numbers.max() + 1)
    chosen = numbers[(sizes == 3) & (counts[numbers] == 3)]
    atoms = np.flatnonzero(np.isin(molecules, chosen))
    return atoms[np.argsort(molecules[atoms], kind="stable")].reshape(-1, 3)


def averages(
    has_solute: bool, context: openmm.Context, method: Contestant, settings: GpuSettings
) -> dict[str, float | str]:
    """Return means and their errors over a run of a method, and of trials the share that was accepted."""
    observed = Observed(context.getSystem(), has_solute, settings.platform)
    integrator = context.getIntegrator()
    between = max(1, round(1000 * EVERY / method.duration))
    advance(integrator, round(1000 * settings.settle / method.duration))
    before = _trials(integrator)
    samples = []
    for _ in range(round(1000 * settings.time / method.duration / between)):
        advance(integrator, between)
        samples.append(observed.sample(context))
    row: dict[str, Any] = {"method": method.name}
    for name, series in pd.DataFrame(samples).items():
        row[str(name)], row[f"{name}_error"], _ = mean_and_error(series.to_numpy())
    trials, accepted = _trials(integrator) - before
    return row | ({"trials": int(trials), "accepted": accepted / trials} if trials else {})


def _trials(integrator: openmm.Integrator) -> np.ndarray:
    """Return how many trials were made, and how many accepted; zeros where there are none."""
    if not isinstance(integrator, SIERHMCIntegrator):
        return np.zeros(2)
    return np.array([integrator.trials, integrator.accepted])
