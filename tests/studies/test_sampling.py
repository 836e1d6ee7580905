"""Samples of runs, and what ends one."""

from __future__ import annotations

import numpy as np
import openmm
import pytest

from openmm_sier import RigidBodies, SIER2Integrator
from studies import sampling
from tests.support.waters import periodic_system, platform


def test_torn_molecules_end_one_run_and_not_the_comparison():
    """Verlet with SETTLE at a step that is much too long, on Reference, where positions become NaN without an error.

    Of free molecules: at such positions OpenMM's mesh of the Reference platform is written to outside of its memory.
    """
    topology, positions, system = periodic_system()
    system = openmm.XmlSerializer.clone(system)
    while system.getNumForces():
        system.removeForce(0)
    integrator = openmm.VerletIntegrator(0.03)
    context = openmm.Context(system, integrator, platform())
    context.setPositions(positions)
    context.setVelocitiesToTemperature(2000, 1)
    with pytest.raises(sampling.Unstable):
        sampling.sample(context, RigidBodies.from_system(system, topology), 200, 5)


def test_a_motion_that_is_not_finite_ends_one_run(monkeypatch):
    topology, positions, system = periodic_system()
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), platform())
    context.setPositions(positions)
    bodies = RigidBodies.from_system(system, topology)
    monkeypatch.setattr(bodies, "momenta", lambda velocities, A: RigidBodies.momenta(bodies, velocities * np.inf, A))
    with pytest.raises(sampling.Unstable, match="after 1 steps the vectors of body 0 are not finite"):
        sampling.sample(context, bodies, 2, 1)


def test_ions_have_no_rotational_temperature_and_are_sampled_all_the_same():
    system = openmm.System()
    force = openmm.CustomNonbondedForce("50*(r - 0.3)^2")
    for _ in range(2):
        system.addParticle(23.0)
        force.addParticle([])
    system.addForce(force)
    context = openmm.Context(system, SIER2Integrator(0.001), platform())
    context.setPositions([[0, 0, 0], [0.35, 0, 0]])
    series = sampling.sample(context, RigidBodies.from_system(system), 20, 5)
    assert series.time == pytest.approx([0.005, 0.01, 0.015, 0.02])
    assert np.isnan(series.rotation).all()
    # At rest at the start, and the centre of mass for ever: three degrees of freedom of two bodies.
    kinetic = series.translation * 3 * 8.31446261815324e-3 / 2
    np.testing.assert_allclose(kinetic, series.kinetic, rtol=1e-9)
    # Of (h w)^2/8 = 1e-6, w = sqrt(2 100/23)/ps.
    np.testing.assert_allclose(series.total, 50 * 0.05**2, rtol=1e-5)
