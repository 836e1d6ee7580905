"""Rigid bodies found in the constraints of an OpenMM System, and the Systems that are refused."""

from itertools import combinations

import numpy as np
import openmm
import pytest
from openmm import app, unit
from scipy.spatial.transform import Rotation

from openmm_sier import RigidBodies, RigidityError, select_bodies
from openmm_sier.system import geometries
from tests.support import methanols
from tests.support.hydrogen_groups import hydrogen_groups
from tests.support.silence import silence
from tests.support.systems import assembled

OH, HH = 0.09572, 0.15139
WATER = ((15.999, 1.008, 1.008), {(0, 1): OH, (0, 2): OH, (1, 2): HH})


def system_of(*molecules):
    """A System of molecules (masses, {pair: constraint length}), with indices from the molecule's first particle."""
    system = openmm.System()
    for masses, constraints in molecules:
        start = system.getNumParticles()
        for mass in masses:
            system.addParticle(mass)
        for (a, b), length in constraints.items():
            system.addConstraint(start + a, start + b, length)
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
    bodies = RigidBodies.from_system(system_of(WATER, WATER))
    assert lists(bodies) == [[0, 1, 2], [3, 4, 5]]
    (species,) = bodies.species
    lengths = lengths_in(species)
    assert lengths[0, 1] == pytest.approx(OH, abs=1e-15)
    assert lengths[0, 2] == pytest.approx(OH, abs=1e-15)
    assert lengths[1, 2] == pytest.approx(HH, abs=1e-15)
    assert np.allclose(bodies.masses, 18.015)
    # About the symmetry axis only the hydrogens turn, at half their distance.
    assert np.isclose(species.moments, 2 * 1.008 * (HH / 2) ** 2, rtol=1e-14).any()
    assert species.moments[0] + species.moments[1] == pytest.approx(species.moments[2], rel=1e-14)
    assert bodies.dof == 12


# The second to the digits of a force field: lengths rounded to 1e-6 nm that can be no triangle are a line.
@pytest.mark.parametrize(("bond", "ends"), [(0.116, 0.232), (0.115997, 0.231995)])
def test_three_atoms_in_a_row_are_a_line(bond, ends):
    bodies = RigidBodies.from_system(system_of(((16.0, 12.0, 16.0), {(0, 1): bond, (1, 2): bond, (0, 2): ends})))
    (species,) = bodies.species
    assert species.moments[0] == 0
    assert species.moments[1:] == pytest.approx([2 * 16.0 * bond**2] * 2, rel=1e-5)
    assert bodies.dof == 5


def test_ions_unconstrained_atoms_and_fixed_particles():
    """Atoms of no constraint are points; a massless particle is of no body."""
    ion, fixed, free = ((22.99,), {}), ((0.0,), {}), ((12.0, 1.0), {})
    bodies = RigidBodies.from_system(system_of(ion, WATER, fixed, free, WATER, ion))
    assert sorted(lists(bodies)) == [[0], [1, 2, 3], [5], [6], [7, 8, 9], [10]]
    assert len(bodies.species) == 4
    assert bodies.dof == 2 * 6 + 4 * 3
    assert bodies.n_particles == 11
    assert all(not species.moments.any() for species in bodies.species if len(species.masses) == 1)


def test_constrained_atoms_of_molecules_that_are_not_rigid_are_points():
    """As with constraints=HBonds: hydrogens on one heavy atom, a pair bonded to another atom, and a free pair."""
    methyl = ((12.011, 1.008, 1.008, 1.008), {(0, 1): 0.109, (0, 2): 0.109, (0, 3): 0.109})
    pair = ((16.0, 1.008), {(0, 1): 0.096})
    system = system_of(WATER, methyl, pair, pair)
    bond = openmm.HarmonicBondForce()
    bond.addBond(3, 7, 0.14, 3e5)
    system.addForce(bond)
    bodies = RigidBodies.from_system(system)
    assert sorted(lists(bodies)) == [[0, 1, 2], [3], [4], [5], [6], [7], [8], [9, 10]]
    joined = sorted(sorted(int(bodies.atoms_of(i)[0]) for i in pair) for pair in bodies.constraints.pairs)
    assert joined == [[3, 4], [3, 5], [3, 6], [7, 8]]
    assert bodies.dof == 6 + (6 * 3 - 4) + 5
    # The methyl group and the pair are one molecule.
    assert sorted(int(bodies.atoms_of(i)[0]) for i in np.flatnonzero(bodies.flexible)) == [3, 4, 5, 6, 7, 8]


def test_a_constraint_between_two_molecules_makes_points_of_both():
    system = system_of(WATER, WATER)
    system.addConstraint(0, 3, 0.3)
    bodies = RigidBodies.from_system(system)
    assert lists(bodies) == [[0], [1], [2], [3], [4], [5]]
    assert bodies.dof == 18 - 7
    assert len(set(bodies.molecules)) == 1


def test_restraints_leave_rigid_molecules_rigid():
    system = system_of(WATER, WATER)
    restraint = openmm.CustomBondForce("100*(r-0.3)^2")
    restraint.addBond(0, 3)
    system.addForce(restraint)
    assert lists(RigidBodies.from_system(system)) == [[0, 1, 2], [3, 4, 5]]


def test_virtual_sites_outside_bodies():
    system = system_of(((12.0, 1.0, 0.0), {}))
    system.setVirtualSite(2, openmm.TwoParticleAverageSite(0, 1, 0.5, 0.5))
    assert sorted(lists(RigidBodies.from_system(system))) == [[0], [1]]


def test_molecules_of_other_masses_or_lengths_are_other_species():
    heavy = ((15.999, 2.014, 2.014), WATER[1])
    wide = (WATER[0], {**WATER[1], (1, 2): 0.16})
    bodies = RigidBodies.from_system(system_of(WATER, heavy, wide, WATER))
    assert sorted(len(species.atoms) for species in bodies.species) == [1, 1, 2]


def test_order_of_atoms_and_constraints_does_not_matter():
    """Hydrogens first, pairs in either direction, molecules interleaved."""
    held = ((3, 0, OH), (2, 0, HH), (2, 3, OH), (1, 4, OH), (5, 4, OH), (5, 1, HH))
    system = assembled((1.008, 1.008, 1.008, 15.999, 15.999, 1.008), constraints=held)
    bodies = RigidBodies.from_system(system)
    assert sorted(lists(bodies)) == [[0, 2, 3], [1, 4, 5]]
    reference = RigidBodies.from_system(system_of(WATER)).species[0].moments
    for species in bodies.species:
        assert np.allclose(species.moments, reference, rtol=1e-13)


def test_an_empty_system():
    assert RigidBodies.from_system(openmm.System()).n == 0


# --- what is refused --------------------------------------------------------------------------------------------------


def test_a_constraint_between_a_named_body_and_another_atom():
    system = system_of(WATER, WATER)
    system.addConstraint(0, 3, 0.3)
    with pytest.raises(RigidityError, match=r"atoms 0 and 3 .*out of `bod"):
        RigidBodies.from_system(system, rigid=[[0, 1, 2]])


#: Every triangle closes and the tetrahedron does not.
FOURTH_DIMENSION = {(0, 1): 0.1, (0, 2): 0.1, (1, 2): 0.1, (0, 3): 0.055, (1, 3): 0.055, (2, 3): 0.055}


IMPOSSIBLE = (WATER[0], {(0, 1): 0.1, (0, 2): 0.1, (1, 2): 0.25})


@pytest.mark.parametrize(
    ("molecule", "topology", "message"),
    [
        ((4 * (12.0,), FOURTH_DIMENSION), None, "contradict each other"),
        (WATER, topology_of(("HOH", 4)), "the topology has 4 atoms, but the System has 3 particles"),
        (
            IMPOSSIBLE,
            topology_of(("BAD", 3)),
            r"residue BAD 1 \(atoms 0, 1, 2\) contradict each other.*0.1000, 0.1000, 0.2500 nm.*is off by",
        ),
    ],
)
def test_systems_that_are_refused(molecule, topology, message):
    with pytest.raises(ValueError, match=message):
        RigidBodies.from_system(system_of(molecule), topology)


# --- one geometry for each kind ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("constrained", "digit"),
    [(True, methanols.DIGIT), (False, methanols.DIGIT), (False, 10 * methanols.DIGIT)],
    ids=["constrained", "named", "with fewer digits"],
)
def test_molecules_of_a_pdb_file_are_of_one_species(constrained, digit):
    """Rounded coordinates give 124 sets of constraint lengths; their mean is that of no rounding.

    A GRO file has fewer digits.
    """
    positions, topology = methanols.positions_of(125, digit=digit), methanols.topology_of(125)
    pairs = list(combinations(range(6), 2)) if constrained else []
    system = methanols.system_of(125, pairs, positions)
    rigid = None if constrained else select_bodies(topology, "MOH")
    tolerance = None if digit == methanols.DIGIT else 0.002
    with silence():
        bodies = RigidBodies.from_system(system, topology, rigid, positions, tolerance)
    (species,) = bodies.species
    exact = np.linalg.norm(methanols.GEOMETRY[:, None] - methanols.GEOMETRY[None], axis=2)
    # Rounding has a standard deviation of digit/sqrt(12) a coordinate, so a mean of 125 lengths one of 0.04 digits.
    assert np.abs(lengths_in(species) - exact).max() < 0.2 * digit
    _, _, misfit = bodies.fit_with_misfit(positions)
    assert misfit.max() < np.sqrt(3) * digit
    # Rounding moves an atom by up to sqrt(3)/2 digits, in many atoms by nearly as much.
    assert 0.5 * digit < bodies.moved < 2 * digit
    assert f"{bodies.moved:.1g} nm" in repr(bodies)


def test_shapes_rounded_in_a_gro_file_are_not_averaged_without_a_word():
    positions, topology = methanols.positions_of(125, digit=0.001), methanols.topology_of(125)
    system = methanols.system_of(125)
    rigid = select_bodies(topology, "MOH")
    with pytest.warns(UserWarning, match=r"125 bodies like residue MOH 1 .*tolerance=0\.002"):
        bodies = RigidBodies.from_system(system, topology, rigid, positions)
    # The mean of two bodies is no more than the tolerance from both.
    assert bodies.fit_with_misfit(positions)[2].max() < 2.01e-4
    with silence():
        RigidBodies.from_system(system, topology, rigid, positions, tolerance=0)


def named(*shapes):
    """A System of bodies with atoms of 12 dalton, their particles and positions."""
    k = len(shapes[0])
    positions = np.concatenate([np.add(shape, [0, 2 * i, 0]) for i, shape in enumerate(shapes)])
    return system_of(*[(k * (12.0,), {})] * len(shapes)), np.arange(len(positions)).reshape(-1, k), positions


@pytest.mark.parametrize(
    ("tolerance", "kinds"), [(0, 4), (None, 3), (0.0006, 2), (0.002, 1), (6e-4 * unit.nanometer, 2)], ids=str
)
def test_sizes_are_averaged_up_to_a_tolerance(tolerance, kinds):
    """Each atom moves by half the difference of a length from the mean."""
    lengths = np.array([0.2, 0.2001, 0.201, 0.203])
    system, rigid, positions = named(*([[0, 0, 0], [length, 0, 0]] for length in lengths))
    if tolerance is None:
        with pytest.warns(UserWarning, match=r"3 shapes, .*0\.0015 nm"):
            bodies = RigidBodies.from_system(system, None, rigid, positions)
    else:
        with silence():
            bodies = RigidBodies.from_system(system, None, rigid, positions, tolerance)
    assert len(bodies.species) == kinds
    for species in bodies.species:
        assert lengths_in(species)[0, 1] == pytest.approx(lengths[species.atoms[:, 0] // 2].mean(), abs=1e-12)
    assert (bodies.moved < 1e-12) == (tolerance == 0)


@pytest.mark.parametrize("height", [0.11, 0.003, 0.0005])
def test_mirror_images_are_different(height):
    shape = np.array([[0, 0, 0], [0.15, 0, 0], [0, 0.13, 0], [0.02, 0.05, height]])
    mirror = shape * [1, 1, -1]
    system, rigid, positions = named(shape, mirror, shape, mirror)
    bodies = RigidBodies.from_system(system, None, rigid, positions, tolerance=1e-4)
    assert [sorted(species.atoms[:, 0]) for species in bodies.species] == [[0, 8], [4, 12]]
    assert bodies.fit_with_misfit(positions)[2].max() < 1e-12


def test_a_negative_tolerance_is_refused():
    with pytest.raises(ValueError, match=r"tolerance .*-1 nm"):
        RigidBodies.from_system(system_of(WATER), tolerance=-1)


def test_as_many_kinds_as_bodies_take_a_time_proportional_to_their_number(monkeypatch):
    """Each body is superimposed on a few others, not on all."""
    superimposed = []

    def counted(kind, shape, arms):
        superimposed.append(len(arms))
        return placed(kind, shape, arms)

    placed = geometries._placed
    monkeypatch.setattr(geometries, "_placed", counted)
    for spread in (0.01, 1e-4):
        lengths = 0.2 + spread * np.arange(200)
        system, rigid, positions = named(*([[0, 0, 0], [length, 0, 0]] for length in lengths))
        superimposed.clear()
        RigidBodies.from_system(system, None, rigid, positions, tolerance=2e-4)
        # With the smaller spread some 17 are near the first of a group of 8: three times in search of it, once more
        # for its mean.
        assert sum(superimposed) < 200 * (1 if spread == 0.01 else 12) + 1


def test_equal_molecules_share_a_geometry_in_silence():
    """Rounding of lengths that are computed from double precision, and lengths that are the same."""
    positions = methanols.positions_of(8, digit=None)
    system = methanols.system_of(8, list(combinations(range(6), 2)), positions)
    with silence():
        assert len(RigidBodies.from_system(system, positions=positions).species) == 1
        assert len(RigidBodies.from_system(system_of(WATER, WATER)).species) == 1
        named = RigidBodies.from_system(methanols.system_of(8), rigid=np.arange(48).reshape(8, 6), positions=positions)
    assert len(named.species) == 1


def test_constraint_lengths_of_two_types_are_two_species():
    """Bonds of force fields differ by 1e-3 nm, more than by the rounding in a PDB file."""
    pairs = [((12.0, 1.0), {(0, 1): length}) for length in (0.109, 0.108, 0.1093, 0.109)]
    bodies = RigidBodies.from_system(system_of(*pairs))
    assert sorted(len(species.atoms) for species in bodies.species) == [1, 3]
    (three,) = [species for species in bodies.species if len(species.atoms) == 3]
    assert lengths_in(three)[0, 1] == pytest.approx((2 * 0.109 + 0.1093) / 3, abs=1e-15)


def test_conformations_are_species_of_their_own(rng):
    """A hydroxyl group turned by 20 degrees makes another body, whatever the order of the molecules."""
    axis = methanols.GEOMETRY[4]
    turned = methanols.GEOMETRY.copy()
    turned[5] = axis + Rotation.from_rotvec([np.radians(20), 0, 0]).apply(turned[5] - axis)
    kinds = rng.integers(0, 2, 30)
    parts = [methanols.positions_of(1, turned if kind else methanols.GEOMETRY, seed) for seed, kind in enumerate(kinds)]
    positions = np.concatenate([x + np.array([0.5 * i, 0, 0]) for i, x in enumerate(parts)])
    with silence():
        bodies = RigidBodies.from_system(
            methanols.system_of(30), rigid=np.arange(180).reshape(30, 6), positions=positions
        )
    results = {tuple(sorted(species.atoms[:, 0] // 6)) for species in bodies.species}
    assert results == {tuple(np.flatnonzero(kinds == kind)) for kind in (0, 1)}


# --- bodies within molecules ------------------------------------------------------------------------------------------

X_H = [(0, 1), (0, 2), (0, 3), (4, 5)]


@pytest.mark.parametrize("pairs", [[], X_H], ids=["no constraints", "HBonds"])
def test_each_heavy_atom_with_its_hydrogens_is_a_body(pairs):
    positions, topology = methanols.positions_of(20), methanols.topology_of(20)
    system = methanols.system_of(20, pairs, positions)
    with silence():
        bodies = RigidBodies.from_system(system, topology, hydrogen_groups(topology), positions * unit.nanometer)
    results = sorted(lists(bodies))
    assert results == sorted([[6 * i + a for a in group] for i in range(20) for group in ([0, 1, 2, 3], [4, 5])])
    assert len(bodies.species) == 2
    assert bodies.dof == 20 * (6 + 5)
    _, _, misfit = bodies.fit_with_misfit(positions)
    assert misfit.max() < np.sqrt(3) * methanols.DIGIT


def test_groups_satisfy_the_constraints_inside_them():
    """From positions of a force field with C-H of 0.109 nm, constraints of one with 0.111 nm."""
    longer = methanols.GEOMETRY * 0.111 / np.linalg.norm(methanols.GEOMETRY[1])
    constraints = methanols.positions_of(4, longer, digit=None)
    positions, topology = methanols.positions_of(4), methanols.topology_of(4)
    bodies = RigidBodies.from_system(
        methanols.system_of(4, X_H, constraints), topology, hydrogen_groups(topology), positions
    )
    methyl = next(species for species in bodies.species if len(species.masses) == 4)
    assert np.abs(lengths_in(methyl)[0, 1:] - 0.111).max() < 1e-12
    # H-H is free: the projection moves hydrogens along their bonds by 0.002 nm, and H-H by sqrt(8/3) of that.
    assert lengths_in(methyl)[1, 2] == pytest.approx(np.sqrt(8 / 3) * 0.111, abs=1e-3)


def test_constraints_between_groups_are_refused():
    positions, topology = methanols.positions_of(2), methanols.topology_of(2)
    system = methanols.system_of(2, [*X_H, (0, 4)], positions)
    with pytest.raises(RigidityError, match=r"atoms 0 and 4 .*constraints=None or HBonds"):
        RigidBodies.from_system(system, topology, hydrogen_groups(topology), positions)


def test_bodies_keep_the_order_of_the_lists():
    """Then come those that constraints form, then points, whatever their kinds."""
    triangle, line = np.array([[0, 0, 0], [0.2, 0, 0], [0.05, 0.18, 0]]), np.array([[0, 0, 0], [0.2, 0, 0]])
    system, positions, named = openmm.System(), [], []
    for mass in (39.0, 23.0):
        system.addParticle(mass)
        positions.append(np.zeros((1, 3)))
    for k, shape in enumerate((triangle, line, triangle, line)):
        named.append([system.addParticle(12.0) for _ in shape])
        positions.append(np.add(shape, [k, 0, 0]))
    for k in range(2):
        pair = [system.addParticle(mass) for mass in (1.0 + k, 1.0)]
        system.addConstraint(*pair, 0.2)
        positions.append(np.add(line, [k, 1, 0]))
    system.addParticle(39.0)
    positions.append(np.zeros((1, 3)))
    named = named[::-1]
    x = np.concatenate(positions)
    bodies = RigidBodies.from_system(system, rigid=named, positions=x)
    expected = [*named, [12, 13], [14, 15], [0], [1], [16]]
    assert lists(bodies) == expected
    assert bodies.masses.tolist() == [24, 36, 24, 36, 2, 3, 39, 23, 39]
    q, _ = bodies.fit(x)
    for number, atoms in enumerate(expected):
        assert (bodies.owners[atoms] == number).all()
        masses = np.array([system.getParticleMass(i)._value for i in atoms])
        np.testing.assert_allclose(q[:, number], masses @ x[atoms] / masses.sum(), rtol=0, atol=1e-14)
