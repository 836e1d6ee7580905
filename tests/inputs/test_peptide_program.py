"""The program that makes peptides: every residue has the geometry of the force field, and is an L-amino acid."""

import numpy as np
import openmm
import pytest
from openmm import unit

from tests.support.commands import load_program
from tests.support.peptides import PROGRAM, forcefield


@pytest.fixture(scope="module")
def program():
    return load_program(PROGRAM)


def handedness(topology, x):
    """Of each residue with CB: the triple product of N, C and CB about CA, in nm^3."""
    results = []
    for residue in topology.residues():
        at = {atom.name: x[atom.index] for atom in residue.atoms()}
        if "CB" in at:
            results.append(np.linalg.det([at[name] - at["CA"] for name in ("N", "C", "CB")]))
    return np.array(results)


def test_every_residue(program):
    """As a helix: hydrogens can be added, and no bond or angle of the others is far from the force field's."""
    names = sorted(program.SIDE_CHAINS)
    assert sorted(program.LETTERS.values()) == names
    peptide = program.dry(names, *program.LONG_TORSIONS)
    x = np.array(peptide.positions.value_in_unit(unit.nanometer))
    # Clockwise, seen with the hydrogen towards the viewer: CO, R, N. Edges of 0.15 nm at tetrahedral angles.
    turns = handedness(peptide.topology, x)
    assert len(turns) == len(names) - 1
    assert turns == pytest.approx(turns[0], rel=0.1)
    assert turns[0] > 0
    system = forcefield().createSystem(peptide.topology)
    bonds, angles = (
        next(force for force in system.getForces() if isinstance(force, kind))
        for kind in (openmm.HarmonicBondForce, openmm.HarmonicAngleForce)
    )
    for i, j, length, _ in map(bonds.getBondParameters, range(bonds.getNumBonds())):
        # Those of crystals and of force fields differ by 0.002 nm; those that close rings by more.
        assert np.linalg.norm(x[i] - x[j]) == pytest.approx(length._value, abs=0.006)
    atoms = list(peptide.topology.atoms())
    for i, j, k, angle, _ in map(angles.getAngleParameters, range(angles.getNumAngles())):
        if "H" not in {atoms[end].element.symbol for end in (i, k)}:
            a, b = x[i] - x[j], x[k] - x[j]
            result = np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b))
            assert result == pytest.approx(angle._value, abs=0.15), [str(atoms[n]) for n in (i, j, k)]


def test_a_chain_that_is_turned_keeps_its_hand(program, rng):
    topology, x = program.chain(["ALA"] * 8, *program.LONG_TORSIONS)
    for _ in range(4):
        x = x @ np.linalg.qr(rng.normal(size=(3, 3)))[0] * np.sign(rng.normal())
        turned = program.lying(x)
        # Eight residues of a helix rise by 1.2 nm, and are 0.6 nm wide.
        extent = np.ptp(turned, axis=0)
        assert extent[0] == max(extent) > 1.0
        assert handedness(topology, turned) == pytest.approx(handedness(topology, x), rel=1e-9)


def test_unknown_residues_are_refused(program):
    with pytest.raises(ValueError, match="HIS"):
        program.chain(["ALA", "HIS"], -60, -40)
