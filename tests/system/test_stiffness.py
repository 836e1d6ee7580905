"""A force that is too stiff for the step is named when constraints fail."""

from __future__ import annotations

import numpy as np
import openmm
import pytest

from openmm_sier import SIER4GIntegrator
from openmm_sier.system.stiffness import stiffest_force
from tests.support.peptides import capped_alanine
from tests.support.waters import context_at


def restrained(strength):
    """A peptide with constraints, each of its atoms held where it is."""
    system, positions = capped_alanine(2)
    force = openmm.CustomExternalForce("0.5*k*((x-x0)^2+(y-y0)^2+(z-z0)^2)")
    force.setName("Restraint")
    force.addGlobalParameter("k", 1.0)
    for name in ("x0", "y0", "z0"):
        force.addPerParticleParameter(name)
    for i in range(22):
        force.addParticle(i, positions[i])
    system.addForce(force)
    return system, positions, {"k": strength}


def at(system, positions, parameters, step=0.004):
    integrator = SIER4GIntegrator(step)
    context = context_at(system, integrator, (positions, 0 * positions))
    for name, value in parameters.items():
        context.setParameter(name, value)
    context.setVelocitiesToTemperature(300, 1)
    return integrator, context


def test_a_restraint_is_named_by_the_failing_step():
    integrator, context = at(*restrained(1.0))
    # Had it been so stiff at the first step, that would have been refused.
    integrator.step(1)
    context.setParameter("k", 1e6)
    with pytest.raises(openmm.OpenMMException) as error:
        integrator.step(200)
    message = str(error.value)
    assert "have no solution near" in message
    assert "a force too stiff for it (the stiffest force on these atoms is Restraint (CustomExternalForce)" in message
    assert "of force group 0, with 1e+06 kJ/mol/nm^2" in message
    assert "The Context is left at the last completed step" in message
    assert np.isfinite(context.getState(positions=True).getPositions(asNumpy=True)._value).all()


def test_forces_that_curve_nothing_are_not_named():
    free = openmm.System()
    free.addParticle(1.0)
    context = openmm.Context(free, openmm.VerletIntegrator(0.001))
    assert stiffest_force(context, np.zeros((1, 3)), [0]) is None
