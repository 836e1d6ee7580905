"""Forces that act between steps are distinguished from those that do not."""

import numpy as np
import openmm
import pytest

from openmm_sier import SIERIntegrator
from openmm_sier.system.checks import acting_forces
from openmm_sier.system.forces import FORCES
from openmm_sier.system.second_context import cloned
from tests.support.systems import assembled, field, with_forces
from tests.support.waters import platform


def no_force(state):
    raise NotImplementedError


def alone(force):
    """A CustomCVForce of one variable."""
    outer = openmm.CustomCVForce("x")
    outer.addCollectiveVariable("x", force)
    return outer


def mixed(force):
    """An ATMForce of one Force."""
    outer = openmm.ATMForce("u0 + u1")
    outer.addForce(force)
    return outer


@pytest.mark.parametrize(
    "force",
    [
        openmm.AmoebaTorsionTorsionForce(),
        openmm.AmoebaVdwForce(),
        openmm.ConstantPotentialForce(),
        openmm.CustomVolumeForce("v"),
        openmm.HippoNonbondedForce(),
        openmm.LCPOForce(),
        openmm.OrientationRestraintForce(1.0, [openmm.Vec3(0, 0, 0)]),
        openmm.RGForce(),
    ],
    ids=lambda force: type(force).__name__,
)
def test_forces_that_only_give_forces_do_not_act(force):
    """Neither with a barostat, whose moves are read back only if they changed something."""
    system = with_forces(assembled([1.0]), force)
    assert acting_forces(system) == []
    (acting,) = acting_forces(with_forces(system, openmm.MonteCarloBarostat(1.0, 300.0)))
    assert isinstance(acting, openmm.MonteCarloBarostat)


@pytest.mark.parametrize("outer", [alone, mixed])
def test_what_a_force_contains_acts(outer):
    assert acting_forces(assembled([1.0], outer(field("x", [0])))) == []
    for force in (openmm.PythonForce(no_force), outer(openmm.PythonForce(no_force))):
        assert [type(acting) for acting in acting_forces(assembled([1.0], force))] == [type(force)]


def test_an_unknown_force_acts(monkeypatch):
    """One of a plugin, or of a later OpenMM: the exact engine updates and reads the Context at each step."""
    monkeypatch.delitem(FORCES, openmm.CustomExternalForce)
    integrator = SIERIntegrator(0.001, "SIER2")
    context = openmm.Context(assembled([1.0], field("x", [0])), integrator, platform())
    context.setPositions([[0, 0, 0]])
    integrator.step(1)
    updates = integrator.impl.engine.updates
    assert updates.acts
    assert not updates.are_of_barostats


def test_a_system_that_cannot_be_copied_has_a_remedy():
    system = assembled([12.0], openmm.PythonForce(lambda state: (0.0, np.zeros((1, 3)))))
    with pytest.raises(openmm.OpenMMException, match=r"pickled.*`def` defines at the top level"):
        cloned(system)
