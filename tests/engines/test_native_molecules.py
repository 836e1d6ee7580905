"""Fast forces of flexible molecules with the native engine, beside the exact one."""

import numpy as np
import openmm
import pytest

from openmm_sier import SIER4G, SIERIntegrator
from tests.support.waters import context_at


@pytest.mark.parametrize("engine", ["exact", "native"])
def test_bonds_that_constraints_hold_do_not_vibrate(engine):
    """The constrained bond has a period of 9 fs, at which SIER4G bears no step of 6 fs; the other one 300 fs."""
    system, bonds = openmm.System(), openmm.HarmonicBondForce()
    for mass in (12.0, 1.0, 12.0):
        system.addParticle(mass)
    system.addConstraint(0, 1, 0.109)
    bonds.addBond(1, 0, 0.109, 4.5e5)
    bonds.addBond(0, 2, 0.153, 2.6e3)
    system.addForce(bonds)
    positions = np.array([[0.109, 0, 0], [0, 0, 0], [0.262, 0, 0]])
    integrator = SIERIntegrator(0.006, SIER4G, engine=engine)
    context_at(system, integrator, (positions, np.zeros((3, 3))))
    assert integrator.engine == engine
