"""The rule for the step of rigid bodies: 5 fs for benzene, and longer as the root of the smallest effective mass."""

import itertools

import numpy as np
import openmm
import pytest
from scipy.spatial.transform import Rotation

from openmm_sier import RigidBodies, SIERIntegrator, SIERLangevinIntegrator
from openmm_sier.analysis.observables import energy_error
from openmm_sier.system.bonded_terms import mobilities
from tests.support.cages import cage
from tests.support.seeded import seeded
from tests.support.waters import context_at, energies, phase_point

#: Step, ps, at the effective mass of benzene, dalton, for fewer than 0.05 % of error.
STEP, MASS = 0.005, 12.0
ERROR = 5e-4


def ring(radius):
    angles = np.pi / 3 * np.arange(6)
    return radius * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)


def ring_with(mass, charge, radius, sigma, epsilon):
    """Six carbons and what is bonded to each."""
    carbons, others = (12.011, -charge, 0.355, 0.293), (mass, charge, sigma, epsilon)
    return np.concatenate([ring(0.139), ring(radius)]), 6 * [carbons] + 6 * [others]


#: Positions in nm; masses, charges, radii and depths; and the distance of neighbours in a lattice, nm.
BODIES = {
    "benzene": (*ring_with(1.008, 0.115, 0.248, 0.242, 0.1255), 0.62),
    "hexafluorobenzene": (*ring_with(18.998, 0.0, 0.273, 0.285, 0.255), 0.68),
    "cage of carbon": (cage(), 60 * [(12.011, 0.0, 0.34, 0.36)], 1.02),
}


def liquid(kind):
    """System, positions and bodies of eight molecules in a periodic box."""
    shape, atoms, apart = BODIES[kind]
    system, force, rng = openmm.System(), openmm.NonbondedForce(), np.random.default_rng(1)
    system.setDefaultPeriodicBoxVectors(*(2 * apart * np.eye(3)))
    force.setNonbondedMethod(force.CutoffPeriodic)
    force.setCutoffDistance(0.99 * apart)
    force.setUseSwitchingFunction(True)
    force.setSwitchingDistance(0.8 * apart)
    positions, bodies = [], []
    for corner in itertools.product((0.5, 1.5), repeat=3):
        first = system.getNumParticles()
        for mass, *parameters in atoms:
            system.addParticle(mass)
            force.addParticle(*parameters)
        bodies.append(list(range(first, system.getNumParticles())))
        for pair in itertools.combinations(bodies[-1], 2):
            force.addException(*pair, 0, 1, 0)
        positions.append(Rotation.random(rng=rng).apply(shape) + apart * np.array(corner))
    system.addForce(force)
    return system, np.concatenate(positions), bodies


@pytest.mark.thorough
@pytest.mark.parametrize(("kind", "expected"), [("hexafluorobenzene", 49), ("cage of carbon", 288)])
def test_steps_grow_as_the_root_of_the_smallest_effective_mass(kind, expected):
    system, positions, rigid = liquid(kind)
    bodies = RigidBodies.from_system(system, rigid=rigid, positions=positions)
    bath = seeded(SIERLangevinIntegrator(300, 10, 0.002, bodies=bodies), 1)
    context = context_at(system, bath, (positions, 0 * positions), "CPU")
    openmm.LocalEnergyMinimizer.minimize(context, 10, 100)
    context.setVelocitiesToTemperature(300, 1)
    bath.step(200)
    mass = 1 / mobilities(bath.bodies).max()
    # As the pages round it.
    assert mass == pytest.approx(expected, rel=0.02)
    step = STEP * np.sqrt(mass / MASS)
    integrator = SIERIntegrator(step, bodies=bodies)
    context = context_at(system, integrator, phase_point(context), "CPU")
    rows = []
    for _ in range(100):
        integrator.step(2)
        rows.append(energies(context))
    potential, kinetic = np.array(rows).T
    assert energy_error(potential + kinetic, potential) < ERROR
