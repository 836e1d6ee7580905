"""Verbs of engines that ensembles call, on both engines: the energy of changed velocities is heat."""

import numpy as np
import pytest

from openmm_sier import SIERIntegrator
from tests.support.waters import context_at, energies

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
