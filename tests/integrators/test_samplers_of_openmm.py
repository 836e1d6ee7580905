"""OpenMM's own samplers over several temperatures, with the integrators of this package."""

import random

import numpy as np
import pytest
from openmm import app, unit

from openmm_sier import SIER2, SIERHMCIntegrator, SIERLangevinIntegrator
from tests.support.restarts import simulation_of
from tests.support.seeded import seeded
from tests.support.systems import assembled, field

N, SPRING = 10, 1000.0
TEMPERATURES = (300.0, 450.0)

MAKERS = {
    "langevin": lambda engine: SIERLangevinIntegrator(300, 20, 0.01, SIER2, engine=engine),
    "hybrid Monte Carlo": lambda engine: SIERHMCIntegrator(300, 0.03, SIER2, stepsPerTrial=4, engine=engine),
}


@pytest.fixture
def simulation(request):
    """Particles in harmonic wells, whose mean energy is 3 N kT/2."""
    kind, engine = request.param
    system = assembled(N * [10.0], field(f"{0.5 * SPRING}*(x^2+y^2+z^2)", range(N)))
    topology = app.Topology()
    residue = topology.addResidue("X", topology.addChain())
    for _ in range(N):
        topology.addAtom("X", None, residue)
    integrator = seeded(MAKERS[kind](engine), 5)
    result = simulation_of(topology, system, integrator, point=np.zeros((2, N, 3)))
    result.context.setVelocitiesToTemperature(300, 1)
    return result


def kinds(*values):
    """Integrators and engines of a test."""
    return pytest.mark.parametrize("simulation", values, indirect=True, ids=str)


def energy_of(state):
    x = state.getPositions(asNumpy=True)._value
    return 0.5 * SPRING * float((x * x).sum())


def means_are_right(found):
    """Energies by temperature: means of blocks, within four of their errors of 3 N kT/2."""
    for temperature, energies in found.items():
        blocks = np.array(energies[: len(energies) // 20 * 20]).reshape(20, -1).mean(axis=1)
        expected = 1.5 * N * unit.MOLAR_GAS_CONSTANT_R.value_in_unit_system(unit.md_unit_system) * temperature
        error = blocks.std(ddof=1) / np.sqrt(20)
        # Temperatures that were mixed up would be off by a quarter.
        assert error < 0.05 * expected
        assert abs(blocks.mean() - expected) < 4 * error


@pytest.mark.thorough
@kinds(("langevin", "native"), ("hybrid Monte Carlo", "exact"))
def test_expanded_ensemble(simulation):
    random.seed(4)
    states = [{"temperature": T * unit.kelvin} for T in TEMPERATURES]
    # Free energies of harmonic wells: weights that make both temperatures equally likely.
    weights = [0.0, -1.5 * N * float(np.log(TEMPERATURES[1] / TEMPERATURES[0]))]
    sampler = app.ExpandedEnsembleSampler(states, simulation, 5, weights=weights)
    results = {T: [] for T in TEMPERATURES}
    for _ in range(1200):
        sampler.step(5)
        T = TEMPERATURES[sampler.currentStateIndex]
        assert simulation.integrator.getTemperature()._value == T
        # The state was changed after the step, by a rule for which this energy is a sample of the new state too.
        results[T].append(energy_of(simulation.context.getState(positions=True)))
    assert min(map(len, results.values())) > 200
    means_are_right(results)
