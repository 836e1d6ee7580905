"""Temperatures of OpenMM's integrators are those of motion that constraints allow."""

import numpy as np
import openmm
import pandas as pd
import pytest

from openmm_sier import RigidBodies
from openmm_sier.observe import openmm_integrators
from openmm_sier.system.temperature import temperatures
from studies import heat_bath
from studies.observers import OfSolution
from tests.support.flexible_systems import started
from tests.support.seeded import seeded
from tests.support.waters import periodic_system

TEMPERATURE = 300.0


def test_velocities_along_constraints_count_in_no_temperature():
    """LangevinMiddle's velocities at the end of a step have such components, here of some 10 K.

    The oracle is the momentum and the angular momentum of each molecule. The velocities are in single precision.
    """
    topology, positions, system = periodic_system()
    observe = OfSolution(system)
    while system.getNumForces():
        system.removeForce(0)
    integrator = seeded(openmm.LangevinMiddleIntegrator(TEMPERATURE, 5.0, 9e-3))
    context = started(system, integrator, positions, TEMPERATURE, seed=1, steps=20)
    bodies = RigidBodies.from_system(system, topology)
    expected = temperatures(bodies, openmm_integrators.body_state(context, bodies), conserved=False)
    raw = context.getState(energy=True).getKineticEnergy()
    found = observe(context)
    assert found["translation"] == pytest.approx(expected.translation, rel=1e-4)
    assert found["rotation"] == pytest.approx(expected.rotation, rel=1e-4)
    assert found["water"] == pytest.approx(expected.total, rel=1e-4)
    assert raw > 1.005 * context.getState(energy=True).getKineticEnergy()


def test_records_of_raw_velocities_are_not_compared():
    rows = pd.DataFrame({"method": ["LangevinMiddle, 9 fs", "SIER2, 9 fs"], "rotation": 2 * [300.0], "potential": 1.0})
    old, new = heat_bath.comparable(rows), heat_bath.comparable(rows.assign(projected=True))
    assert np.isnan(old["rotation"][0])
    assert old["rotation"][1] == 300
    assert (old["potential"] == 1).all()
    assert (new["rotation"] == 300).all()


def test_temperatures_are_of_projected_runs_alone():
    """Further starts of a method add to all averages of the runs before them, but not to their temperatures."""
    shared = {"box": "water", "at": "constant volume", "method": "LangevinMiddle, 4 fs", "hydrogens": "", "time": 1.0}
    values = {"broken": "", "rotation_error": 1.0, "potential_error": 1.0}
    raw = shared | values | {"rotation": 306.0, "potential": 1.0, "fs_per_second": 1.0}
    new = shared | values | {"rotation": 297.0, "potential": 3.0, "projected": True}
    (row,) = heat_bath.averaged(pd.DataFrame([raw, new])).to_dict("records")
    assert row["rotation"] == 297
    assert row["potential"] == 2
    assert row["speed"] == 1
    assert heat_bath.comparable(pd.DataFrame([row]))["rotation"][0] == 297
