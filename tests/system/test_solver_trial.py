"""Constraints that OpenMM's own solvers cannot satisfy are found, and no others."""

import re

import numpy as np
import openmm
import pytest
from openmm import app

from openmm_sier.system.solver_trial import SolverTrial
from tests.support.braced import Braced, benzene, complete, formate, methane, triangle
from tests.support.molecules import TETRAHEDRON
from tests.support.peptides import capped_alanine_box, forcefield
from tests.support.systems import assembled
from tests.support.waters import cluster_system

LINE = np.array([[0.0, 0, 0], [0.116, 0, 0], [-0.116, 0, 0]])
SQUARE = 0.15 * np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
OCTAHEDRON = 0.15 * np.concatenate([np.eye(3), -np.eye(3)])

#: Molecules that OpenMM's solvers bear.
SOLVED = {
    "water": triangle([16, 1, 1]),
    "triangle of three lengths and masses": complete([16, 1, 2], [[0, 0, 0], [0.1, 0, 0], [-0.03, 0.12, 0]]),
    "HDO with lengths of its own": complete([16, 1, 2], [[0, 0, 0], [0.0957, 0, 0], [-0.024, 0.0927, 0]]),
    "equal lengths, the first atom lighter": triangle([1, 12, 12], np.pi / 3),
    "a bent trimer": triangle([12, 16, 16], np.radians(175), 0.116),
    "tetrahedron": complete(4 * [31], TETRAHEDRON[1:]),
    "ammonia": complete([14, 1, 1, 1], TETRAHEDRON[:4]),
    "methane with bonds alone": Braced([12, 1, 1, 1, 1], TETRAHEDRON, [(0, i) for i in range(1, 5)]),
    "a methyl group with its bond": methane().without((1, 4), (2, 4), (3, 4)),
    "a square with a diagonal": complete(4 * [12], SQUARE).without((0, 2)),
    "octahedron": complete(6 * [12], OCTAHEDRON).without((0, 3), (1, 4), (2, 5)),
    "benzene with bonds alone": Braced(
        6 * [12] + 6 * [1], benzene().places, [*((i, i + 1) for i in range(5)), (0, 5), *((i, i + 6) for i in range(6))]
    ),
}

#: Molecules that they do not, with the reason, and whether positions are needed to see it.
UNSOLVED = {
    "methane": (methane(), "10 constraints join them, and 9 are enough", False),
    "methane without a constraint": (methane().without((1, 2)), "its iterations for these 9 constraints diverge", True),
    "methane without two": (methane().without((1, 2), (3, 4)), "its iterations for these 8 constraints", True),
    "formate": (formate(), "its iterations for these 6 constraints diverge", False),
    "formate without a constraint": (formate().without((2, 3)), "its iterations for these 5 constraints", True),
    "benzene": (benzene(), "66 constraints join them, and 30 are enough", False),
    "HDO": (triangle([16, 1, 2]), r"atoms 1 and 2 .* differ in mass \(1 and 2 dalton\)", False),
    "HDO in another order": (triangle([16, 1, 2]).ordered([1, 0, 2]), "atoms 0 and 2 are equally far", False),
    "oxygen isotopes": (triangle([16, 16, 18], np.radians(117), 0.1272), "differ in mass", False),
    "equal lengths": (triangle([12, 1, 12], np.pi / 3), "atoms 1 and 2 are equally far from atom 0 but differ", False),
    "a line": (complete([12, 16, 16], LINE), "they lie on a line", False),
    "nearly a line": (triangle([12, 16, 16], np.radians(179.9), 0.116), "they lie on a line", False),
}


def trial(molecule, *forces):
    return SolverTrial(assembled(molecule.masses, *forces, constraints=molecule.constraints()))


@pytest.mark.parametrize("name", SOLVED)
def test_what_openmm_bears(name):
    molecule = SOLVED[name]
    assert trial(molecule).unsolved(lambda: molecule.places) is None


@pytest.mark.parametrize("name", UNSOLVED)
def test_what_it_does_not(name):
    molecule, why, needs_positions = UNSOLVED[name]
    tried = trial(molecule)
    assert (tried.unsolved() is None) == needs_positions
    # Positions that are not set, and those that the boundary cuts, tell nothing.
    for nowhere in (np.zeros_like(molecule.places), molecule.places + 3.0 * np.eye(len(molecule.masses))[:, :1]):
        assert (tried.unsolved(lambda nowhere=nowhere: nowhere) is None) == needs_positions
    found = tried.unsolved(lambda: molecule.places)
    assert re.search(why, str(found))
    assert found.atoms == tuple(range(len(molecule.masses)))


def test_angles_of_a_force_count():
    """OpenMM's matrix takes the angles that no third constraint gives from a HarmonicAngleForce."""
    molecule, force = methane().without((1, 2)), openmm.HarmonicAngleForce()
    force.addAngle(1, 0, 2, np.arccos(-1 / 3), 100.0)
    for corner in (3, 4):
        force.addAngle(1, corner, 2, np.pi / 3, 0.0)
    assert trial(molecule).unsolved(lambda: molecule.places) is not None
    assert trial(molecule, force).unsolved(lambda: molecule.places) is None


def test_one_molecule_among_many():
    """The one that OpenMM cannot solve is named, wherever it is and whatever is beside it."""
    odd = {5: triangle([16, 1, 2])}
    molecules = [odd.get(i, triangle([16, 1, 1])) for i in range(8)]
    masses = [mass for molecule in molecules for mass in molecule.masses]
    constraints = [row for i, molecule in enumerate(molecules) for row in molecule.constraints(3 * i)]
    assert SolverTrial(assembled(masses, constraints=constraints)).unsolved().atoms == (15, 16, 17)


def test_frozen_atoms_have_no_constraints():
    molecule = triangle([0, 0, 0])
    assert trial(molecule).unsolved(lambda: molecule.places) is None


def test_usual_systems():
    for model in ("tip3p", "tip4pew", "tip5p", "spce"):
        _, positions, system = cluster_system(3, model)
        assert SolverTrial(system).unsolved(lambda positions=positions: positions) is None
    topology, positions = capped_alanine_box(waters=3)
    for constraints in (app.HBonds, app.AllBonds, app.HAngles):
        system = forcefield().createSystem(topology, constraints=constraints)
        assert SolverTrial(system).unsolved(lambda: positions) is None
