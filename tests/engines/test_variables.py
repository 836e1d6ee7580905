"""Per-atom variables, which are read at the end of a checkpoint."""

import numpy as np
import openmm
import pytest

from openmm_sier import SIERIntegrator
from openmm_sier.engines.variables import STATE_VARIABLES, per_atom_values
from openmm_sier.system.arguments import vectors_to_array


@pytest.fixture
def context():
    system = openmm.System()
    for _ in range(5):
        system.addParticle(1.0)
    context = openmm.Context(system, SIERIntegrator(0.001), openmm.Platform.getPlatform("Reference"))
    context.setPositions(np.zeros((5, 3)))
    # One that is no number is compared as it is.
    integrator = context.getIntegrator()
    integrator.setGlobalVariable(integrator.getNumGlobalVariables() - 1, np.nan)
    for number, name in enumerate(STATE_VARIABLES):
        integrator.setPerDofVariableByName(name, np.arange(15.0).reshape(5, 3) + 100 * number)
    return context


def values_of_openmm(context):
    names = reversed(STATE_VARIABLES)
    return np.array([vectors_to_array(context.getIntegrator().getPerDofVariableByName(name)) for name in names])


def test_variables_are_those_that_openmm_gives(context, monkeypatch):
    expected = values_of_openmm(context)
    # The numbers come from the checkpoint, not from OpenMM's lists.
    monkeypatch.setattr(openmm.CustomIntegrator, "getPerDofVariableByName", None)
    assert np.array_equal(per_atom_values(context, *reversed(STATE_VARIABLES)), expected)


def test_variables_of_a_checkpoint_of_another_form(context, monkeypatch):
    create = openmm.Context.createCheckpoint
    monkeypatch.setattr(openmm.Context, "createCheckpoint", lambda context: create(context) + bytes(8))
    assert np.array_equal(per_atom_values(context, *reversed(STATE_VARIABLES)), values_of_openmm(context))
