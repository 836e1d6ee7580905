"""Tables of a System are what OpenMM's methods return, each read once for a call."""

from itertools import combinations

import numpy as np
import openmm
import pytest
from openmm import unit

from openmm_sier import SIERIntegrator
from openmm_sier.system import tables
from openmm_sier.system.bonded_terms import harmonic_angles, harmonic_bonds
from tests.support.waters import platform


@pytest.fixture
def system(rng):
    """Particles with random parameters of every kind that tables hold."""
    system, nonbonded = openmm.System(), openmm.NonbondedForce()
    bonds, angles = openmm.HarmonicBondForce(), openmm.HarmonicAngleForce()
    for mass in [*rng.uniform(1, 20, 8), 0.0, 0.0]:
        system.addParticle(mass)
        nonbonded.addParticle(*rng.random(3))
    system.setVirtualSite(8, openmm.TwoParticleAverageSite(0, 1, 0.5, 0.5))
    for first, second in ((3, 1), (0, 2), (1, 3), (2, 0), (4, 5)):
        system.addConstraint(first, second, 0.1 + 0.01 * (first + second))
        bonds.addBond(first, second, *rng.random(2))
    for first in range(4):
        nonbonded.addException(first, first + 4, *rng.random(3))
        angles.addAngle(first, first + 1, first + 2, *rng.random(2))
    for force in (nonbonded, bonds, angles):
        system.addForce(force)
    return system


def numbers(values):
    """Numbers in OpenMM's units."""
    return [value.value_in_unit_system(unit.md_unit_system) if unit.is_quantity(value) else value for value in values]


def test_tables_have_the_numbers_of_openmm(system):
    nonbonded, bonds, angles = system.getForces()
    assert tables.masses(system).tolist() == numbers(map(system.getParticleMass, range(10)))
    assert tables.atom_parameters(nonbonded).tolist() == [
        numbers(nonbonded.getParticleParameters(i)) for i in range(10)
    ]
    pairs, parameters = tables.exceptions(nonbonded)
    assert np.column_stack([pairs, parameters]).tolist() == [
        numbers(nonbonded.getExceptionParameters(i)) for i in range(4)
    ]
    assert np.column_stack(harmonic_bonds(bonds)).tolist() == [numbers(bonds.getBondParameters(i)) for i in range(5)]
    assert np.column_stack(harmonic_angles(angles)).tolist() == [
        numbers(angles.getAngleParameters(i)) for i in range(4)
    ]
    assert tables.virtual_sites(system).tolist() == [8]
    assert tables.frozen_atoms(system).tolist() == [9]
    # Repeated ones count once, where they are first.
    assert tables.constraints(system).pairs.tolist() == [[1, 3], [0, 2], [4, 5]]


@pytest.mark.parametrize("length", [-0.1, 0.0, float("nan"), float("inf")])
@pytest.mark.parametrize("engine", ["exact", "native"])
def test_a_constraint_without_a_positive_length_is_refused(engine, length):
    """Within a body as between points. OpenMM takes the square of a length and accepts all of these."""
    rigid, points = openmm.System(), openmm.System()
    for system, pairs in ((rigid, combinations(range(3), 2)), (points, [(0, 1), (1, 2)])):
        for mass in (16.0, 1.0, 1.0):
            system.addParticle(mass)
        for i, j in pairs:
            system.addConstraint(i, j, length if (i, j) == (0, 1) else 0.1)
        with pytest.raises(openmm.OpenMMException, match=r"atoms 0 and 1 has a length of .* nm, not above 0"):
            openmm.Context(system, SIERIntegrator(0.001, engine=engine), platform())


def test_a_system_is_read_once_and_nobody_writes_to_its_tables(system):
    with tables.read_once():
        before = tables.masses(system)
        system.setParticleMass(0, 50.0)
        with tables.read_once():
            assert tables.masses(system) is before
        tables.forget()
        assert tables.masses(system)[0] == 50.0
    system.setParticleMass(0, 60.0)
    assert tables.masses(system)[0] == 60.0
    with pytest.raises(ValueError, match="read-only"):
        tables.masses(system)[0] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        tables.constraints(system).pairs[0] = 1


def test_constraints_hold_clusters_all_of_whose_distances_they_have(rng):
    pairs = np.unique(np.sort(rng.integers(0, 12, (60, 2)), axis=1), axis=0)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    constraints = tables.Constraints(pairs, rng.random(len(pairs)))
    known = set(map(tuple, pairs.tolist()))
    # Particles from 12 on have no constraint.
    kinds = [np.array([rng.permutation(14)[:size] for _ in range(20)]) for size in (1, 2, 3, 2, 4)]
    expected = [
        [all(pair in known for pair in combinations(sorted(row), 2)) for row in kind.tolist()] for kind in kinds
    ]
    assert [held.tolist() for held in constraints.hold(kinds)] == expected
    assert sum(map(sum, expected[1:])) > 5
    none = tables.Constraints(np.empty((0, 2), dtype=np.int64), np.empty(0))
    assert [held.all() for held in none.hold(kinds)] == [True, False, False, False, False]
