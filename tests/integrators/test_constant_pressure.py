"""Constant pressure: the distribution of the volume, what is moved, restarts, and what is refused."""

from functools import partial

import numpy as np
import openmm
import pytest
from openmm import unit

from openmm_sier import SIER2, SIERLangevinIntegrator, SIERThermostatIntegrator
from openmm_sier.dynamics.constants import BAR
from openmm_sier.ensembles import VelocityRescaling
from tests.support.restarts import assert_same, everything
from tests.support.seeded import seeded
from tests.support.systems import assembled, with_forces
from tests.support.waters import cluster_system, context_at, platform

TEMPERATURE, PRESSURE = 300.0, 100 * BAR


def integrator(pressure=1e3, interval=4, seed=3, **options):
    moves = {"pressure": pressure, "barostatInterval": interval}
    return seeded(SIERLangevinIntegrator(297.0, 2.0, 0.001, scheme=SIER2, **moves, **options), seed)


def rescaled(engine):
    """Whose thermostat, too, acts every few steps."""
    bath = VelocityRescaling(297.0, 5.0, 4, pressure=1000 * unit.bar, interval=3)
    return seeded(SIERThermostatIntegrator(bath, 0.001, SIER2, engine=engine), 7)


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


@pytest.mark.slow
def test_volume_is_that_of_openmms_barostat():
    """A dense fluid at 150 K and 800 bar, less than half as dense without its energy.

    Blocks of 2000 steps have standard errors of some 1.4 % for either, and 8 % are four times that of the difference.
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
        found = []
        for _ in range(100):
            made.step(20)
            found.append(context.getState().getPeriodicBoxVolume()._value)
        means.append(np.mean(found))
    assert means[0] == pytest.approx(means[1], rel=0.08)


# --- in a Context -----------------------------------------------------------------------------------------------------


MAKERS = {
    "langevin": partial(integrator, interval=2),
    **{f"rescaled, {engine}": partial(rescaled, engine) for engine in ("exact", "native")},
}


@pytest.mark.slow
@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_chunks_of_steps_do_not_matter(box, make):
    _, system, point = box
    ends = []
    for chunks in ([24], [1] * 24, [5, 7, 12]):
        made = make()
        context = context_at(system, made, point)
        volume = context.getState().getPeriodicBoxVolume()
        for steps in chunks:
            made.step(steps)
        assert context.getState().getPeriodicBoxVolume() != volume
        ends.append(everything(context))
    assert_same(ends[0], ends[1])
    assert_same(ends[0], ends[2])


def test_without_friction_the_volume_still_moves(box):
    _, system, point = box
    made = seeded(SIERLangevinIntegrator(297.0, 0.0, 0.001, pressure=1e3, barostatInterval=1), 1)
    context = context_at(system, made, point)
    found = set()
    for _ in range(6):
        made.step(1)
        found.add(context.getState().getPeriodicBoxVolume()._value)
    assert len(found) > 2


def test_a_pressure_is_set_where_there_is_one():
    made = integrator(pressure=200 * unit.atmosphere, interval=7)
    made.setPressure(3)
    assert made.getPressure().value_in_unit(unit.bar) == pytest.approx(3)
    assert made.getBarostatInterval() == 7
    plain = SIERLangevinIntegrator(297.0, 2.0, 0.001)
    assert plain.getBarostatInterval() is None
    with pytest.raises(ValueError, match="create it with a pressure"):
        plain.setPressure(1)


# --- what is refused --------------------------------------------------------------------------------------------------


def test_a_barostat_of_the_system_is_refused(box):
    system = with_forces(box[1], openmm.MonteCarloBarostat(1.0, 297.0))
    with pytest.raises(openmm.OpenMMException, match=r"Two barostats: .* MonteCarloBarostat in the System"):
        openmm.Context(system, integrator(), platform())


@pytest.mark.slow
def test_a_box_too_small_for_the_cutoff(box):
    _, system, point = box
    made = integrator(pressure=1e6, interval=1)
    context = context_at(system, made, point)
    with pytest.raises(openmm.OpenMMException, match=r"could not try a volume of 1\.\d+ nm\^3: .* twice"):
        made.step(500)
    steps = context.getState().getStepCount()
    assert steps > 0
    # All is as the last completed step left it.
    volume = context.getState().getPeriodicBoxVolume()._value
    assert volume > (2 * 0.55) ** 3
    again = integrator(pressure=1e6, interval=1)
    other = context_at(system, again, point, steps=steps)
    assert_same(everything(other), everything(context))


def test_a_cluster_has_no_pressure():
    _, _, system = cluster_system()
    with pytest.raises(openmm.OpenMMException, match="periodic"):
        openmm.Context(system, integrator(), platform())
