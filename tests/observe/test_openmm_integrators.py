"""OpenMM's own integrators observed at whole steps."""

import numpy as np
import openmm
import pytest
from openmm import unit

from openmm_sier import RigidBodies
from openmm_sier.observe import conservation, openmm_integrators
from tests.support.waters import context_at, periodic_system, phase_point, settled

NVE, NVT = (), (297.0,)


@pytest.fixture(scope="module")
def box():
    return settled("box-59", *periodic_system(removeCMMotion=False))[1:]


def simulated(box, name, around=NVE):
    system, integrator = openmm_integrators.make_integrator(box[0], box[1][0], name, 0.002, *around)
    context = context_at(system, integrator, box[1])
    integrator.bind(context, RigidBodies.from_system(box[0]))
    return context


def openmm_kinetic(context):
    return context.getState(energy=True).getKineticEnergy().value_in_unit(unit.kilojoule_per_mole)


@pytest.mark.parametrize(("name", "around"), [("verlet", NVE), ("langevinmiddle", NVT)])
def test_kinetic_energies_are_openmms_own(box, name, around):
    """Which for Verlet are those of velocities half a step on; rounding of SETTLE is left.

    LangevinMiddle's velocities point along chords of the arcs that atoms describe in half a step h/2. OpenMM counts
    them whole, and bodies know the part along the tangent, (w h/4)^2 less: 1e-3 for atoms that turn with w = 60/ps.
    """
    context = simulated(box, name, around)
    context.getIntegrator().step(5)
    results = dict(zip(conservation.COLUMNS, conservation.row(context), strict=True))
    share = results["Kinetic Energy (kJ/mole)"] / openmm_kinetic(context)
    assert -1e-5 < 1 - share < (1e-5 if name == "verlet" else 3e-3)
    assert np.isnan(results["Conserved Energy (kJ/mole)"]) == bool(around)
    assert context.getIntegrator().forceEvaluations == 5


def test_a_shift_of_velocities_starts_verlet_at_the_phase_point(box):
    context = simulated(box, "verlet")
    context.applyVelocityConstraints(1e-8)
    velocities = context.getState(velocities=True).getVelocities(asNumpy=True)
    masses = np.array([box[0].getParticleMass(i)._value for i in range(box[0].getNumParticles())])
    expected = 0.5 * masses @ (velocities._value**2).sum(axis=1)
    assert openmm_kinetic(context) != pytest.approx(expected, rel=1e-4)
    openmm_integrators.shift_velocities(context, -0.001)
    assert openmm_kinetic(context) == pytest.approx(expected, rel=1e-6)
    openmm_integrators.shift_velocities(context, 0.001)
    back = context.getState(velocities=True).getVelocities(asNumpy=True)
    assert np.abs((back - velocities)._value).max() < 1e-5


def test_noise_is_that_of_the_seed_and_the_step(box):
    system, integrator = openmm_integrators.make_integrator(box[0], box[1][0], "verlet", 0.002, 297.0, 1.0, 1.0)
    seen = set()
    noisy = [force for force in system.getForces() if hasattr(force, "setRandomNumberSeed")]
    assert {type(force) for force in noisy} == {openmm.AndersenThermostat, openmm.MonteCarloBarostat}
    for seed, step in ((1, 0), (1, 100), (2, 0), (2, 100)):
        openmm_integrators.seed_noise(system, integrator, seed, step)
        seen |= {force.getRandomNumberSeed() for force in noisy}
    assert len(seen) == 8
    assert 0 not in seen


def test_noise_after_a_checkpoint_is_that_of_a_restart(box):
    """Without a new seed the noise of the first steps would come again after each checkpoint."""

    def begun(point, step):
        system, integrator = openmm_integrators.make_integrator(box[0], box[1][0], "langevinmiddle", 0.002, *NVT)
        openmm_integrators.seed_noise(system, integrator, 7, step)
        return context_at(system, integrator, point)

    whole = begun(box[1], 0)
    whole.getIntegrator().step(3)
    saved = phase_point(whole)
    openmm_integrators.continue_as_restart(whole, 7)
    whole.getIntegrator().step(2)
    ends = [phase_point(whole)]
    # With the noise of the step of the checkpoint, and with that of the start.
    for step in (3, 0):
        again = begun(saved, step)
        again.getIntegrator().step(2)
        ends.append(phase_point(again))
    assert np.array_equal(ends[0], ends[1])
    assert not np.array_equal(ends[0], ends[2])
