"""Types of bodies: shapes that are given once, and bodies of a System that have them."""

import numpy as np
import openmm
import pytest
from openmm import app, unit
from scipy.spatial.transform import Rotation

from openmm_sier import BodyType, RigidBodies, RigidityError, add_bodies
from tests.support.types import PATCHY, TOP, built, typed

SPHERE = [10.0, 10.0, 10.0]


def test_moments_and_axes_are_those_of_the_masses():
    arms = TOP.positions - TOP.centre
    tensor = np.diag(TOP.principal_moments)
    in_frame = TOP.axes.T @ tensor @ TOP.axes
    expected = sum(m * (r @ r * np.eye(3) - np.outer(r, r)) for m, r in zip(TOP.masses, arms, strict=True))
    np.testing.assert_allclose(in_frame, expected, rtol=0, atol=1e-14)
    np.testing.assert_allclose(np.cross(TOP.axes[0], TOP.axes[1]), TOP.axes[2], rtol=0, atol=1e-15)
    assert TOP.mass == 61.0
    assert TOP.dof == 6


def test_moments_are_given_about_axes_or_as_a_tensor():
    assert PATCHY.principal_moments.tolist() == [2.0, 2.1, 2.2]
    turn = Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix()
    turned = BodyType("turned", PATCHY.positions @ turn.T, PATCHY.masses, turn @ np.diag([2, 2.2, 2.1]) @ turn.T)
    np.testing.assert_allclose(turned.principal_moments, [2.0, 2.1, 2.2], rtol=1e-14)
    # The axes of both are the same ones of the body, up to their signs.
    np.testing.assert_allclose(np.abs(turned.axes @ turn @ PATCHY.axes.T), np.eye(3), rtol=0, atol=1e-13)


def test_units():
    angstrom = BodyType(
        "patchy",
        10 * PATCHY.positions * unit.angstrom,
        PATCHY.masses * unit.dalton,
        100 * PATCHY.moments * unit.dalton * unit.angstrom**2,
    )
    np.testing.assert_allclose(angstrom.positions, PATCHY.positions, rtol=1e-15)
    np.testing.assert_allclose(angstrom.principal_moments, PATCHY.principal_moments, rtol=1e-14)


def test_lines_and_points():
    assert BodyType("rod", [[-0.2, 0, 0], [0, 0, 0], [0.2, 0, 0]], [12, 16, 12]).dof == 5
    assert BodyType("rod", [[-0.2, 0, 0], [0, 0, 0], [0.2, 0, 0]], [0, 16, 0], [0, 1, 1]).dof == 5
    assert BodyType("bead", [[1, 2, 3]], [12]).dof == 3


@pytest.mark.parametrize(
    ("positions", "masses", "moments", "message"),
    [
        ([[0, 0, 0]], [0], None, "needs a site with a mass"),
        ([[0, 0, 0], [1, 0, 0]], [1, -1], None, "none with a negative one"),
        (
            [[0, 0, 0], [1, 0, 0]],
            [1, 0],
            None,
            "site 1 is off an axis about which.*no moment.*give moments",
        ),
        ([[0, 0, 0], [1, 0, 0]], [1, 0], SPHERE, "sites lie on a line.*may be massless"),
        ([[0, 0, 0]], [1], SPHERE, "sites lie on a line"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [1, 0, 0], [1, 1, 3], "largest at most the sum of the others"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [1, 0, 0], [-1, 1, 1], "must not be negative"),
        ([[0, 0, 0], [0, 1, 0]], [1, 0], [0, 1, 1], "site 1 is off an axis"),
        ([[0, 0, 0], [0, 1, 0], [0, 0, 0]], [1, 0, 0], SPHERE, "sites 0 and 2 .* are at one place"),
        ([[0, 0, 0], [0, 1, 0]], [1, 1, 1], None, r"positions \(k, 3\) and masses \(k,\)"),
        ([[0, 0, 0], [0, 1, 0]], [1, 1], [1, 2], "three moments, or a symmetric tensor"),
        ([[0, 0, 0], [0, np.nan, 0]], [1, 1], None, "positions of the body type 'x' must be finite"),
    ],
)
def test_types_that_cannot_be(positions, masses, moments, message):
    with pytest.raises(ValueError, match=message):
        BodyType("x", positions, masses, moments)


def test_arguments_of_other_types():
    with pytest.raises(TypeError, match="name of a body type"):
        BodyType("", [[0, 0, 0]], [1])
    with pytest.raises(TypeError, match="units like nm"):
        BodyType("x", [[0, 0, 0]] * unit.kelvin, [1])
    with pytest.raises(TypeError, match="dalton"):
        BodyType("x", [[0, 0, 0]], ["heavy"])


def test_added_bodies_have_their_centres_and_orientations(rng):
    system, topology = openmm.System(), app.Topology()
    centres, turns = rng.normal(size=(4, 3)), Rotation.random(4, random_state=1)
    lists, positions = add_bodies(system, topology, TOP, centres, turns.as_quat(scalar_first=True))
    assert lists == [[4 * i + k for k in range(4)] for i in range(4)]
    assert [system.getParticleMass(i)._value for i in lists[2]] == TOP.masses.tolist()
    assert [residue.name for residue in topology.residues()] == ["top"] * 4
    bodies = RigidBodies.from_types(system, {TOP: lists}, positions)
    q, A = bodies.fit(positions)
    np.testing.assert_allclose(q.T, centres, rtol=0, atol=1e-14)
    # A turns vectors of the lab into the principal frame, and `axes` those of the type.
    frames = np.einsum("axn,ab->nxb", A, TOP.axes)
    np.testing.assert_allclose(frames, turns.as_matrix(), rtol=0, atol=1e-13)


def test_shapes_are_exactly_those_of_the_type():
    """Whatever the rounding of positions, and in the order of the lists."""
    system, positions, lists = built({PATCHY: 5, TOP: 4})
    lists[TOP] = lists[TOP][::-1]
    bodies = RigidBodies.from_types(system, lists, positions.round(3))
    assert bodies.moments.T[0].tolist() == [2.0, 2.1, 2.2]
    assert np.array_equal(bodies.moments[:, 5], TOP.principal_moments)
    assert [bodies.atoms_of(i).tolist() for i in range(9)] == lists[PATCHY] + lists[TOP]
    assert bodies.dof == 9 * 6
    assert str(bodies) == "<RigidBodies: 5 patchy of 3 atoms, 4 top of 4 atoms>"


def test_other_particles_are_found_as_usual():
    system, positions, lists = built({TOP: 2})
    for mass in (16.0, 1.0, 1.0, 23.0):
        system.addParticle(mass)
    for i, j, length in ((8, 9, 0.1), (8, 10, 0.1), (9, 10, 0.16)):
        system.addConstraint(i, j, length)
    water = np.array([[0, 0, 0], [0.08, 0.06, 0], [-0.08, 0.06, 0], [1, 1, 1]])
    bodies = RigidBodies.from_types(system, lists, np.concatenate([positions, water]))
    assert [bodies.atoms_of(i).tolist() for i in range(4)] == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10], [11]]


@pytest.mark.parametrize(
    ("lists", "error", "message"),
    [
        ({TOP: [[0, 1, 2]]}, ValueError, "has 4 sites, but list 0 of its bodies has 3 particles"),
        ({TOP: [[0, 1, 2, 3], [0, 1, 2, 3]]}, ValueError, "bodies name particle 0 twice"),
        ({TOP: [[0, 1, 2, 99]]}, ValueError, "particle 99, but the System has only 8"),
        ({TOP: [[1, 0, 2, 3]]}, ValueError, "particle 1 has a mass of 14 dalton in the System, but site 0"),
        ({PATCHY: [[0, 1, 2]]}, ValueError, r"particle 0 has a mass of 12.*setParticleMass\(0, 50\)"),
        ([[0, 1, 2, 3]], TypeError, "types must be a mapping from BodyType"),
        ({TOP: [0, 1, 2, 3]}, TypeError, "lists of particle indices"),
        ({TOP: [[0, 1, 2, 3]], BodyType("top", TOP.positions, TOP.masses): []}, ValueError, "different names"),
    ],
)
def test_lists_that_do_not_fit_the_type(lists, error, message):
    system, positions, _ = built({TOP: 2})
    with pytest.raises(error, match=message):
        RigidBodies.from_types(system, lists, positions)


def test_positions_that_do_not_fit_the_type():
    system, positions, lists = built({TOP: 2})
    positions[6] += [0.0, 0.0, 0.1]
    with pytest.raises(RigidityError, match=r"particle 6 is 0\.0\d+ nm from site 2 .*'top'"):
        RigidBodies.from_types(system, lists, positions)
    mirrored = positions * [1, 1, -1]
    with pytest.raises(RigidityError, match="from site"):
        RigidBodies.from_types(system, {TOP: lists[TOP][:1]}, mirrored)


def test_constraints_that_do_not_fit_the_type():
    system, positions, lists = built({TOP: 2})
    system.addConstraint(0, 1, 0.15)
    RigidBodies.from_types(system, lists, positions)
    system.addConstraint(0, 2, 0.14)
    with pytest.raises(RigidityError, match=r"particles 0 and 2 .*0\.1400 nm, .*0\.1300 nm"):
        RigidBodies.from_types(system, lists, positions)


def test_what_cannot_be_added():
    system, topology = openmm.System(), app.Topology()
    with pytest.raises(ValueError, match=r"centres .*\(m, 3\)"):
        add_bodies(system, topology, TOP, [0, 0, 0])
    with pytest.raises(ValueError, match=r"quaternions .*\(1, 4\)"):
        add_bodies(system, topology, TOP, [[0, 0, 0]], [[0, 0, 0, 0]])
    with pytest.raises(TypeError, match="BodyType"):
        add_bodies(system, topology, [[0, 0, 0]], [[0, 0, 0]])
    assert system.getNumParticles() == topology.getNumAtoms() == 0
    system.addParticle(1.0)
    with pytest.raises(ValueError, match=r"0 atoms, .* 1 particles"):
        add_bodies(system, topology, TOP, [[0, 0, 0]])


def test_types_are_kept_in_copies():
    _, _, bodies = typed({PATCHY: 2, TOP: 1})
    assert [kind.name for kind in bodies.restricted(np.array([1, 2])).species] == ["patchy", "top"]
