"""The verbs of engines that ensembles call, on both engines: energies against heat, and ways back."""

import numpy as np
import pytest

from openmm_sier import SIERIntegrator
from openmm_sier.engines.records import Changes
from tests.support.waters import context_at, energies, phase_point

pytestmark = pytest.mark.parametrize("name", ["exact", "native"])

#: Energies are sums of a hundred terms of some kJ/mol.
ROUNDING = 1e-9


@pytest.fixture
def engine(cluster, name):
    """An engine after three steps, and its Context."""
    _, system, point = cluster
    integrator = SIERIntegrator(0.001, "SIER2", engine=name)
    context = context_at(system, integrator, point, steps=3)
    return integrator.impl.engine, context


def test_energy_of_changed_velocities_is_heat(engine):
    engine, context = engine
    changes = (
        lambda: engine.shift_velocities(np.array([0.3, -0.2, 0.1])),
        lambda: engine.scale_velocities(1.2, np.zeros(3)),
        lambda: engine.scale_velocities(0.7, engine.centre_velocity()),
        lambda: engine.draw_momenta(2.5, 0.6),
    )
    for change in changes:
        before, heat = energies(context)[1], engine.tally.heat
        assert engine.kinetic_energy() == pytest.approx(before, abs=ROUNDING)
        change()
        engine.publish()
        # OpenMM adds the energies of atoms, whose velocities its solvers constrain to 1e-9.
        assert energies(context)[1] - before == pytest.approx(engine.tally.heat - heat, abs=1e-6)
        assert abs(engine.tally.heat - heat) > 0.1
    assert engine.tally.draws == 1


def test_velocities_about_the_centre_leave_it(engine):
    engine, _ = engine
    engine.shift_velocities(np.array([0.3, -0.2, 0.1]))
    centre = engine.centre_velocity()
    engine.scale_velocities(0.5, centre)
    assert engine.centre_velocity() == pytest.approx(centre, abs=1e-12)


def test_a_saved_state_comes_back_to_the_bit(engine):
    engine, context = engine
    saved, before, heat = engine.save(), phase_point(context), engine.tally.heat
    engine.shift_velocities(np.ones(3))
    engine.propagate(4)
    engine.publish()
    assert np.abs(phase_point(context)[0] - before[0]).max() > 1e-4
    engine.restore(saved)
    engine.publish()
    assert all(np.array_equal(*pair) for pair in zip(phase_point(context), before, strict=True))
    assert engine.tally.heat == heat
    assert context.getStepCount() == engine.clock.steps == 3


def test_a_reversed_trajectory_comes_back(engine):
    engine, context = engine
    before = phase_point(context)
    for _ in range(2):
        engine.propagate(5)
        engine.restore(engine.save(), reverse=True)
    engine.publish()
    # The native engine's constraints are good to 1e-9 of 0.1 nm at each of ten steps.
    assert np.abs(phase_point(context)[0] - before[0]).max() < 1e-8
    assert np.abs(phase_point(context)[1] - before[1]).max() < 1e-6


def test_a_transaction_that_fails_leaves_no_trace(engine):
    engine, context = engine
    before, draws = phase_point(context), engine.tally.draws

    def failing():
        with engine.transaction():
            engine.draw_momenta(2.5, 0.0)
            engine.propagate(2)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        failing()
    engine.publish()
    assert all(np.array_equal(*pair) for pair in zip(phase_point(context), before, strict=True))
    assert engine.tally.draws == draws
    # The next step depends only on the contents of the Context.
    assert Changes.HISTORY in engine.changes
