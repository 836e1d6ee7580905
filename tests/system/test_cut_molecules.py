"""Molecules that the periodic boundary cuts: refused with the remedy by everything that would pull them together."""

from functools import partial

import numpy as np
import openmm
import pytest

from openmm_sier import RigidityError, SIER2Integrator, SIERLangevinIntegrator, make_whole
from tests.support.peptides import capped_alanine
from tests.support.waters import context_at, periodic_system, phase_point

ENGINES = ("exact", "native")
BOX = 3.0


def chain(periodic=True):
    """Four beads that constraints hold in a row, beside the lower boundary of the box, and where the second is."""
    forces = openmm.NonbondedForce()
    forces.setNonbondedMethod(forces.CutoffPeriodic if periodic else forces.CutoffNonPeriodic)
    system = openmm.System()
    system.setDefaultPeriodicBoxVectors(*(BOX * np.eye(3)))
    x = np.array([[0.12 * i - 0.2, 0.09 * (i % 2), 1.0] for i in range(4)])
    for i in range(4):
        system.addParticle(14.0)
        forces.addParticle(0, 0.3, 0.1)
        if i:
            system.addConstraint(i - 1, i, 0.15)
            forces.addException(i - 1, i, 0, 1, 0)
    system.addForce(forces)
    return system, x


def peptide():
    """An all-atom peptide of which constraints hold the hydrogens."""
    system, x = capped_alanine(0)
    system.setDefaultPeriodicBoxVectors(*(BOX * np.eye(3)))
    force = next(force for force in system.getForces() if isinstance(force, openmm.NonbondedForce))
    force.setNonbondedMethod(force.CutoffPeriodic)
    # The boundary is between a carbon and its hydrogen.
    return system, x - (x[0] + x[1]) / 2 + np.array([0, 1, 1])


def water():
    _, x, system = periodic_system()
    return system, np.array(x)


def cut(system, x):
    """Each atom in the box, one by one, as a program that knows no molecules leaves them."""
    edges = np.array([vector._value for vector in system.getDefaultPeriodicBoxVectors()]).diagonal()
    return x - edges * np.floor(x / edges)


MOLECULES = {"chain": chain, "peptide": peptide, "water": water}


def acts(integrator, context):
    """Everything that satisfies constraints, or needs them satisfied."""
    found = {"step": partial(integrator.step, 1), "minimize": partial(openmm.LocalEnergyMinimizer.minimize, context)}
    return found | ({"state": integrator.getBodyState} if integrator.engine == "exact" else {})


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("kind", MOLECULES)
def test_what_the_boundary_cuts_is_refused_with_the_remedy(kind, engine):
    """OpenMM would pull the parts together across the box, in silence; and nothing has been moved."""
    system, whole = MOLECULES[kind]()
    broken = cut(system, whole)
    if kind == "water":
        # One of its hydrogens across the box, wherever the molecules are.
        broken = whole.copy()
        broken[1] += [system.getDefaultPeriodicBoxVectors()[0][0]._value, 0, 0]
    assert np.abs(broken - whole).max() > 1
    integrator = SIERLangevinIntegrator(300, 1, 0.001, engine=engine)
    context = context_at(system, integrator, (broken, 0 * broken))
    for act in acts(integrator, context).values():
        with pytest.raises(
            RigidityError, match=r"apart, but their constraint has the length .* boundary cuts .*make_whole\("
        ):
            act()
    np.testing.assert_array_equal(phase_point(context)[0], broken)
    assert context.getStepCount() == 0
    context.setPositions(make_whole(system, broken))
    integrator.step(1)
    assert context.getStepCount() == 1


@pytest.mark.parametrize("engine", ENGINES)
def test_molecules_that_are_whole_across_the_boundary_are_taken(engine):
    """Wherever they are, also in the next box."""
    system, whole = chain()
    for shift in (0, BOX, -2 * BOX):
        x = whole + np.array([shift, 0, 0])
        integrator = SIER2Integrator(0.001, engine=engine)
        context = context_at(system, integrator, (x, 0 * x), steps=1)
        openmm.LocalEnergyMinimizer.minimize(context, maxIterations=2)
        assert np.abs(phase_point(context)[0] - x).max() < 0.1


@pytest.mark.parametrize("engine", ENGINES)
def test_without_a_box_the_question_is_asked(engine):
    """A System that is not periodic with positions of one that was: nothing tells that they were cut."""
    system, whole = chain(periodic=False)
    broken = cut(system, whole)
    integrator = SIER2Integrator(0.001, engine=engine)
    _context = context_at(system, integrator, (broken, 0 * broken))
    with pytest.raises(RigidityError, match=r"Does the periodic boundary cut the molecule\? .*make_whole\("):
        integrator.step(1)
