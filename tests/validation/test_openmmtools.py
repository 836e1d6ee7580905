"""openmmtools with these integrators: its cache of Contexts, its Monte Carlo moves, and replica exchange."""

import copy
import itertools
from typing import ClassVar

import numpy as np
import openmm
import pytest
from openmm import unit

from openmm_sier import SIER2, SIER4G, SIER4P, RigidBodies, SIERIntegrator, SIERLangevinIntegrator
from openmm_sier.integrators.settings import as_json
from tests.support.seeded import seeded
from tests.support.waters import array, droplet, periodic_system, platform, settled

pytest.importorskip("openmmtools", reason="pip install openmm-sier[validation]")
from openmmtools import cache, mcmc, multistate, states

pytestmark = pytest.mark.thorough

FEMTOSECOND, KELVIN, KILOJOULE = unit.femtosecond, unit.kelvin, unit.kilojoule_per_mole
FRICTION = 20 / unit.picosecond


@pytest.fixture(scope="module")
def drop():
    """System of a small drop of water, and positions and velocities.

    openmmtools keeps an Andersen thermostat that it finds in a System, and otherwise adds one without a seed. Each
    molecule collides every 50 fs.
    """
    _, system, point = settled("droplet-8", *droplet(8))
    system.addForce(seeded(openmm.AndersenThermostat(300 * KELVIN, FRICTION), 5))
    return system, point


def sampler_state(drop):
    positions, velocities = drop[1]
    return states.SamplerState(
        positions=positions * unit.nanometer, velocities=velocities * unit.nanometer / unit.picosecond
    )


def state_at(drop, temperature=300.0):
    return states.ThermodynamicState(drop[0], temperature * KELVIN)


def langevin(temperature=300.0, friction=FRICTION, step=4 * FEMTOSECOND, **settings):
    return seeded(SIERLangevinIntegrator(temperature * KELVIN, friction, step, **settings), 11)


# --- the cache of Contexts --------------------------------------------------------------------------------------------


INTEGRATORS = {
    "SIER2": lambda: SIERIntegrator(6 * FEMTOSECOND, SIER2),
    "SIER4G": lambda: SIERIntegrator(6 * FEMTOSECOND, SIER4G),
    "SIER4P": lambda: SIERIntegrator(6 * FEMTOSECOND, SIER4P),
    "Langevin with SIER2": lambda: langevin(scheme=SIER2),
    "Langevin with SIER4G": lambda: langevin(scheme=SIER4G),
    "Langevin with two frictions": lambda: langevin(scheme=SIER2, rotationalFriction=1 / unit.picosecond),
    "Langevin with bodies": lambda: langevin(scheme=SIER2, bodies=RigidBodies.from_system(periodic_system()[2])),
    "Langevin with a pressure": lambda: langevin(scheme=SIER2, pressure=1 * unit.bar),
}


@pytest.fixture(scope="module")
def box():
    return settled("box-59", *periodic_system(removeCMMotion=False))[1:]


def test_the_cache_gives_what_it_is_asked_for(box):
    """In every order of two of them: each has a Context of its own, and is found again."""
    state = state_at(box)
    for before, asked in itertools.permutations(INTEGRATORS, 2):
        contexts = cache.ContextCache(platform=platform())
        results = [contexts.get_context(state, INTEGRATORS[name]()) for name in (before, asked)]
        assert results[0][0] is not results[1][0], (before, asked)
        for name, (context, integrator) in zip((before, asked), results, strict=True):
            settings, expected = (as_json(each.impl.settings) for each in (integrator, INTEGRATORS[name]()))
            assert settings == expected, (before, asked)
            assert contexts.get_context(state, INTEGRATORS[name]())[0] is context, (before, asked)


def test_the_cache_sets_the_temperature_and_the_friction_that_are_asked_for(drop):
    """It leaves them and the step out of its keys, as for OpenMM's integrators: one Context serves all values."""
    contexts = cache.ContextCache(platform=platform())
    first, _ = contexts.get_context(state_at(drop), langevin())
    asked = langevin(350, 1 / unit.picosecond, 2 * FEMTOSECOND)
    second, integrator = contexts.get_context(state_at(drop, 350), asked)
    assert second is first
    assert integrator.getTemperature() == 350 * KELVIN
    assert integrator.getFriction() == integrator.getRotationalFriction() == 1 / unit.picosecond
    assert integrator.getStepSize() == 2 * FEMTOSECOND


@pytest.mark.usefixtures("coin")
def test_the_cache_keeps_a_pressure(box):
    """Of the integrator's own Monte Carlo moves."""
    system, point = box
    contexts = cache.ContextCache(platform=platform("CPU"))
    constant_volume = states.ThermodynamicState(system, 300 * KELVIN)
    asked = langevin(step=2 * FEMTOSECOND, scheme=SIER2, pressure=1 * unit.bar, barostatInterval=5)
    context, integrator = contexts.get_context(constant_volume, asked)
    assert integrator.getPressure() == 1 * unit.bar
    assert integrator.getBarostatInterval() == 5
    context.setPositions(point[0])
    context.setVelocities(point[1])
    volume = context.getState().getPeriodicBoxVolume()
    integrator.step(100)
    assert context.getState().getPeriodicBoxVolume() != volume


# --- moves ------------------------------------------------------------------------------------------------------------


class LangevinMove(mcmc.BaseIntegratorMove):
    """Rigid-body Langevin dynamics as a move; it keeps the temperatures that it finds by that of the state, in K."""

    #: Of the class, since samplers copy their moves.
    temperatures: ClassVar[dict[int, list[float]]] = {}

    def _get_integrator(self, thermodynamic_state):
        return langevin(thermodynamic_state.temperature / KELVIN, scheme=SIER4G)

    def _after_integration(self, context, thermodynamic_state):
        integrator = context.getIntegrator()
        assert isinstance(integrator, SIERLangevinIntegrator)
        assert integrator.scheme == SIER4G.with_bath()
        assert integrator.getTemperature() == thermodynamic_state.temperature
        temperature = integrator.computeSystemTemperature() / KELVIN
        self.temperatures.setdefault(round(thermodynamic_state.temperature / KELVIN), []).append(temperature)


class ConstantEnergyMove(mcmc.IntegratorMove):
    """openmmtools leaves the Andersen thermostat to an integrator without a bath; it is switched off here."""

    def _before_integration(self, context, thermodynamic_state):
        context.setParameter(openmm.AndersenThermostat.CollisionFrequency(), 0)


@pytest.mark.parametrize(
    ("kind", "least", "most"), [(ConstantEnergyMove, 0, 0.1), (mcmc.IntegratorMove, 1, 150)], ids=["NVE", "Andersen"]
)
def test_moves_of_integrators_without_a_bath(drop, kind, least, most):
    """The move and its copy use one Context.

    In kJ/mol: the energy fluctuates by some 0.01 with SIER4G at 4 fs. The thermostat makes each molecule collide four
    times a move, so that energies at the end of moves are independent and their standard deviation is kT sqrt(48), that
    of 48 degrees of freedom and nearly harmonic forces: 17. Three of them lie within 1 of each other with a probability
    of 0.28 (1/17)^2 = 0.001, ten of them with one of 1e-11, and they do not come apart by 9 standard deviations.
    """
    contexts = cache.ContextCache(platform=platform())
    results, energies = sampler_state(drop), []
    first = kind(SIERIntegrator(4 * FEMTOSECOND, SIER4G), n_steps=50)
    start = array(results.positions)
    for move in (first, copy.deepcopy(first)) * 5:
        move.apply(state_at(drop), results, context_cache=contexts)
        energies.append((results.potential_energy + results.kinetic_energy) / KILOJOULE)
    assert len(contexts) == 1
    assert np.abs(array(results.positions) - start).max() > 0.01
    assert least < np.ptp(energies) < most


# --- replica exchange -------------------------------------------------------------------------------------------------

#: K, of the replicas; iterations, and steps in each of them.
LADDER, ITERATIONS, STEPS = (250, 300, 350), 130, 25


def test_replica_exchange(drop, tmp_path):
    """Replicas change places, and each state has its temperature.

    An iteration of 0.1 ps leaves exp(-2 * 20/ps * 0.1 ps) = 2 % of a kinetic energy. The mean of 125 of them with 48
    degrees of freedom has an error of T sqrt(2/48/125) = 1.8 %, 5 to 6 K, and another place in the ladder is 50 K away.
    """
    LangevinMove.temperatures.clear()
    sampler = multistate.ReplicaExchangeSampler(
        mcmc_moves=LangevinMove(n_steps=STEPS),
        number_of_iterations=ITERATIONS,
        online_analysis_interval=None,
        # Draws from NumPy's global generator, which has a seed in tests; "swap-all" has a generator of its own.
        replica_mixing_scheme="swap-neighbors",
    )
    sampler.sampler_context_cache = cache.ContextCache(platform=platform())
    sampler.energy_context_cache = cache.ContextCache(platform=platform())
    reporter = multistate.MultiStateReporter(str(tmp_path / "replicas.nc"), checkpoint_interval=ITERATIONS)
    sampler.create([state_at(drop, kelvin) for kelvin in LADDER], [sampler_state(drop)], storage=reporter)
    sampler.run()
    visited = np.array([reporter.read_replica_thermodynamic_states(i) for i in range(ITERATIONS + 1)])
    reporter.close()
    # Every replica has changed its place. Of nearly harmonic forces on 48 degrees of freedom half of the exchanges is
    # accepted, so that those at the ends of the ladder stay with a probability of (3/4)^130 = 6e-17.
    assert all(len(set(column)) > 1 for column in visited.T)
    assert sorted(LangevinMove.temperatures) == list(LADDER)
    for kelvin, values in LangevinMove.temperatures.items():
        assert len(values) == ITERATIONS
        # Six and a half standard errors, since machines round differently and each has its own trajectory; the first
        # iterations are left out, in which velocities of 297 K are forgotten.
        mean, error = np.mean(values[5:]), kelvin * np.sqrt(2 / 48 / (ITERATIONS - 5))
        assert abs(mean - kelvin) < 6.5 * error
