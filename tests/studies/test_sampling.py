"""Samples of runs and what ends one; what steps of second order do to temperatures, predicted and simulated."""

import numpy as np
import openmm
import pytest
from scipy.linalg import logm

from openmm_sier import SIER2, RigidBodies, SIERLangevinIntegrator
from openmm_sier.dynamics.schemes import DRIFT
from studies import sampling
from studies.methods import SCHEMES
from tests.support.flexible_systems import started
from tests.support.seeded import seeded
from tests.support.waters import periodic_system
from tests.support.waters_in_fields import SPRINGS, tethered_water

TEMPERATURE = 300.0


def test_steepness_of_springs():
    """The frequency of the translation is that of all springs and one mass.

    Squares of 1500 forces within ten correlation times or more are known to 1.2 %; eight times that are allowed.
    """
    system, positions = tethered_water(500)
    bodies = RigidBodies.from_system(system)
    integrator = seeded(SIERLangevinIntegrator(TEMPERATURE, 20.0, 1e-3, scheme=SIER2))
    context = started(system, integrator, positions, TEMPERATURE, seed=1, steps=1000)
    steepness = sampling.steepness(context, bodies, 100, 10)
    assert steepness[0] == pytest.approx(TEMPERATURE * sum(SPRINGS) / bodies.masses[0], rel=0.1)


@pytest.mark.parametrize("phase", [0.05, 0.1])
def test_bias_at_constant_energy(phase):
    """The modified Hamiltonian of a harmonic oscillator, from the logarithm of the map: 1/m grows by (hw)^2/6.

    The next term is (hw)^4/30.
    """
    step = np.eye(2)
    for stage in SIER2.stages:
        h = stage.fraction * phase
        step = (np.array([[1, h], [0, 1]]) if stage.operator == DRIFT else np.array([[1, 0], [-h, 1]])) @ step
    generator = logm(step) / phase
    bias = SCHEMES["sier2"].bias
    assert generator[0, 1] - 1 == pytest.approx(bias * phase**2, abs=phase**4 / 20)


# --- samples ---


def test_torn_molecules_end_one_run_and_not_the_comparison():
    """Verlet with SETTLE at a step that is much too long, on Reference, where positions become NaN without an error.

    Of free molecules: at such positions OpenMM's mesh of the Reference platform is written to outside of its memory.
    """
    topology, positions, system = periodic_system()
    while system.getNumForces():
        system.removeForce(0)
    context = started(system, openmm.VerletIntegrator(0.03), positions, 2000, seed=1)
    with pytest.raises(sampling.Unstable):
        sampling.sample(context, RigidBodies.from_system(system, topology), 200, 5)
