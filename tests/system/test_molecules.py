"""Molecules that the periodic box has cut are made whole, and broken ones are refused."""

import numpy as np
import openmm
import pytest
from openmm import app, unit

from openmm_sier import make_whole
from openmm_sier.inputs.forcefields import read_box
from openmm_sier.system.boxes import wrapped
from tests.support.peptides import capped_alanine_box, forcefield
from tests.support.systems import assembled
from tests.support.waters import plain_context

#: nm, as rows: wide enough for the peptide and its water, and oblique.
VECTORS = np.array([[2.4, 0, 0], [0.5, 2.3, 0], [-0.6, 0.7, 2.2]])


#: Atoms of a bond between two residues.
BOND = ("ALA", "C"), ("NME", "N")


@pytest.fixture(scope="module")
def peptide():
    """Topology in an oblique box, positions (N, 3) in nm of whole molecules, and the System by constraints."""
    topology, positions = capped_alanine_box(waters=20)
    topology = app.Modeller(topology, positions * unit.nanometer).topology
    topology.setPeriodicBoxVectors(VECTORS * unit.nanometer)
    made = {}
    for name, constraints in (("none", None), ("hbonds", app.HBonds)):
        settings = {"constraints": constraints, "rigidWater": constraints is not None, "removeCMMotion": False}
        made[name] = forcefield().createSystem(
            topology, nonbondedMethod=app.PME, nonbondedCutoff=0.8 * unit.nanometer, **settings
        )
    return topology, positions, made


def energy(system, positions):
    return plain_context(system, positions).getState(energy=True).getPotentialEnergy()._value


@pytest.mark.parametrize("constraints", ["none", "hbonds"])
@pytest.mark.parametrize("named", [True, False])
def test_molecules_wrapped_atom_by_atom_are_made_whole(peptide, rng, constraints, named):
    """Wherever the boundary cuts, also between residues. Constrained bonds have no energies."""
    topology, whole, systems = peptide
    system = systems[constraints]
    first = np.array([0] * 22 + [22 + 3 * (i // 3) for i in range(60)])
    for _ in range(5):
        cut = wrapped(whole + rng.uniform(0, 2, 3), VECTORS)
        assert np.abs((cut - cut[first]) - (whole - whole[first])).max() > 1
        mended = make_whole(system, cut * unit.nanometer, topology if named else None)
        np.testing.assert_allclose(mended - mended[first], whole - whole[first], atol=1e-12)
        assert np.array_equal(mended[first], cut[first])


def test_whole_molecules_stay_to_the_last_bit(peptide):
    topology, whole, systems = peptide
    for system in systems.values():
        assert np.array_equal(make_whole(system, whole, topology), whole)
        # Also where they reach out of the box.
        assert np.array_equal(make_whole(system, whole + 7, topology), whole + 7)


def test_a_molecule_longer_than_half_the_box_keeps_its_shape():
    """A chain of twelve atoms along a diagonal, whose ends are nearest to each other through the boundary."""
    bonds, pair = openmm.HarmonicBondForce(), openmm.CustomNonbondedForce("0")
    pair.setNonbondedMethod(pair.CutoffPeriodic)
    for i in range(12):
        pair.addParticle()
        if i:
            bonds.addBond(i - 1, i, 0.15, 2e5)
    system = assembled(12 * [12.0], bonds, pair)
    system.setDefaultPeriodicBoxVectors(*1.2 * np.eye(3))
    whole = np.arange(12)[:, None] * np.full(3, 0.15 / np.sqrt(3))
    np.testing.assert_allclose(make_whole(system, wrapped(whole, 1.2 * np.eye(3))), whole, atol=1e-12)


@pytest.mark.parametrize("cut", [False, True])
def test_a_virtual_site_may_be_far_from_the_atoms_that_place_it(cut):
    """Such as the centre of a protein, to which a restraint is tied: here 0.68 nm from both ends of a chain."""
    bonds, pair = openmm.HarmonicBondForce(), openmm.CustomNonbondedForce("0")
    pair.setNonbondedMethod(pair.CutoffPeriodic)
    for _ in range(11):
        pair.addParticle()
    for i in range(9):
        bonds.addBond(i, i + 1, 0.15, 2e5)
    system = assembled([*10 * [12.0], 0.0], bonds, pair)
    system.setVirtualSite(10, openmm.TwoParticleAverageSite(0, 9, 0.5, 0.5))
    box = 3 * np.eye(3)
    system.setDefaultPeriodicBoxVectors(*box)
    whole = np.outer([*np.arange(10), 4.5], [0.15, 0, 0])
    given = wrapped(whole + np.array([2.2, 0, 0]), box) if cut else whole
    found = make_whole(system, given)
    np.testing.assert_allclose(found - found[0], whole, atol=1e-12)
    assert cut or np.array_equal(found, whole)


def water(k=4.6e5, periodic=False):
    """Two flexible waters in a box of 3 nm, and a restraint between their oxygens of k kJ/mol/nm^2."""
    bonds, restraint = openmm.HarmonicBondForce(), openmm.HarmonicBondForce()
    for first in (0, 3):
        for hydrogen in (1, 2):
            bonds.addBond(first, first + hydrogen, 0.0957, 4.6e5)
    bonds.setUsesPeriodicBoundaryConditions(periodic)
    restraint.addBond(0, 3, 2.0, k)
    reciprocal = openmm.NonbondedForce()
    reciprocal.setNonbondedMethod(reciprocal.CutoffPeriodic)
    for _ in range(6):
        reciprocal.addParticle(0, 1, 0)
    system = assembled(2 * (16.0, 1.0, 1.0), bonds, restraint, reciprocal)
    system.setDefaultPeriodicBoxVectors(*3 * np.eye(3))
    molecule = np.array([[0, 0, 0], [0.0957, 0, 0], [-0.024, 0.0927, 0]])
    return system, np.concatenate([molecule, molecule + np.array([2.0, 0, 0])])


@pytest.mark.parametrize("k", [0.0, 1e3, 4.6e5])
def test_a_restraint_is_no_reason_to_move_a_molecule(k):
    """Nearest images would be 1 nm apart, where the restraint asks for 2 nm. Without strength it joins nothing."""
    system, positions = water(k)
    assert np.array_equal(make_whole(system, positions), positions)
    cut = positions.copy()
    cut[[1, 5]] += [[3, 0, 0], [0, -3, 0]]
    np.testing.assert_allclose(make_whole(system, cut), positions, atol=1e-14)


def test_bonds_that_know_the_box_need_no_whole_molecules():
    system, positions = water(periodic=True)
    positions[1] += [3, 0, 0]
    assert np.array_equal(make_whole(system, positions), positions)


@pytest.mark.parametrize("constraints", ["none", "hbonds"])
def test_a_broken_molecule_is_refused_with_residue_and_distance(peptide, constraints):
    topology, positions, systems = peptide
    system, moved = systems[constraints], positions.copy()
    oxygen = next(atom for atom in topology.atoms() if atom.name == "O" and atom.residue.name == "HOH")
    moved[oxygen.index] += [0, 1.0, 0.3]
    hydrogens = [atom.index for atom in oxygen.residue.atoms()][1:]
    distance = np.linalg.norm(moved[hydrogens] - moved[oxygen.index], axis=1).max()
    with pytest.raises(ValueError, match="broken") as refusal:
        make_whole(system, moved, topology)
    message = str(refusal.value)
    assert f"O of HOH {oxygen.residue.id} and H" in message
    assert f"belong 0.0957 nm apart, but are {distance:.4g} nm apart (2 bonds" in message
    with pytest.raises(ValueError, match=f"atoms {oxygen.index} and "):
        make_whole(system, moved)


def test_bonds_of_the_topology_alone_count_too(peptide):
    """Of a force field whose bonds are expressions."""
    topology, positions, _ = peptide
    system = assembled(len(positions) * [1.0])
    assert np.array_equal(make_whole(system, positions, topology), positions)
    positions = positions.copy()
    positions[0] += 0.5
    assert np.array_equal(make_whole(system, positions), positions)
    with pytest.raises(ValueError, match=r"ACE 1 .*left from another file"):
        make_whole(system, positions, topology)


def test_positions_of_another_shape_are_refused(peptide):
    _, positions, systems = peptide
    with pytest.raises(ValueError, match=rf"\({len(positions)}, 3\).*got \(5, 3\)"):
        make_whole(systems["none"], positions[:5])


@pytest.mark.parametrize("constraints", ["none", "hbonds"])
def test_files_are_read_whole(peptide, tmp_path, constraints):
    """Cut in the middle of a bond between two residues."""
    topology, whole, _ = peptide
    files = ["amber14/protein.ff14SB.xml", "amber14/tip3p.xml"]
    path = tmp_path / "box.pdb"

    def read(positions):
        with path.open("w") as file:
            app.PDBFile.writeFile(topology, positions * unit.nanometer, file)
        return read_box(path, files, constraints)

    system, positions = read(whole).system, read(whole).positions
    carbon, nitrogen = (next(a.index for a in topology.atoms() if (a.residue.name, a.name) == name) for name in BOND)
    cut = wrapped(whole - (whole[carbon] + whole[nitrogen]) / 2, VECTORS)
    assert np.linalg.norm(cut[carbon] - cut[nitrogen]) > 1
    cut = read(cut).positions
    # Coordinates of a PDB file have 1e-4 nm, which changes the energy of each of some hundred bonds by 0.1 kJ/mol.
    assert energy(system, cut) == pytest.approx(energy(system, positions), abs=10)
