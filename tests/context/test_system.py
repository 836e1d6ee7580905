"""Rigid bodies found in the constraints of an OpenMM System, and the Systems that are refused."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from openmm import app, unit

from openmm_sier import RigidBodies, RigidityError
from openmm_sier.context.find_bodies import find_bodies

OH, HH = 0.09572, 0.15139
WATER = ((15.999, 1.008, 1.008), {(0, 1): OH, (0, 2): OH, (1, 2): HH})


def system_of(*molecules):
    """A System of molecules (masses, {pair: constraint length}), with indices from the molecule's first particle."""
    system = openmm.System()
    for masses, constraints in molecules:
        start = find_bodies.getNumParticles()
        for mass in masses:
            find_bodies.addParticle(mass)
        for (a, b), length in constraints.items():
            find_bodies.addConstraint(start + a, start + b, length)
    return system


def topology_of(*residues):
    """A topology of residues (name, number of atoms), numbered from 1."""
    topology = app.Topology()
    chain = topology.addChain()
    for number, (name, k) in enumerate(residues, 1):
        residue = topology.addResidue(name, chain, str(number))
        for i in range(k):
            topology.addAtom(f"X{i}", app.element.hydrogen, residue)
    return topology


def lists(bodies):
    """The atoms of every body."""
    return [list(map(int, bodies.atoms_of(i))) for i in range(bodies.n)]


def lengths_in(species):
    """Distances between all sites of a species."""
    sites = species.sites.T
    return np.linalg.norm(sites[:, None] - sites[None], axis=2)


# --- what is found ----------------------------------------------------------------------------------------------------


def test_water_takes_its_geometry_from_the_constraints():
    bodies = find_bodies(system_of(WATER, WATER))
    assert lists(bodies) == [[0, 1, 2], [3, 4, 5]]
    (species,) = bodies.species
    found = lengths_in(species)
    assert found[0, 1] == pytest.approx(OH, abs=1e-15)
    assert found[0, 2] == pytest.approx(OH, abs=1e-15)
    assert found[1, 2] == pytest.approx(HH, abs=1e-15)
    assert np.allclose(bodies.masses, 18.015)
    # About the symmetry axis only the hydrogens turn, at half their distance.
    assert np.isclose(species.moments, 2 * 1.008 * (HH / 2) ** 2, rtol=1e-14).any()
    assert species.moments[0] + species.moments[1] == pytest.approx(species.moments[2], rel=1e-14)
    assert bodies.dof == 12


@pytest.mark.parametrize(
    ("field", "model", "sites"), [("tip3p.xml", "tip3p", 3), ("tip4pew.xml", "tip4pew", 4), ("tip5p.xml", "tip5p", 5)]
)
def test_water_models_of_openmm(field, model, sites):
    """Virtual sites belong to no body; all molecules are of one species whose moments are those of the atoms."""
    forcefield = app.ForceField(field)
    modeller = app.Modeller(app.Topology(), [] * unit.nanometer)
    modeller.addSolvent(forcefield, model=model, numAdded=8)
    system = forcefield.createSystem(modeller.topology)
    bodies = RigidBodies.from_system(system, modeller.topology)
    n = modeller.topology.getNumResidues()
    assert n == 8
    assert lists(bodies) == [[sites * i, sites * i + 1, sites * i + 2] for i in range(n)]
    assert len(bodies.species) == 1
    assert bodies.n_particles == sites * n
    assert bodies.dof == 6 * n

    x = np.array(modeller.positions.value_in_unit(unit.nanometer))
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(modeller.positions)
    context.applyConstraints(1e-10)
    x = context.getState(positions=True).getPositions(asNumpy=True).value_in_unit(unit.nanometer)
    q, A = bodies.fit(x)
    # SETTLE works with lengths rounded to single precision, some 1e-9 nm.
    massive = np.concatenate([s.atoms.ravel() for s in bodies.species])
    assert np.abs(bodies.place(q, A, x.copy()) - x)[massive].max() < 1e-8


def test_two_atoms_are_a_line():
    bodies = find_bodies(system_of(((14.0, 16.0), {(0, 1): 0.115})))
    (species,) = bodies.species
    reduced = 14.0 * 16.0 / 30.0
    assert species.moments[0] == 0
    assert species.moments[1:] == pytest.approx([reduced * 0.115**2] * 2, rel=1e-14)
    assert bodies.dof == 5


def test_three_atoms_in_a_row_are_a_line():
    bodies = find_bodies(system_of(((16.0, 12.0, 16.0), {(0, 1): 0.116, (1, 2): 0.116, (0, 2): 0.232})))
    (species,) = bodies.species
    assert species.moments[0] == 0
    assert species.moments[1:] == pytest.approx([2 * 16.0 * 0.116**2] * 2, rel=1e-12)
    assert bodies.dof == 5


def test_particles_in_a_row_to_the_digits_of_a_force_field():
    """Lengths rounded to 1e-6 nm that can be no triangle are a line."""
    bodies = find_bodies(system_of(((16.0, 12.0, 16.0), {(0, 1): 0.115997, (1, 2): 0.115997, (0, 2): 0.231995})))
    assert bodies.dof == 5


def test_ions_unconstrained_atoms_and_fixed_particles():
    """Atoms of no constraint are points; a massless particle is of no body."""
    ion, fixed, free = ((22.99,), {}), ((0.0,), {}), ((12.0, 1.0), {})
    bodies = find_bodies(system_of(ion, WATER, fixed, free, WATER, ion))
    assert sorted(lists(bodies)) == [[0], [1, 2, 3], [5], [6], [7, 8, 9], [10]]
    assert len(bodies.species) == 4
    assert bodies.dof == 2 * 6 + 4 * 3
    assert bodies.n_particles == 11
    assert all(not species.moments.any() for species in bodies.species if len(species.masses) == 1)


def test_virtual_sites_outside_bodies():
    system = system_of(((12.0, 1.0, 0.0), {}))
    find_bodies.setVirtualSite(2, openmm.TwoParticleAverageSite(0, 1, 0.5, 0.5))
    assert sorted(lists(find_bodies(system))) == [[0], [1]]


def test_molecules_of_other_masses_or_lengths_are_other_species():
    heavy = ((15.999, 2.014, 2.014), WATER[1])
    wide = (WATER[0], {**WATER[1], (1, 2): 0.16})
    bodies = find_bodies(system_of(WATER, heavy, wide, WATER))
    assert sorted(len(species.atoms) for species in bodies.species) == [1, 1, 2]


def test_order_of_atoms_and_constraints_does_not_matter():
    """Hydrogens first, pairs in either direction, molecules interleaved."""
    system = openmm.System()
    for mass in (1.008, 1.008, 1.008, 15.999, 15.999, 1.008):
        find_bodies.addParticle(mass)
    for a, b, length in ((3, 0, OH), (2, 0, HH), (2, 3, OH), (1, 4, OH), (5, 4, OH), (5, 1, HH)):
        find_bodies.addConstraint(a, b, length)
    bodies = find_bodies(system)
    assert sorted(lists(bodies)) == [[0, 2, 3], [1, 4, 5]]
    reference = find_bodies(system_of(WATER)).species[0].moments
    for species in bodies.species:
        assert np.allclose(species.moments, reference, rtol=1e-13)


def test_a_larger_rigid_molecule(rng):
    """Twelve atoms held by all of their 66 distances."""
    x = rng.normal(scale=0.2, size=(12, 3))
    apart = np.linalg.norm(x[:, None] - x[None], axis=2)
    pairs = {(i, j): apart[i, j] for i in range(12) for j in range(i)}
    system = system_of((rng.uniform(1, 30, 12), pairs))
    bodies = find_bodies(system, positions=x)
    q, A = bodies.fit(x)
    assert np.abs(bodies.place(q, A, np.zeros((12, 3))) - x).max() < 1e-13


def test_either_hand_of_a_molecule(rng):
    """Distances do not tell a molecule from its mirror image, positions do."""
    x = rng.normal(scale=0.1, size=(4, 3))
    apart = np.linalg.norm(x[:, None] - x[None], axis=2)
    molecule = ((12.0, 1.0, 35.0, 80.0), {(i, j): apart[i, j] for i in range(4) for j in range(i)})
    system = system_of(molecule, molecule, molecule)
    both = np.concatenate([x, x * [1, 1, -1] + 1, x - 1])
    bodies = find_bodies(system, positions=both * unit.nanometer)
    q, A = bodies.fit(both)
    assert np.linalg.det(A.transpose(2, 0, 1)) == pytest.approx(1)
    assert np.abs(bodies.place(q, A, np.zeros((12, 3))) - both).max() < 1e-13
    with pytest.raises(RigidityError, match="give positions"):
        find_bodies(system)


def test_an_empty_system():
    assert find_bodies(openmm.System()).n == 0


# --- what is refused --------------------------------------------------------------------------------------------------


def test_constrained_but_not_rigid():
    """As with constraints=HBonds: hydrogens on one heavy atom."""
    methyl = ((12.011, 1.008, 1.008, 1.008), {(0, 1): 0.109, (0, 2): 0.109, (0, 3): 0.109})
    with pytest.raises(RigidityError) as error:
        find_bodies(system_of(WATER, methyl), topology_of(("HOH", 3), ("CH3", 4)))
    message = str(error.value)
    assert message.startswith("residue CH3 2 (atoms 3, 4, 5, 6) is constrained but not rigid")
    assert "3 of its 6 distances are free, the first between atoms 4 and 5" in message
    assert "rigidWater=True and constraints=None" in message


def test_a_constraint_between_two_molecules():
    system = system_of(WATER, WATER)
    find_bodies.addConstraint(0, 3, 0.3)
    with pytest.raises(RigidityError) as error:
        find_bodies(system, topology_of(("HOH", 3), ("HOH", 3)))
    message = str(error.value)
    assert message.startswith("residue HOH 1 and HOH 2 (atoms 0, 1, 2, 3, 4, 5) is constrained but not rigid")
    assert "8 of its 15 distances are free" in message
    assert "none to other atoms" in message


def test_a_massless_particle_that_is_constrained():
    with pytest.raises(RigidityError, match=r"atoms 0, 1, 2.*: atom 1 is constrained but has no mass.*virtual site"):
        find_bodies(system_of(((15.999, 0.0, 1.008), WATER[1])))


def test_contradictory_lengths():
    impossible = (WATER[0], {(0, 1): 0.1, (0, 2): 0.1, (1, 2): 0.25})
    with pytest.raises(RigidityError) as error:
        find_bodies(system_of(WATER, impossible), topology_of(("HOH", 3), ("BAD", 3)))
    message = str(error.value)
    assert "the constraints of residue BAD 2 (atoms 3, 4, 5) contradict each other" in message
    assert "0.1000, 0.1000, 0.2500 nm" in message
    assert "misses by" in message


def test_lengths_that_need_a_fourth_dimension():
    """Six distances of which every triangle closes and the tetrahedron does not."""
    pairs = {(0, 1): 0.1, (0, 2): 0.1, (1, 2): 0.1, (0, 3): 0.055, (1, 3): 0.055, (2, 3): 0.055}
    with pytest.raises(RigidityError, match="contradict each other"):
        find_bodies(system_of((4 * (12.0,), pairs)))


def test_without_a_topology_atoms_are_named():
    with pytest.raises(RigidityError, match="atoms 3, 4, 5, 6"):
        find_bodies(system_of(WATER, (4 * (1.0,), {(0, 1): 0.1, (1, 2): 0.1, (2, 3): 0.1})))


def test_a_topology_of_another_system():
    with pytest.raises(ValueError, match="the topology has 4 atoms, the System 3 particles"):
        find_bodies(system_of(WATER), topology_of(("HOH", 4)))


def test_contradictions_between_repeated_constraints():
    """The same pair constrained twice, to other lengths."""
    system = system_of(WATER)
    find_bodies.addConstraint(1, 0, OH + 0.01)
    with pytest.raises(RigidityError, match="atoms 0 and 1"):
        find_bodies(system)
