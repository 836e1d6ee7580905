"""Rigid bodies: conversion between atoms and bodies, and derived quantities."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from openmm_sier import RigidBodies, RigidityError
from openmm_sier.dynamics import species as species_module
from openmm_sier.dynamics.bodies import BodyState, NotFiniteError
from openmm_sier.dynamics.operators import drift
from openmm_sier.dynamics.species import FIT_TOLERANCE, Species
from tests.support.molecules import GEOMETRIES, scattered, species, thermal_state
from tests.support.oracles import matmul, orthogonality_error, random_attitudes

ALL = list(GEOMETRIES)


def random_state(rng, bodies):
    return thermal_state(rng, bodies, rng.uniform(-5, 5, (3, bodies.n)))


def atoms_of(bodies, state):
    """Positions and velocities (N, 3); particles of no body are NaN."""
    x, v = np.full((2, bodies.n_particles, 3), np.nan)
    return bodies.place(state.q, state.A, x), bodies.move(state, v)


def each_body(bodies):
    """Number, atoms and masses of every body."""
    for kind, numbers in zip(bodies.species, bodies.numbers, strict=True):
        for number, atoms in zip(numbers, kind.atoms, strict=True):
            yield number, atoms, kind.masses


@pytest.fixture
def bodies():
    return scattered(ALL)


# --- geometry ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["water", "handed"])
def test_directions_of_axes_are_those_of_the_atoms(kind, rng):
    """However the atoms are turned: eigenvectors come with signs by chance. Bodies with equal moments are left out."""
    masses, coordinates, _ = GEOMETRIES[kind]
    expected = Species.from_coordinates([range(len(masses))], masses, coordinates).sites
    for turn in np.moveaxis(random_attitudes(rng, 20), 2, 0):
        sites = Species.from_coordinates([range(len(masses))], masses, np.array(coordinates) @ turn).sites
        # A coordinate is known to the rounding of the largest over the difference of moments.
        assert np.abs(sites - expected).max() < 1e-13


@pytest.mark.parametrize("kind", GEOMETRIES)
def test_species_from_coordinates(kind):
    """The frame is principal, right-handed and at the centre of mass, and the shape is kept."""
    masses, coordinates, freedoms = GEOMETRIES[kind]
    result = species(kind, [range(len(masses))])
    sites, masses = result.sites, np.array(masses)
    tensor = np.einsum("k,ak,bk->ab", masses, sites, sites)
    inertia = np.trace(tensor) * np.eye(3) - tensor
    scale = max(result.moments.max(), 1e-300)
    assert np.abs(sites @ masses).max() < 1e-15 * masses.sum()
    assert np.abs(inertia - np.diag(result.moments)).max() < 1e-14 * scale
    assert (np.diff(result.moments) >= -1e-14 * scale).all()
    assert result.dof == freedoms
    assert result.mass == pytest.approx(masses.sum())

    x = np.array(coordinates, dtype=float)
    apart = np.linalg.norm(x[:, None] - x[None], axis=2)
    assert np.abs(np.linalg.norm(sites.T[:, None] - sites.T[None], axis=2) - apart).max() < 1e-15
    if len(masses) > 3:
        handedness = [np.linalg.det(r[1:4] - r[0]) for r in (x, sites.T)]
        assert handedness[0] == pytest.approx(handedness[1], abs=1e-16)


@pytest.mark.parametrize("noise", [0.0, 1e-17, 1e-13])
def test_lines_and_points_have_exact_zeros(rng, noise):
    """Coordinates carry rounding; a moment 1e-13 of the others would make the body spin about its axis."""
    for kind, zeros in (("carbon dioxide", 1), ("pair", 1), ("ion", 3), ("water", 0)):
        masses, coordinates, _ = GEOMETRIES[kind]
        shaken = np.array(coordinates) + noise * rng.normal(size=(len(masses), 3))
        body = Species.from_coordinates([range(len(masses))], masses, shaken)
        assert np.count_nonzero(body.moments == 0) == zeros
        if zeros == 1:
            assert body.moments[1] == pytest.approx(body.moments[2], rel=1e-15)
            assert not body.sites[1:].any()


# --- atoms and bodies -------------------------------------------------------------------------------------------------


def test_positions_there_and_back(rng, bodies):
    state = random_state(rng, bodies)
    x, _ = atoms_of(bodies, state)
    q, A = bodies.fit(x)
    # Positions of 5 nm are rounded to 1e-15 nm, which is 1e-14 of the shortest arm of a body.
    assert np.abs(q - state.q).max() < 1e-14
    assert orthogonality_error(A) < 1e-14
    assert np.linalg.det(A.transpose(2, 0, 1)) == pytest.approx(1)
    flexible = (bodies.moments > 0).all(axis=0)
    assert np.abs(A - state.A)[:, :, flexible].max() < 1e-12
    again = bodies.place(q, A, np.full_like(x, np.nan))
    used = np.isfinite(x)
    assert np.array_equal(used, np.isfinite(again))
    assert np.abs(again - x)[used].max() < 1e-14


def test_sites_follow_the_definition(rng, bodies):
    """r = q + A^T r~, and v = p/m + omega x (r - q), one atom at a time."""
    state = random_state(rng, bodies)
    x, v = atoms_of(bodies, state)
    omega = np.einsum("abn,an,acn,cn->bn", state.A, bodies.inverse_moments, state.A, state.L)
    sites = np.concatenate([np.repeat(s.sites[None], len(s.atoms), axis=0).reshape(-1) for s in bodies.species])
    offset = 0
    for i, atoms, masses in each_body(bodies):
        k = len(atoms)
        local = sites[offset : offset + 3 * k].reshape(3, k)
        offset += 3 * k
        for j, atom in enumerate(atoms):
            arm = state.A[:, :, i].T @ local[:, j]
            assert np.abs(x[atom] - state.q[:, i] - arm).max() < 1e-14
            assert np.abs(v[atom] - state.p[:, i] / masses.sum() - np.cross(omega[:, i], arm)).max() < 1e-12


def test_particles_of_no_body_are_left_alone(rng, bodies):
    state = random_state(rng, bodies)
    x, v = rng.normal(size=(2, bodies.n_particles, 3))
    before = x.copy(), v.copy()
    used = np.concatenate([s.atoms.ravel() for s in bodies.species])
    free = np.setdiff1d(np.arange(bodies.n_particles), used)
    assert free.size == 3
    assert bodies.place(state.q, state.A, x) is x
    assert bodies.move(state, v) is v
    assert np.array_equal(x[free], before[0][free])
    assert np.array_equal(v[free], before[1][free])


def test_momenta_take_the_rigid_part_of_any_velocities(rng, bodies):
    """Momentum and angular momentum are sums over the atoms, for any velocities; the rest is no rigid motion."""
    state = random_state(rng, bodies)
    x, _ = atoms_of(bodies, state)
    v = rng.normal(size=x.shape)
    p, L = bodies.momenta(v, state.A)
    for i, atoms, masses in each_body(bodies):
        arms = x[atoms] - state.q[:, i]
        assert np.abs(p[:, i] - masses @ v[atoms]).max() < 1e-12
        assert np.abs(L[:, i] - np.cross(arms, masses[:, None] * v[atoms]).sum(axis=0)).max() < 1e-12
    rigid = bodies.move(replace(state, p=p, L=L), np.zeros_like(v))
    again = bodies.momenta(v - rigid, state.A)
    assert np.abs(again[0]).max() < 1e-12
    assert np.abs(again[1]).max() < 1e-12


def test_forces_and_torques_are_direct_sums(rng, bodies):
    state = random_state(rng, bodies)
    x, _ = atoms_of(bodies, state)
    forces = rng.normal(size=x.shape) * 1000
    copy = forces.copy()
    F, tau = bodies.forces_and_torques(forces, state.A)
    for i, atoms, _ in each_body(bodies):
        assert np.abs(F[:, i] - forces[atoms].sum(axis=0)).max() < 1e-11
        assert np.abs(tau[:, i] - np.cross(x[atoms] - state.q[:, i], forces[atoms]).sum(axis=0)).max() < 1e-10
    assert np.array_equal(forces, copy)


def test_atoms_in_regular_order_give_the_same_as_scattered_ones(rng):
    """Slices of evenly spaced atoms are a short cut, which must not matter."""
    order = rng.permutation(30)
    regular, irregular = (RigidBodies([species("water", i.reshape(10, 3))], 30) for i in (np.arange(30), order))
    state = random_state(rng, regular)
    x, v = atoms_of(regular, state)
    for one, other in zip((x, v), atoms_of(irregular, state), strict=True):
        assert np.array_equal(one, other[order])
    forces = rng.normal(size=(30, 3))
    shuffled = np.empty_like(forces)
    shuffled[order] = forces
    for one, other in zip(
        regular.forces_and_torques(forces, state.A), irregular.forces_and_torques(shuffled, state.A), strict=True
    ):
        assert np.array_equal(one, other)


# --- observables ------------------------------------------------------------------------------------------------------


def test_kinetic_energy_is_that_of_the_atoms(rng, bodies):
    state = random_state(rng, bodies)
    _, v = atoms_of(bodies, state)
    atoms = sum(0.5 * (masses * (v[atoms] ** 2).sum(axis=1)).sum() for _, atoms, masses in each_body(bodies))
    translation, rotation = bodies.kinetic_energies(state)
    assert translation + rotation == pytest.approx(atoms, rel=1e-13)
    assert bodies.kinetic_energies(replace(state, L=0 * state.L)) == (translation, 0.0)
    assert bodies.kinetic_energies(replace(state, p=0 * state.p)) == (0.0, rotation)


def test_total_momenta_are_those_of_the_atoms(rng, bodies):
    state = random_state(rng, bodies)
    x, v = atoms_of(bodies, state)
    P, J = bodies.total_momenta(state)
    pieces = [(masses[:, None] * v[atoms], x[atoms]) for _, atoms, masses in each_body(bodies)]
    assert np.abs(P - sum(mv.sum(axis=0) for mv, _ in pieces)).max() < 1e-11
    assert np.abs(J - sum(np.cross(r, mv).sum(axis=0) for mv, r in pieces)).max() < 1e-10


# --- fitting ----------------------------------------------------------------------------------------------------------


def test_small_deviations_are_corrected(rng, bodies):
    """Atoms a little out of place: centre of mass and the best attitude."""
    state = random_state(rng, bodies)
    x, _ = atoms_of(bodies, state)
    bent = x + rng.uniform(-1, 1, x.shape) * 0.2 * FIT_TOLERANCE
    q, A = bodies.fit(bent)
    for i, atoms, masses in each_body(bodies):
        assert np.abs(q[:, i] - masses @ bent[atoms] / masses.sum()).max() < 1e-14
    assert orthogonality_error(A) < 1e-14
    mended = bodies.place(q, A, bent.copy())
    used = np.isfinite(x)
    # Within the displacement of the atoms, some of which a body's attitude follows.
    assert np.abs(mended - bent)[used].max() < 2 * 0.2 * FIT_TOLERANCE * np.sqrt(3)

    def squares(attitudes):
        """Mass-weighted misfit of each body, which no small turn of the fitted attitude lowers."""
        places = bodies.place(q, attitudes, np.zeros_like(x))
        return np.array([(m[:, None] * (places[a] - bent[a]) ** 2).sum() for _, a, m in each_body(bodies)])

    best = squares(A)
    for _ in range(20):
        turn = 1e-4 * rng.normal(size=(3, bodies.n))
        nearby = A + np.stack([np.cross(A[:, :, i], turn[:, i]) for i in range(bodies.n)], axis=2)
        # Not orthogonal to 1e-8, which changes the squares by 1e-8 times the misfit.
        assert (squares(nearby) >= best * (1 - 1e-6)).all()


def labelled(bodies):
    """Residue names in the order of particles: the name of the kind and the number of the body in it."""
    labels = ["free"] * bodies.n_particles
    for kind, name in zip(bodies.species, ALL, strict=True):
        for i, atoms in enumerate(kind.atoms):
            for atom in atoms:
                labels[atom] = f"{name} {i}"
    return RigidBodies(bodies.species, bodies.n_particles, labels)


def test_a_misfit_names_the_worst_residue(rng, bodies):
    bodies = labelled(bodies)
    state = random_state(rng, bodies)
    x, _ = atoms_of(bodies, state)
    ring, pair = bodies.species[3].atoms[2], bodies.species[5].atoms[1]
    x[ring[0]] += [0.0, 0.0, 2 * FIT_TOLERANCE]
    x[pair[1]] += 0.6 * (x[pair[1]] - x[pair[0]])
    with pytest.raises(RigidityError) as error:
        bodies.fit(x)
    message = str(error.value)
    assert f"residue pair 1 (atoms {pair[0]}, {pair[1]})" in message
    # The pair is 0.06 nm too long; the lighter atom lies 16/30 of that off its place.
    assert f"is {0.06 * 15.999 / 30.006:.4f} nm off" in message
    assert f"only {FIT_TOLERANCE} nm or less is corrected" in message
    assert "(2 of " in message
    assert "periodic boundary" in message


def test_positions_in_another_unit_are_suspected(rng):
    bodies = scattered(["water", "methane", "ring"])
    x, _ = atoms_of(bodies, random_state(rng, bodies))
    with pytest.raises(RigidityError, match="nanometres"):
        bodies.fit(10 * x)


def test_the_tolerance_bounds_the_misfit(rng):
    """Both atoms of a symmetric pair are as far from their places as the bond is too long, halved."""
    pair = RigidBodies([Species.from_coordinates([[0, 1]], [1.0, 1.0], [[0, 0, 0], [0.1, 0, 0]])], 2)
    for excess, fits in ((0.99, True), (1.01, False)):
        x = np.array([[0, 0, 0], [0, 0.1 + 2 * excess * FIT_TOLERANCE, 0]])
        if fits:
            pair.fit(x)
        else:
            with pytest.raises(RigidityError, match="atoms 0, 1"):
                pair.fit(x)


def test_a_mirror_image_does_not_fit(rng):
    handed = scattered(["handed"], each=1)
    x, _ = atoms_of(handed, random_state(rng, handed))
    with pytest.raises(RigidityError):
        handed.fit(x * [1, 1, -1])


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_positions_that_are_not_finite_are_named(rng, bodies, value):
    bodies = labelled(bodies)
    x, _ = atoms_of(bodies, random_state(rng, bodies))
    methane = bodies.species[2].atoms[3]
    x[methane[4], 1] = value
    with pytest.raises(RigidityError, match=r"residue methane 3 .* not finite"):
        bodies.fit(x)


def test_attitudes_are_kept_to_the_bit_where_they_fit(rng, bodies):
    """Bodies that were moved rigidly, as a barostat does, keep the very attitudes that they had."""
    state = random_state(rng, bodies)
    x, _ = atoms_of(bodies, state)
    moved = bodies.place(state.q * 1.01, state.A, x.copy())
    q, A = bodies.fit(moved, state)
    assert np.array_equal(A, state.A)
    assert np.abs(q - 1.01 * state.q).max() < 1e-14
    turned = matmul(state.A, random_attitudes(rng, bodies.n))
    x = bodies.place(state.q, turned, x)
    flexible = (bodies.moments > 0).all(axis=0)
    assert np.abs(bodies.fit(x, state)[1] - turned)[:, :, flexible].max() < 1e-12


# --- what is refused --------------------------------------------------------------------------------------------------


def test_bodies_that_cannot_be():
    with pytest.raises(ValueError, match="particle 2 "):
        RigidBodies([species("water", [[0, 1, 2], [2, 3, 4]])], 5)
    with pytest.raises(ValueError, match="particle 4 "):
        RigidBodies([species("water", [[0, 1, 4]]), species("water", [[2, 3, 4]])], 5)
    with pytest.raises(ValueError, match="particle 5"):
        RigidBodies([species("water", [[0, 1, 5]])], 5)
    with pytest.raises(ValueError, match="particle -1"):
        RigidBodies([species("water", [[0, -1, 2]])], 5)
    with pytest.raises(ValueError, match="site 2 "):
        Species.from_coordinates([[0, 1, 2]], [16.0, 1.0, 0.0], GEOMETRIES["water"][1])


def test_bodies_are_named(bodies):
    named = labelled(bodies)
    atoms = bodies.species[0].atoms[1]
    assert list(bodies.atoms_of(1)) == list(atoms)
    assert f"atoms {atoms[0]}, {atoms[1]}, {atoms[2]}" in bodies.describe(1)
    assert named.describe(1) == f"residue water 1 (atoms {atoms[0]}, {atoms[1]}, {atoms[2]})"
    ion = bodies.species[6].atoms[0, 0]
    assert named.describe(24) == f"residue ion 0 (atom {ion})"
    assert named.describe_atoms([atoms[0], ion]) == f"residue water 1 and ion 0 (atoms {atoms[0]}, {ion})"
    with pytest.raises(IndexError, match="body 28"):
        bodies.atoms_of(28)


def test_bodies_print_what_they_are():
    """By numbers of atoms; kinds of one number may differ in shape."""
    waters, ion = species("water", [[0, 1, 2], [3, 4, 5]]), species("ion", [[6]])
    assert repr(RigidBodies([waters, ion], 8)) == "<RigidBodies: 2 rigid of 3 atoms, 1 point>"
    chain = [Species.from_coordinates([[6], [7]], [12.0], np.zeros((1, 3)))]
    assert repr(
        RigidBodies([waters, waters.mirrored().of_atoms([[8, 9, 10]]), *chain], 11, None, ([[3, 4]], [0.1]))
    ) == ("<RigidBodies: 3 rigid of 3 atoms (2 kinds), 2 points, 1 constraint between points>")


@pytest.mark.parametrize(
    ("vector", "message"),
    [("force", "the force on .* is not finite"), ("q", "the position of .* is not finite"), ("A", "the position of")],
)
def test_vectors_that_are_not_finite_are_named(rng, bodies, vector, message):
    """An attitude can overflow where the centres do not."""
    state, forces = random_state(rng, bodies), rng.normal(size=(bodies.n_particles, 3))
    if vector == "force":
        forces[bodies.atoms_of(7)[0], 1] = np.nan
    else:
        getattr(state, vector)[..., 2, 7] = np.inf
    convert = bodies.forces_and_torques if vector == "force" else partial(bodies.place, state.q)
    arguments = (forces, state.A) if vector == "force" else (state.A, forces)
    with pytest.raises(NotFiniteError, match=message) as error:
        convert(*arguments)
    assert error.value.body == 7


def test_no_bodies_at_all():
    """As where all particles are fixed."""
    nothing = RigidBodies([], 4)
    assert str(nothing) == "<RigidBodies: none>"
    assert nothing.n == 0
    assert nothing.dof == 0
    q, A = nothing.fit(np.zeros((4, 3)))
    assert q.shape == (3, 0)
    assert A.shape == (3, 3, 0)
    vectors = np.ones((4, 3))
    p, L = nothing.momenta(vectors, A)
    state = drift(nothing)(BodyState(q, p, A, L), 0.001)
    assert np.array_equal(nothing.place(state.q, state.A, vectors.copy()), vectors)
    assert np.array_equal(nothing.move(state, vectors.copy()), vectors)


def test_velocities_carry_moments_that_are_not_those_of_the_masses(rng):
    """A core with massless patches in a plane, whose momenta no masses at these sites could carry."""
    sites = np.array([[0.0, 0.4, -0.2], [0.0, 0.0, 0.3], [0.0, 0.0, 0.0]])
    patchy = Species(np.arange(12).reshape(4, 3), np.array([100.0, 0.0, 0.0]), sites, np.array([9.0, 10.0, 11.0]))
    bodies = RigidBodies([patchy], 12)
    A = random_attitudes(rng, 4)
    state = BodyState(rng.normal(size=(3, 4)), rng.normal(size=(3, 4)), A, rng.normal(size=(3, 4)))
    p, L = bodies.momenta(bodies.move(state, np.zeros((12, 3))), A)
    # Sums of three numbers of the order of 1, and a 3 x 3 system of condition 10.
    assert np.abs(p - state.p).max() < 1e-13
    assert np.abs(L - state.L).max() < 1e-13
    q, turned = bodies.fit(bodies.place(state.q, A, np.zeros((12, 3))))
    assert np.abs(q - state.q).max() < 1e-14
    assert np.abs(turned - A).max() < 1e-13


@pytest.mark.parametrize("moments", [(1.0, 1.0, 2.1), (-0.1, 1.0, 1.0)])
def test_moments_that_no_body_has_are_refused(moments):
    sites = np.array([[0.0, 0.4, -0.2], [0.0, 0.0, 0.3], [0.0, 0.0, 0.0]])
    with pytest.raises(ValueError, match="no body"):
        Species(np.array([[0, 1, 2]]), np.array([100.0, 0.0, 0.0]), sites, np.array(moments))


@pytest.mark.parametrize("shortest", [0.01, 0.05, 0.175])
def test_the_tolerance_of_large_bodies_is_that_of_small_ones(rng, monkeypatch, shortest):
    """Distances that do not matter are not compared."""
    sites = 0.35 * np.array([(i, j, k) for i in range(4) for j in range(4) for k in range(4)], dtype=float)
    sites[1] = sites[0] + [shortest, 0, 0]
    # Two sites at one place need not be distinguished.
    sites = np.concatenate([sites, sites[:1]])
    small, large = (Species.from_coordinates([range(len(sites))], np.ones(len(sites)), sites) for _ in range(2))
    monkeypatch.setattr(species_module, "MOST_COMPARED", len(sites))
    expected = small.tolerance
    monkeypatch.setattr(species_module, "MOST_COMPARED", 3)
    assert large.tolerance == expected == pytest.approx(min(0.02, shortest / 4))
