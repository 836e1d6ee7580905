"""Physical validity by the independent tests of the package physical_validation.

Merz and Shirts, PLoS ONE 13, e0202764 (2018). Results are distances from what statistical mechanics demands, in
standard errors.
"""

import numpy as np
import openmm
import pytest

from openmm_sier import SIER2, SIER4P, SIERLangevinIntegrator
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.stages import BATH, DRIFT, KICK, Stage
from tests.support.seeded import seeded
from tests.support.waters import context_at, droplet, phase_point, relaxed

physical_validation = pytest.importorskip("physical_validation", reason="pip install openmm-sier[validation]")
data = physical_validation.data

pytestmark = pytest.mark.thorough

TEMPERATURE, FRICTION = 297.0, 20.0
MOLECULES, FRAMES = 27, 300

#: ps; 2 * FRICTION * INTERVAL = 4, so that a frame remembers exp(-4) of the kinetic energy of the one before.
INTERVAL = 0.1

#: Standard errors, of 2.7 K for the temperature of the rotation: 297 K * sqrt(2/81/300). No scheme has a bias to be
#: seen, and the probability that one of their 16 independent numbers exceeds the limit is below 1e-9.
LIMIT = 6.7

#: `test_sampling_order` has the others.
STEPS = {SIER2: 0.006, SIER4P: 0.006}


@pytest.fixture(scope="module")
def drop():
    topology, positions, system = droplet(MOLECULES)
    return system, relaxed("droplet-27", topology, positions, system, TEMPERATURE)


def system_data(system):
    masses = [system.getParticleMass(i).value_in_unit(openmm.unit.dalton) for i in range(system.getNumParticles())]
    # The springs take up momentum and the bath angular momentum: neither is conserved.
    return data.SystemData(
        natoms=3 * MOLECULES,
        nconstraints=3 * MOLECULES,
        ndof_reduction_tra=0,
        ndof_reduction_rot=0,
        mass=masses,
        molecule_idx=np.arange(0, 3 * MOLECULES, 3),
        nconstraints_per_molecule=np.full(MOLECULES, 3),
    )


def sampled(drop, scheme, step):
    """Frames at constant temperature, as physical_validation takes them."""
    system, point = drop
    integrator = seeded(SIERLangevinIntegrator(TEMPERATURE, FRICTION, step, scheme=scheme), 11)
    context = context_at(system, integrator, point, "CPU")
    every = round(INTERVAL / step)
    integrator.step(10 * every)
    frames, kinetic = [], []
    for _ in range(FRAMES):
        integrator.step(every)
        frames.append(phase_point(context))
        kinetic.append(sum(integrator.bodies.kinetic_energies(integrator.getBodyState())))
    positions, velocities = map(np.array, zip(*frames, strict=True))
    return data.SimulationData(
        units=data.UnitData.units("GROMACS"),
        system=system_data(system),
        ensemble=data.EnsembleData("NVT", natoms=3 * MOLECULES, volume=1.0, temperature=TEMPERATURE),
        observables=data.ObservableData(kinetic_energy=kinetic),
        trajectory=data.TrajectoryData(positions, velocities),
    )


def distances(found):
    """Of mean and width: total kinetic energy by two ways, translation, rotation with internal motion, rotation."""
    options = {"data_is_uncorrelated": True, "bootstrap_seed": 5, "verbosity": 0}
    total = physical_validation.kinetic_energy.distribution(found, **options)
    parts = physical_validation.kinetic_energy.equipartition(found, **options)
    # Internal motion alone has no degrees of freedom in rigid molecules, and is left out.
    assert len(parts) == 4
    return np.array([total, *parts])


@pytest.mark.parametrize(("scheme", "step"), STEPS.items(), ids=[scheme.name for scheme in STEPS])
def test_kinetic_energies_are_those_of_the_canonical_ensemble(drop, scheme, step):
    result = sampled(drop, scheme, step)
    assert distances(result).max() < LIMIT
    # One true sample in 10^11 fails the Kolmogorov-Smirnov test.
    options = {"strict": True, "data_is_uncorrelated": True, "verbosity": 0}
    assert physical_validation.kinetic_energy.distribution(result, **options) > 1e-11
    parts = physical_validation.kinetic_energy.equipartition(result, **options)
    assert min(parts) > 1e-11


def test_too_long_a_step_of_second_order_is_found_out(drop):
    """With a kick after the bath the rotation is colder by 2.8 K * 4.5^2 = 57 K, 20 standard errors."""
    half = Stage(DRIFT, 0.5)
    ends_with_a_kick = Scheme("SIER2 around a bath", (Stage(KICK, 0.5), half, Stage(BATH, 1), half, Stage(KICK, 0.5)))
    result = distances(sampled(drop, ends_with_a_kick, 0.009))
    assert result[4, 0] > LIMIT
