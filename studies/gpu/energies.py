"""Energy of runs without a bath."""

from __future__ import annotations

import numpy as np
import openmm

from openmm_sier.analysis.observables import energy_error, energy_walk
from openmm_sier.analysis.statistics import slope_and_error
from studies.gpu.calls import advance
from studies.gpu.settings import GpuSettings
from studies.methods import Contestant
from studies.units import md

#: Time between two samples, fs.
EVERY = 24.0


def conservation(context: openmm.Context, method: Contestant, settings: GpuSettings) -> dict[str, float | str]:
    """Return rms(H)/rms(V) and the walk of H in per cent, and the drift of the energy of the box in kJ/mol/ps."""
    integrator = context.getIntegrator()
    every = max(1, round(EVERY / method.step))
    samples = []
    for _ in range(round(1000 * settings.energy_time / method.step / every)):
        advance(integrator, every)
        state = context.getState(energy=True)
        samples.append((md(state.getPotentialEnergy()), md(state.getKineticEnergy())))
    potential, kinetic = np.array(samples).T
    time, total = 1e-3 * every * method.step * np.arange(1, len(samples) + 1), potential + kinetic
    drift, error, _ = slope_and_error(time, total)
    return {
        "method": method.name,
        "fs_per_force": method.step / method.forces,
        "percent": 100 * energy_error(total, potential),
        "walk": 100 * energy_walk(time, total, potential),
        "drift": drift,
        "drift_error": error,
    }
