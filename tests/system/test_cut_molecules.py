"""What the periodic boundary cuts is refused with the remedy where it would be pulled together, or become a shape."""

from functools import partial

import numpy as np
import openmm
import pytest

from openmm_sier import (
    RigidBodies,
    RigidityError,
    SIERIntegrator,
    SIERLangevinIntegrator,
    make_whole,
    set_inertia,
    with_frames,
)
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


def bonded_peptide():
    """A peptide that the boundary cuts at a bond of heavy atoms, which no constraint holds."""
    system, x = peptide()
    constrained = [system.getConstraintParameters(i)[:2] for i in range(system.getNumConstraints())]
    bonds = next(force for force in system.getForces() if isinstance(force, openmm.HarmonicBondForce))
    ends = (bonds.getBondParameters(i)[:2] for i in range(bonds.getNumBonds()))
    for a, b in ends:
        shifted = x - (x[a] + x[b]) / 2 + np.array([0, 1, 1])
        crosses = cut(system, shifted) - shifted
        if crosses[a, 0] != crosses[b, 0] and all(crosses[i, 0] == crosses[j, 0] for i, j in constrained):
            return system, shifted
    raise AssertionError("every plane through a bond cuts a constraint")


MOLECULES = {"chain": chain, "peptide": peptide, "bonded": bonded_peptide, "water": water}


def acts(integrator, context):
    """Everything that satisfies constraints, or needs them satisfied."""
    results = {"step": partial(integrator.step, 1), "minimize": partial(openmm.LocalEnergyMinimizer.minimize, context)}
    return results | ({"state": integrator.getBodyState} if integrator.engine == "exact" else {})


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
        with pytest.raises(RigidityError, match=r"make_whole\("):
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
        integrator = SIERIntegrator(0.001, "SIER2", engine=engine)
        context = context_at(system, integrator, (x, 0 * x), steps=1)
        openmm.LocalEnergyMinimizer.minimize(context, maxIterations=2)
        assert np.abs(phase_point(context)[0] - x).max() < 0.1


@pytest.mark.parametrize("engine", ENGINES)
def test_a_bond_that_is_made_longer_in_a_context_is_not_cut(engine):
    """A restraint may pull two molecules apart, to more than half the box."""
    x = np.array([[0.0, 0, 0], [0.5, 0, 0], [2, 2, 2]])
    system = body_system(x)
    restraint = system.getForce(1)
    restraint.addBond(0, 1, 0.5, 1000.0)
    integrator = SIERIntegrator(0.001, "SIER2", engine=engine)
    context = context_at(system, integrator, (x, np.zeros_like(x)))
    integrator.step(1)
    x[1, 0] = 2.0
    restraint.setBondParameters(0, 0, 1, x[1, 0], 1000.0)
    restraint.updateParametersInContext(context)
    context.setPositions(x)
    integrator.step(1)
    assert context.getState(energy=True).getPotentialEnergy()._value == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("engine", ENGINES)
def test_without_a_box_the_question_is_asked(engine):
    """A System that is not periodic with positions of one that was: the cut cannot be recognized."""
    system, whole = chain(periodic=False)
    broken = cut(system, whole)
    integrator = SIERIntegrator(0.001, "SIER2", engine=engine)
    _context = context_at(system, integrator, (broken, 0 * broken))
    with pytest.raises(RigidityError, match=r"make_whole\("):
        integrator.step(1)


# --- bodies, whose shape positions give ---

#: Three atoms of which the last are beyond the boundary of a box of 3 nm.
TRIANGLE = np.array([[2.9, 1.0, 1.0], [3.05, 1.0, 1.0], [3.05, 1.15, 1.0]])

#: A row of 19 atoms, longer than half the box, that the boundary cuts once it is wrapped.
ROW = np.column_stack([2.0 + 0.12 * np.arange(19), np.full(19, 1.0), 1.0 + 0.1 * (np.arange(19) % 2)])


def body_system(x, strength=None, periodic_bonds=False):
    """Atoms in a periodic box, in a row of bonds of some strength, if any."""
    system, pairwise = openmm.System(), openmm.NonbondedForce()
    pairwise.setNonbondedMethod(pairwise.CutoffPeriodic)
    system.setDefaultPeriodicBoxVectors(*(BOX * np.eye(3)))
    bonds = openmm.HarmonicBondForce()
    bonds.setUsesPeriodicBoundaryConditions(periodic_bonds)
    for i in range(len(x)):
        system.addParticle(12.0)
        pairwise.addParticle(0, 0.3, 0)
        if i and strength is not None:
            bonds.addBond(i - 1, i, float(np.linalg.norm(x[i] - x[i - 1])), strength)
    system.addForce(pairwise)
    system.addForce(bonds)
    return system


SHAPED = {
    "from_system": lambda system, bodies, x: RigidBodies.from_system(system, None, bodies, x),
    "with_frames": lambda system, bodies, x: with_frames(system, x, bodies),
    "set_inertia": lambda system, bodies, x: set_inertia(system, x, bodies, 36, [0.09, 0.27, 0.36]),
}


@pytest.mark.parametrize("bonds", [None, 2e5, 0.0, "periodic"])
@pytest.mark.parametrize("way", SHAPED)
def test_a_cut_body_is_refused_however_it_gets_its_shape(way, bonds):
    """It would have a moment of 65 dalton nm^2 in place of 0.36, in silence; and the remedy of the message works."""
    system = body_system(TRIANGLE, 2e5 if bonds == "periodic" else bonds, bonds == "periodic")
    broken, bodies = cut(system, TRIANGLE), [[0, 1, 2]]
    with pytest.raises(RigidityError, match=r"make_whole\("):
        SHAPED[way](system, bodies, broken)
    whole = make_whole(system, broken, bodies=bodies)
    # By box vectors, so to the rounding of 3 nm.
    np.testing.assert_allclose(whole - whole[0], TRIANGLE - TRIANGLE[0], atol=1e-14)
    assert np.array_equal(make_whole(system, whole, bodies=bodies), whole)
    result = RigidBodies.from_system(system, None, bodies, whole)
    np.testing.assert_allclose(result.moments[:, 0], [0.09, 0.27, 0.36], atol=1e-9)
    SHAPED[way](system, bodies, whole)
    # Bodies that are known are looked at as well.
    assert np.array_equal(make_whole(system, broken, bodies=result), whole)


def test_a_body_longer_than_half_the_box_is_whole_by_its_bonds():
    system, bodies = body_system(ROW, 1e5), [range(len(ROW))]
    assert np.ptp(ROW, axis=0)[0] > 0.7 * BOX
    assert np.array_equal(make_whole(system, ROW, bodies=bodies), ROW)
    result = RigidBodies.from_system(system, None, bodies, ROW)
    broken = cut(system, ROW)
    with pytest.raises(RigidityError, match="periodic boundary"):
        RigidBodies.from_system(system, None, bodies, broken)
    whole = make_whole(system, broken, bodies=bodies)
    np.testing.assert_allclose(whole - whole[0], ROW - ROW[0], atol=1e-13)
    np.testing.assert_allclose(RigidBodies.from_system(system, None, bodies, whole).moments, result.moments, rtol=1e-9)


def test_a_body_longer_than_half_the_box_is_refused_without_bonds():
    """Two atoms that are 2 nm apart in a box of 3 nm look like two that are 1 nm apart, and cut."""
    for strength in (None, 0.0):
        system, bodies = body_system(ROW, strength), [range(len(ROW))]
        for x in (ROW, cut(system, ROW)):
            with pytest.raises(RigidityError, match=r"half the box.*HarmonicBondForce"):
                make_whole(system, x, bodies=bodies)
            with pytest.raises(RigidityError, match=r"half the box.*HarmonicBondForce"):
                RigidBodies.from_system(system, None, bodies, x)


def test_a_body_longer_than_half_the_box_is_taken_as_it_is_about_its_first_atom():
    system, body = body_system(ROW), [9, *range(9), *range(10, 19)]
    assert np.array_equal(make_whole(system, ROW, bodies=[body]), ROW)
    RigidBodies.from_system(system, None, [body], ROW)


def test_bodies_of_several_molecules_are_made_whole_with_their_linkers():
    """A molecule moves as a whole, also with the atoms that are in no body, and so do bodies that share a molecule."""
    x = np.array([[2.8, 1, 1], [2.95, 1, 1], [3.1, 1, 1], [3.1, 1.3, 1], [3.1, 1.45, 1], [2.9, 1.3, 1.0]])
    system = body_system(x)
    for a, b in ((0, 1), (1, 2), (3, 4)):
        system.getForce(1).addBond(a, b, float(np.linalg.norm(x[a] - x[b])), 1e5)
    bodies = [[3, 0], [4, 5]]
    whole = make_whole(system, cut(system, x), bodies=bodies)
    np.testing.assert_allclose(whole - whole[0], x - x[0], atol=1e-14)
