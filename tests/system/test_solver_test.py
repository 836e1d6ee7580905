"""Constraints that OpenMM's own solvers cannot satisfy are found, and no others."""

import numpy as np
import openmm
import pytest
from openmm import app

from openmm_sier.system import solver_test
from openmm_sier.system.second_context import reference_context as made
from openmm_sier.system.solver_test import SolverTest
from tests.support.constrained_molecules import ConstrainedMolecule, benzene, complete, formate, methane, triangle
from tests.support.molecules import TETRAHEDRON
from tests.support.peptides import capped_alanine_box, forcefield
from tests.support.systems import assembled
from tests.support.waters import cluster_system

LINE = np.array([[0.0, 0, 0], [0.116, 0, 0], [-0.116, 0, 0]])
SQUARE = 0.15 * np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
OCTAHEDRON = 0.15 * np.concatenate([np.eye(3), -np.eye(3)])

#: Molecules that OpenMM's solvers can satisfy.
SOLVED = {
    "water": triangle([16, 1, 1]),
    "triangle of three lengths and masses": complete([16, 1, 2], [[0, 0, 0], [0.1, 0, 0], [-0.03, 0.12, 0]]),
    "HDO with lengths of its own": complete([16, 1, 2], [[0, 0, 0], [0.0957, 0, 0], [-0.024, 0.0927, 0]]),
    "equal lengths, the first atom lighter": triangle([1, 12, 12], np.pi / 3),
    "a bent trimer": triangle([12, 16, 16], np.radians(175), 0.116),
    "tetrahedron": complete(4 * [31], TETRAHEDRON[1:]),
    "ammonia": complete([14, 1, 1, 1], TETRAHEDRON[:4]),
    "methane with bonds alone": ConstrainedMolecule([12, 1, 1, 1, 1], TETRAHEDRON, [(0, i) for i in range(1, 5)]),
    "a methyl group with its bond": methane().without((1, 4), (2, 4), (3, 4)),
    "a square with a diagonal": complete(4 * [12], SQUARE).without((0, 2)),
    "octahedron": complete(6 * [12], OCTAHEDRON).without((0, 3), (1, 4), (2, 5)),
    "benzene with bonds alone": ConstrainedMolecule(
        6 * [12] + 6 * [1], benzene().places, [*((i, i + 1) for i in range(5)), (0, 5), *((i, i + 6) for i in range(6))]
    ),
}

#: Molecules that they cannot.
UNSOLVED = {
    "methane": methane(),
    "methane without a constraint": methane().without((1, 2)),
    "methane without two": methane().without((1, 2), (3, 4)),
    "formate": formate(),
    "formate without a constraint": formate().without((2, 3)),
    "benzene": benzene(),
    "HDO": triangle([16, 1, 2]),
    "HDO in another order": triangle([16, 1, 2]).ordered([1, 0, 2]),
    "oxygen isotopes": triangle([16, 16, 18], np.radians(117), 0.1272),
    "equal lengths": triangle([12, 1, 12], np.pi / 3),
    "a line": complete([12, 16, 16], LINE),
}


def trial(molecule, *forces):
    return SolverTest(assembled(molecule.masses, *forces, constraints=molecule.constraints()))


def unsolved(molecule, *forces):
    return trial(molecule, *forces).unsolved(lambda: molecule.places)


@pytest.mark.parametrize("name", SOLVED)
def test_constraints_that_openmm_satisfies(name):
    assert unsolved(SOLVED[name]) == ()


@pytest.mark.parametrize("name", UNSOLVED)
def test_constraints_that_it_cannot_satisfy(name):
    molecule = UNSOLVED[name]
    tried = trial(molecule)
    # Positions that are not set, and those that the boundary cuts, are left for the next time.
    for nowhere in (np.zeros_like(molecule.places), molecule.places + 3.0 * np.eye(len(molecule.masses))[:, :1]):
        assert tried.unsolved(lambda nowhere=nowhere: nowhere) == ()
    assert tried.unsolved(lambda: molecule.places) == tuple(range(len(molecule.masses)))
    with pytest.raises(openmm.OpenMMException, match=r"atoms 0, 1, 2.*engine='exact'"):
        tried.refuse(lambda: molecule.places)


def test_angles_of_a_force_count():
    """OpenMM's matrix takes the angles that no third constraint gives from a HarmonicAngleForce."""
    molecule, force = methane().without((1, 2)), openmm.HarmonicAngleForce()
    force.addAngle(1, 0, 2, np.arccos(-1 / 3), 100.0)
    for corner in (3, 4):
        force.addAngle(1, corner, 2, np.pi / 3, 0.0)
    assert unsolved(molecule)
    assert not unsolved(molecule, force)


def test_one_molecule_among_many():
    """The molecule that OpenMM cannot solve is named, wherever it is in the System."""
    odd = {5: triangle([16, 1, 2])}
    molecules = [odd.get(i, triangle([16, 1, 1])) for i in range(8)]
    masses = [mass for molecule in molecules for mass in molecule.masses]
    constraints = [row for i, molecule in enumerate(molecules) for row in molecule.constraints(3 * i)]
    places = np.concatenate([molecule.places for molecule in molecules])
    assert SolverTest(assembled(masses, constraints=constraints)).unsolved(lambda: places) == (15, 16, 17)


def test_one_triangle_of_each_kind_is_tried(monkeypatch):
    molecules = [triangle([16, 1, 1])] * 5 + [triangle([18, 1, 1])] * 5
    masses = [mass for molecule in molecules for mass in molecule.masses]
    constraints = [row for i, molecule in enumerate(molecules) for row in molecule.constraints(3 * i)]
    places, tried = np.concatenate([molecule.places for molecule in molecules]), []
    monkeypatch.setattr(solver_test, "reference_context", lambda system: tried.append(system) or made(system))
    assert not SolverTest(assembled(masses, constraints=constraints)).unsolved(lambda: places)
    assert [system.getNumParticles() for system in tried] == [6]


def test_frozen_atoms_have_no_constraints():
    assert not unsolved(triangle([0, 0, 0]))


def test_usual_systems():
    for model in ("tip3p", "tip4pew", "tip5p", "spce"):
        _, positions, system = cluster_system(3, model)
        assert not SolverTest(system).unsolved(lambda positions=positions: positions)
    topology, positions = capped_alanine_box(waters=3)
    for constraints in (app.HBonds, app.AllBonds, app.HAngles):
        system = forcefield().createSystem(topology, constraints=constraints)
        assert not SolverTest(system).unsolved(lambda: positions)
