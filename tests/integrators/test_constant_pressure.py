"""Constant pressure: moves and their size, restarts and refusals."""

import numpy as np
import openmm
import pytest
from openmm import unit

from openmm_sier import SIER2, RigidBodies, SIERLangevinIntegrator, SIERThermostatIntegrator, select_bodies
from openmm_sier.dynamics.barostat import (
    ACCEPTED,
    JUDGED,
    LARGEST_SIZE,
    MoleculeCentres,
    MonteCarloVolumeMove,
    MoveSize,
)
from openmm_sier.dynamics.constants import BAR
from openmm_sier.ensembles import VelocityRescaling
from openmm_sier.ensembles.ensemble import SIZE
from tests.support.domains import descriptions, domain_system, folded, topology_of
from tests.support.restarts import after_ten_steps, assert_same, everything, simulation_of
from tests.support.seeded import seeded
from tests.support.systems import assembled, with_forces
from tests.support.waters import cluster_system, context_at, platform

TEMPERATURE, PRESSURE = 300.0, 100 * BAR


def integrator(pressure=1e3, interval=4, seed=3, **options):
    moves = {"pressure": pressure, "barostatInterval": interval}
    return seeded(SIERLangevinIntegrator(297.0, 2.0, 0.001, scheme=SIER2, **moves, **options), seed)


def nitrogen(n=60, edge=1.65):
    """Rigid dumbbells with Lennard-Jones sites, on a lattice: System and positions."""
    force = openmm.NonbondedForce()
    force.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(0.7)
    force.setUseDispersionCorrection(False)
    pairs = [(2 * i, 2 * i + 1) for i in range(n)]
    for pair in pairs:
        for _ in pair:
            force.addParticle(0, 0.331, 0.308)
        force.addException(*pair, 0, 0.3, 0)
    system = assembled(2 * n * [14.0067], force, constraints=((*pair, 0.11) for pair in pairs))
    system.setDefaultPeriodicBoxVectors(*(edge * np.eye(3)))
    lattice = np.argwhere(np.ones((4, 4, 4)))[:n] * (edge / 4)
    return system, (lattice[:, None] + np.array([[0, 0, 0], [0.11, 0, 0]])).reshape(-1, 3)


def test_molecules_that_a_body_joins_move_as_one():
    """OpenMM finds molecules by bonds, of which a rigid domain needs none. Linkers follow their domains."""
    topology, positions, system = topology_of(2), folded(2), domain_system(2, box=12.0, elastic=False)
    domains = select_bodies(topology, descriptions("AB"))
    bodies = RigidBodies.from_system(system, topology, domains, positions)
    context = openmm.Context(system, integrator(bodies=bodies), platform("Reference"))
    assert len(context.getMolecules()) > 20
    centres = MoleculeCentres(bodies, context.getMolecules())
    assert centres.count == 2
    q, _ = bodies.fit(positions)
    chains = positions.reshape(2, -1, 3).mean(axis=1)
    chain = bodies.molecules != bodies.molecules[bodies.owners[0]]
    # All beads have one mass; positions are those of the exact shapes to rounding.
    np.testing.assert_allclose(centres(q).T, chains[chain.astype(int)], rtol=0, atol=1e-12)


@pytest.mark.thorough
def test_volume_is_that_of_openmms_barostat():
    """A dense fluid at 150 K and 800 bar, less than half as dense without its energy.

    Blocks of 2000 steps have standard errors of some 1.4 % for either, and 13 % are more than six times that of the
    difference.
    """
    system, positions = nitrogen()
    ours = SIERLangevinIntegrator(150, 20, 0.004, scheme=SIER2, pressure=800, barostatInterval=2)
    theirs = openmm.LangevinMiddleIntegrator(150, 20, 0.004)
    with_theirs = with_forces(system, seeded(openmm.MonteCarloBarostat(800, 150, 2), 1))
    means = []
    for made, its_system in ((ours, system), (theirs, with_theirs)):
        context = context_at(its_system, seeded(made, 1), (positions, 0 * positions))
        context.setVelocitiesToTemperature(150, 1)
        made.step(1000)
        results = []
        for _ in range(100):
            made.step(20)
            results.append(context.getState().getPeriodicBoxVolume()._value)
        means.append(np.mean(results))
    assert means[0] == pytest.approx(means[1], rel=0.13)


# --- the size of moves ------------------------------------------------------------------------------------------------


def sizes(accepted, moves, molecules=100):
    """The size after each of so many moves that are accepted with a probability."""
    results = [MoveSize.first(molecules)]
    for _ in range(moves):
        results.append(results[-1].after(accepted))
    return [size.largest for size in results]


def test_a_size_at_which_enough_moves_are_accepted_stays():
    for accepted in ACCEPTED:
        assert len(set(sizes(accepted, 3000))) == 1


@pytest.mark.parametrize(("accepted", "factor"), [(0.0, 0.1), (0.2, 0.4), (0.8, 2.5), (1.0, 10.0)])
def test_the_size_changes_ever_more_rarely_and_not_for_ever(accepted, factor):
    result = sizes(accepted, 6000, molecules=10**6)
    changed = [moves for moves in range(1, 6001) if result[moves] != result[moves - 1]]
    assert result[10] == pytest.approx(factor * result[0])
    assert set(changed) <= set(JUDGED)
    # No size is larger than the largest.
    assert changed == list(JUDGED) or result[-1] == LARGEST_SIZE


@pytest.mark.parametrize("energy", [np.nan, np.inf])
def test_a_move_to_an_energy_that_is_no_number_is_rejected(energy):
    move = MonteCarloVolumeMove.drawn(1, 1, 10, 0.1)
    assert not move.is_accepted(move.probability(energy, 1.0, 1.0, 1.0))


def network(n=4, spacing=0.4):
    """Beads on a lattice, each bound to its six neighbours and those of the next box: System and positions.

    They are one molecule, which does not move with the box: a move strains the bonds that leave the box.
    """
    lattice = np.argwhere(np.ones((n, n, n)))
    bonds = openmm.HarmonicBondForce()
    bonds.setUsesPeriodicBoundaryConditions(True)
    for i, place in enumerate(lattice):
        for axis in np.eye(3, dtype=int):
            bonds.addBond(i, int(np.ravel_multi_index((place + axis) % n, (n, n, n))), spacing, 20000.0)
    system = assembled(n**3 * [40.0], bonds)
    system.setDefaultPeriodicBoxVectors(*(n * spacing * np.eye(3)))
    return system, spacing * lattice


def moved_every_step(engine):
    bath = VelocityRescaling(297.0, 5.0, 4, pressure=1000 * unit.bar, interval=1)
    return seeded(SIERThermostatIntegrator(bath, 0.002, SIER2, engine=engine), 7)


both_engines = pytest.mark.parametrize("engine", ["exact", "native"])


@both_engines
def test_the_box_of_a_network_answers(engine):
    """Of moves of the first size one in a hundred is accepted. In the end between a quarter and three should be.

    Of 400 moves these are 100 to 300, with standard errors of 9. Those of the first size would be 4 with one of 2.
    """
    system, positions = network()
    integrator = moved_every_step(engine)
    context = context_at(system, integrator, (positions, 0 * positions))
    context.setVelocitiesToTemperature(297.0, 1)
    integrator.step(JUDGED[3])
    moved = 0
    for _ in range(400):
        before = context.getState().getPeriodicBoxVolume()
        integrator.step(1)
        moved += context.getState().getPeriodicBoxVolume() != before
    assert 20 <= moved <= 380


@both_engines
@pytest.mark.parametrize("way", ["Checkpoint", "State"])
def test_a_restart_continues_with_the_size_of_moves(tmp_path, monkeypatch, engine, way):
    """Also where the size is judged only later, by moves from before the restart and after it.

    All of them are improbable, so that it becomes smaller.
    """
    monkeypatch.setattr(MonteCarloVolumeMove, "probability", lambda *_: 0.01)
    system, positions = network()
    whole = simulation_of(None, system, moved_every_step(engine), point=(positions, 0 * positions))
    whole.context.setVelocitiesToTemperature(297.0, 1)
    whole.step(12)
    load = after_ten_steps(whole, way, tmp_path / "saved")
    continued = simulation_of(None, system, moved_every_step(engine), point=(positions, 0 * positions))
    getattr(continued, load)(str(tmp_path / "saved"))
    at_restart = whole.integrator.impl.tally.counts[SIZE]
    assert at_restart < LARGEST_SIZE
    for steps in (1, 19):
        whole.step(steps)
        continued.step(steps)
        assert_same(everything(continued.context), everything(whole.context))
    assert whole.integrator.impl.tally.counts[SIZE] != at_restart


@both_engines
def test_a_move_scales_centres_of_molecules_and_leaves_their_shapes(monkeypatch, engine):
    """Of springs at rest in a bath at 0 K, so that nothing else moves the atoms."""
    monkeypatch.setattr(MonteCarloVolumeMove, "is_accepted", lambda *_: True)
    spring, masses = openmm.HarmonicBondForce(), [12.0, 16.0]
    spring.setUsesPeriodicBoundaryConditions(True)
    centres = np.array([[0.3, 0.4, 0.5], [1.2, 1.1, 0.2], [0.6, 1.5, 1.7]])
    # On either side of the centre of mass, by the mass of the other atom.
    arms = 0.01 / 28 * np.array([[16.0, 0.0, 0.0], [-12.0, 0.0, 0.0]])
    for i in range(len(centres)):
        spring.addBond(2 * i, 2 * i + 1, 0.01, 1000.0)
    system = assembled(len(centres) * masses, spring)
    system.setDefaultPeriodicBoxVectors(*(2 * np.eye(3)))
    positions = (centres[:, None] + arms).reshape(-1, 3)
    bath = seeded(SIERLangevinIntegrator(0.0, 2.0, 0.001, SIER2, pressure=1.0, barostatInterval=1, engine=engine))
    context = context_at(system, bath, (positions, 0 * positions), steps=1)
    state = context.getState(positions=True)
    factor = state.getPeriodicBoxVectors()[0][0]._value / 2
    assert abs(factor - 1) > 1e-3
    # Rounding of positions of 2 nm, and of the forces that follow from it.
    expected = (factor * centres[:, None] + arms).reshape(-1, 3)
    np.testing.assert_allclose(state.getPositions(asNumpy=True)._value, expected, rtol=0, atol=1e-13)


# --- in a Context -----------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("coin")
def test_without_friction_the_volume_still_moves(box):
    _, system, point = box
    result = seeded(SIERLangevinIntegrator(297.0, 0.0, 0.001, pressure=1e3, barostatInterval=1), 1)
    context = context_at(system, result, point)
    results = set()
    for _ in range(6):
        result.step(1)
        results.add(context.getState().getPeriodicBoxVolume()._value)
    assert len(results) > 2


def test_a_pressure_is_set_where_there_is_one():
    result = integrator(pressure=200 * unit.atmosphere, interval=7)
    result.setPressure(3)
    assert result.getPressure().value_in_unit(unit.bar) == pytest.approx(3)
    assert result.getBarostatInterval() == 7
    plain = SIERLangevinIntegrator(297.0, 2.0, 0.001)
    assert plain.getBarostatInterval() is None
    with pytest.raises(ValueError, match="with a pressure"):
        plain.setPressure(1)


# --- what is refused --------------------------------------------------------------------------------------------------


def test_a_barostat_of_the_system_is_refused(box):
    system = with_forces(box[1], openmm.MonteCarloBarostat(1.0, 297.0))
    with pytest.raises(openmm.OpenMMException, match="remove one of the two barostats"):
        openmm.Context(system, integrator(), platform())


def test_a_box_too_small_for_the_cutoff(box):
    _, system, point = box
    result = integrator(pressure=1e6, interval=1)
    context = context_at(system, result, point)
    with pytest.raises(openmm.OpenMMException, match=r"1\.\d+ nm\^3"):
        result.step(500)
    steps = context.getState().getStepCount()
    assert steps > 0
    # All is as the last completed step left it.
    volume = context.getState().getPeriodicBoxVolume()._value
    assert volume > (2 * 0.55) ** 3
    again = integrator(pressure=1e6, interval=1)
    other = context_at(system, again, point, steps=steps)
    assert_same(everything(other), everything(context))


def test_an_error_that_is_not_about_the_box(box, monkeypatch):
    _, system, point = box
    result = integrator(interval=1)
    context = context_at(system, result, point)

    def scale(factor):
        raise openmm.OpenMMException("Something else.")

    monkeypatch.setattr(result.impl.engine, "scale", scale)
    with pytest.raises(openmm.OpenMMException, match="Something else"):
        result.step(1)
    assert context.getStepCount() == 0


def test_a_cluster_has_no_pressure():
    _, _, system = cluster_system()
    with pytest.raises(openmm.OpenMMException, match="periodic"):
        openmm.Context(system, integrator(), platform())
