"""Distance constraints: projections, moves on the manifold and geodesics."""

from functools import cache

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.constraints import ConstraintError, Constraints
from openmm_sier.dynamics.constraints.geodesic import SUZUKI, TRIPLE_JUMP
from openmm_sier.dynamics.constraints.graph import couplings, joined
from tests.support.flexible import KAHAN_LI, cage, many, mixture, repeated, residual, ring, rotor


def gradients(system, q):
    """G, (c, 3, n), straight from its definition."""
    rows = np.zeros((len(system.pairs), 3, q.shape[1]))
    for c, (i, j) in enumerate(system.pairs):
        rows[c, :, i], rows[c, :, j] = q[:, i] - q[:, j], q[:, j] - q[:, i]
    return rows


def squares(system, q):
    i, j = system.pairs.T
    return ((q[:, i] - q[:, j]) ** 2).sum(axis=0)


@pytest.fixture
def mixed():
    """Molecules of every kind, their constraints, and positions (3, n) on these."""
    system = mixture()
    constraints = system.constraints()
    return system, constraints, constraints.satisfied(system.x)


# --- algebra ----------------------------------------------------------------------------------------------------------


def test_projection_is_the_one_of_linear_algebra(mixed, rng):
    """Against a dense pseudo-inverse: idempotent, tangent, orthogonal in the metric of the inverse masses."""
    system, constraints, q = mixed
    p = rng.normal(size=q.shape)
    projected = constraints.project(q, p)
    G = gradients(system, q).reshape(len(system.pairs), -1)
    inverse = np.tile(1 / system.masses, 3)
    flat = p.ravel()
    expected = flat - G.T @ (np.linalg.pinv((G * inverse) @ G.T, rcond=1e-10) @ (G @ (inverse * flat)))
    # The cage's condition number, some hundred, times rounding.
    assert np.abs(projected.ravel() - expected).max() < 1e-12
    assert np.abs(projected - p).max() > 0.1
    assert np.abs(constraints.project(q, projected) - projected).max() < 1e-13


def test_displacement_is_along_the_gradients_and_ends_on_the_constraints(mixed, rng):
    system, constraints, q = mixed
    force, shift = rng.normal(size=q.shape), 0.02
    result = constraints.displaced(q, force, shift)
    # The iteration ends with the update that follows residuals of 1e-11 (`CLOSE`).
    assert np.abs(squares(system, result) / system.lengths**2 - 1).max() < 1e-11
    # M (q' - q) - shift F is a sum of rows of G at q.
    rest = (system.masses * (result - q) - shift * force).ravel()
    G = gradients(system, q).reshape(len(system.pairs), -1)
    across = rest - G.T @ np.linalg.lstsq(G.T, rest, rcond=None)[0]
    assert np.abs(rest).max() > 1e-3
    assert np.abs(across).max() < 1e-13


def test_positions_are_put_onto_the_constraints(rng):
    """OpenMM's constraint tolerance leaves a relative 1e-5; a hundred times as much is mended as well."""
    system = mixture()
    constraints = system.constraints()
    q = constraints.satisfied(system.x + 1e-4 * rng.normal(size=system.x.shape))
    assert residual(constraints, system.x) < 1e-9
    assert residual(constraints, q) < 1e-13
    again = constraints.satisfied(q)
    assert np.abs(again - q).max() < 1e-15


# --- geodesics --------------------------------------------------------------------------------------------------------


def thermal(rng, constraints, q, temperature=300.0):
    p = rng.normal(size=q.shape) * np.sqrt(GAS_CONSTANT * temperature * constraints.masses)
    return constraints.project(q, p)


def methyl():
    return rotor(3)


@cache
def free_flight(make, time):
    """A molecule, its start, and where the equations of motion with multipliers take it without forces."""
    system = make()
    system.field = 0.0
    start = system.start(np.random.default_rng(6))
    return system, start, system.exact_flow(start, time)


@pytest.mark.parametrize("make", [methyl, ring, cage])
@pytest.mark.parametrize(("composition", "order"), [((1.0,), 2), (SUZUKI, 4), (TRIPLE_JUMP, 4), (KAHAN_LI, 6)])
def test_geodesics_have_the_order_of_their_composition(make, composition, order):
    """Against the equations of motion with multipliers, integrated by DOP853."""
    # Turns of half a radian, so that sixth order shows above the oracle's 1e-12.
    time = 0.03
    system, start, exact = free_flight(make, time)
    constraints = system.constraints()
    steps = (2, 4) if order == 6 else (4, 8)
    errors = []
    for n in steps:
        q, _ = constraints.drift(start.q, start.p, time, repeated(n, composition))
        errors.append(np.abs(q - exact.q).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.3)


def test_geodesics_conserve_and_reverse(rng):
    system = mixture()
    constraints = system.constraints()
    q0 = constraints.satisfied(system.x)
    p0 = thermal(rng, constraints, q0)
    q, p = q0, p0
    for _ in range(100):
        q, p = constraints.drift(q, p, 0.003, SUZUKI)
    p = constraints.project(q, p)
    size = np.abs(p0).max()
    # A random walk of 100 roundings.
    assert np.abs((p - p0).sum(axis=1)).max() < 1e-13 * size
    torque = (np.cross(q, p, axis=0) - np.cross(q0, p0, axis=0)).sum(axis=1)
    assert np.abs(torque).max() < 1e-12 * size
    assert residual(constraints, q) < 1e-13
    # Not exactly conserved: fourth order of 0.1 rad a drift, as in the table of `geodesic`.
    kinetic = [(v**2 / system.masses).sum() for v in (p0, p)]
    assert kinetic[1] == pytest.approx(kinetic[0], rel=1e-6)
    for _ in range(100):
        q, p = constraints.drift(q, p, -0.003, SUZUKI)
    # Rounding grows along geodesics of negative curvature.
    assert np.abs(q - q0).max() < 1e-11


def test_geodesics_are_symplectic(rng):
    """The canonical form on tangent vectors of the constrained phase space, by differences of fourth order."""
    system = rotor(2)
    constraints = system.constraints()
    q0 = constraints.satisfied(system.x)
    p0 = thermal(rng, constraints, q0)

    def state(vector, width):
        q = constraints.satisfied(q0 + width * 0.01 * vector[0])
        return q, constraints.project(q, p0 + width * vector[1])

    def derivative(vector, map, width=2e-3):
        sides = {s: np.array(map(*state(vector, s * width))) for s in (-2, -1, 1, 2)}
        return (8 * (sides[1] - sides[-1]) - (sides[2] - sides[-2])) / (12 * width)

    def form(a, b):
        return (a[0] * b[1] - a[1] * b[0]).sum()

    one, other = rng.normal(size=(2, 2, 3, 3))
    before = form(*(derivative(v, lambda q, p: (q, p)) for v in (one, other)))
    for fractions in ((1.0,), SUZUKI):
        after = form(*(derivative(v, lambda q, p, f=fractions: constraints.drift(q, p, 0.01, f)) for v in (one, other)))
        # Differences err by some 1e-11, the form is of the order of 0.1.
        assert after == pytest.approx(before, abs=1e-9)
        assert abs(before) > 1e-3


def test_what_momenta_have_along_the_bonds_does_not_matter(mixed, rng):
    system, constraints, q = mixed
    free = rng.normal(size=q.shape) * np.sqrt(system.masses)
    results = [constraints.drift(q, p, 0.003, SUZUKI) for p in (free, constraints.project(q, free))]
    (one, p1), (other, p2) = [(x, constraints.project(x, p)) for x, p in results]
    # All equations are solved to rounding, of 0.6 nm and of momenta of 10 dalton nm/ps.
    assert np.abs(one - other).max() < 1e-14
    assert np.abs(p1 - p2).max() < 1e-11


def test_inputs_are_left_as_they_were(mixed, rng):
    _, constraints, q = mixed
    p = thermal(rng, constraints, q)
    before = q.copy(), p.copy()
    results = [*constraints.drift(q, p, 0.002), constraints.displaced(q, p, 0.002), constraints.project(q, p)]
    assert np.array_equal(before, (q, p))
    assert not any(np.shares_memory(new, old) for new in results for old in (q, p))


def test_far_from_the_origin(mixed, rng):
    """Bond vectors, not coordinates, carry the rounding: at 50 nm only the position itself is rounded."""
    _, constraints, q = mixed
    p = thermal(rng, constraints, q)
    near = constraints.drift(q, p, 0.003, SUZUKI)
    far = constraints.drift(q + 50.0, p, 0.003, SUZUKI)
    assert np.abs(far[0] - 50.0 - near[0]).max() < 1e-13
    # Bonds of a relative rounding of 1e-13 turn momenta by as much.
    assert np.abs(far[1] - near[1]).max() < 1e-11


# --- ranks and redundant constraints ----------------------------------------------------------------------------------


def test_ranks():
    assert rotor(3).constraints().rank() == 3
    assert ring().constraints().rank() == 12
    system = cage()
    # Nine constraints fix the shape of five atoms, the tenth is redundant; one more holds the hydrogen.
    assert len(system.pairs) == 11
    assert system.constraints().rank(system.x) == 10
    system = mixture()
    whole = np.linalg.matrix_rank(gradients(system, system.x).reshape(len(system.pairs), -1))
    assert system.constraints().rank(system.x) == whole


def test_a_singular_geometry_is_named():
    """Four atoms in a plane with all six distances, and three on a line: first-order motion out of them is free."""
    square = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.12, 0], [0, 0.12, 0]])
    pairs = [(i, j) for i in range(4) for j in range(i)]
    flat = Constraints(pairs, [np.linalg.norm(square[i] - square[j]) for i, j in pairs], 4 * [12.0])
    assert flat.rank() == 6
    with pytest.raises(ConstraintError, match=r"body 0, body 1, body 2, body 3 .*plane"):
        flat.rank(square.T)
    line = np.array([[0, 0, 0], [0.116, 0, 0], [0.232, 0, 0]])
    straight = Constraints([(0, 1), (1, 2), (0, 2)], [0.116, 0.116, 0.232], [16.0, 12.0, 16.0])
    with pytest.raises(ConstraintError, match="on a line"):
        straight.rank(line.T)


# --- what is refused --------------------------------------------------------------------------------------------------


def describe(body):
    return f"atom {100 + body}"


@pytest.mark.parametrize(
    ("pairs", "lengths", "message"),
    [
        ([(0, 0)], [0.1], "atom 100, atom 100 joins a body to itself"),
        ([(0, 1), (1, 2)], [0.1, -0.1], "atom 101, atom 102 .* no positive length, got -0.1 nm: remove it"),
        ([(0, 1)], [np.nan], "got nan"),
        ([(1, 2), (0, 1), (1, 0)], [0.1, 0.2, 0.2], "atom 101, atom 100 .* is there twice"),
    ],
)
def test_constraints_that_make_no_sense_are_refused(pairs, lengths, message):
    with pytest.raises(ConstraintError, match=message):
        Constraints(pairs, lengths, np.ones(3), describe)


def test_contradictory_lengths_raise():
    """A triangle that does not close, and a tenth distance that the nine others forbid."""
    triangle = Constraints([(0, 1), (1, 2), (0, 2)], [0.1, 0.1, 0.3], [1.0, 2.0, 3.0], describe)
    x = np.array([[0, 0, 0], [0.1, 0.01, 0], [0.25, 0, 0.02]]).T
    with pytest.raises(ConstraintError, match="atom 100, atom 101, atom 102"):
        triangle.satisfied(x)
    system = cage()
    system.lengths[0] *= 1.001
    with pytest.raises(ConstraintError, match="body 5 "):
        system.constraints().satisfied(system.x)


@pytest.mark.parametrize("factor", [40.0, 1e4, 1e200, np.nan])
@pytest.mark.parametrize("make", [methyl, ring])
def test_what_moves_too_fast_raises_with_its_atoms(rng, make, factor):
    """Of two molecules the second explodes; it is named, nothing is NaN and nothing hangs."""
    system = many(make(), make())
    constraints = Constraints(system.pairs, system.lengths, system.masses, describe)
    q = constraints.satisfied(system.x)
    p = thermal(rng, constraints, q)
    wild = np.flatnonzero(constraints.groups == constraints.groups.max())
    p[:, wild] *= factor
    with pytest.raises(ConstraintError) as error:
        constraints.drift(q, p, 0.003)
    named = set(str(error.value).split(" cannot ")[0].removeprefix("the constraints of ").split(" and ")[0].split(", "))
    assert named <= {describe(body) for body in wild}


def test_a_long_straight_chain_converges(rng):
    """Its equations are close to singular, and take more iterations than any other molecule."""
    n = 2000
    constraints = Constraints([(k, k + 1) for k in range(n - 1)], np.full(n - 1, 0.38), np.full(n, 14.0))
    q = np.zeros((3, n))
    q[0] = 0.38 * np.arange(n)
    p = thermal(rng, constraints, q)
    # In one line nothing but the centre moves along it. Rounding is that of positions up to 760 nm.
    assert p[0] == pytest.approx(np.full(n, p[0].mean()), abs=1e-10)
    new_q, _ = constraints.drift(q, p, 0.0005)
    assert np.linalg.norm(np.diff(new_q, axis=1), axis=0) == pytest.approx(constraints.lengths, abs=1e-11)


# --- subsets ----------------------------------------------------------------------------------------------------------


def test_a_subset_has_numbers_of_its_own(rng):
    system = mixture()
    constraints = Constraints(system.pairs, system.lengths, system.masses, describe)
    members = constraints.members
    subset = constraints.restricted(members)
    q = constraints.satisfied(system.x)
    p = thermal(rng, constraints, q)
    whole = constraints.drift(q, p, 0.002)
    result = subset.drift(q[:, members], p[:, members], 0.002)
    assert np.array_equal(result[0], whole[0][:, members])
    assert np.array_equal(result[1], whole[1][:, members])
    with pytest.raises(ConstraintError, match=f"atom {100 + members[0]}.* joins the subset to another body"):
        constraints.restricted(members[1:])


def test_no_constraints_at_all(rng):
    free = Constraints([], [], [1.0, 2.0])
    q, p = rng.normal(size=(2, 3, 2))
    assert free.rank(q) == 0
    assert np.array_equal(free.project(q, p), p)
    assert np.array_equal(free.drift(q, p, 0.5)[0], q + 0.5 * p / [1.0, 2.0])


@pytest.mark.parametrize("edges", [0, 30, 80, 300])
def test_components_are_those_of_scipy(rng, edges):
    n = 100
    pairs = rng.integers(0, n, (edges, 2))
    graph = sparse.coo_array((np.ones(edges), pairs.T), (n, n))
    _, component = connected_components(graph, directed=False)
    assert joined(n, pairs).tolist() == np.unique(component, return_index=True)[1][component].tolist()


def test_a_long_chain_in_any_order_is_one_component(rng):
    chain = rng.permutation(20_000)
    assert not joined(len(chain), np.column_stack([chain[:-1], chain[1:]])).any()


def test_constraints_are_coupled_by_the_atoms_that_they_share(mixed):
    """Against the product of dense matrices, and in the order on which the bits of sums depend."""
    system, _, _ = mixed
    pairs, inverse_masses = np.array(system.pairs), 1 / system.masses
    incidence = np.zeros((len(pairs), len(inverse_masses)))
    incidence[np.arange(len(pairs)), pairs[:, 0]] = 1
    incidence[np.arange(len(pairs)), pairs[:, 1]] = -1
    rows, columns, weights = couplings(pairs, inverse_masses)
    coupled = np.zeros((len(pairs), len(pairs)))
    coupled[rows, columns] = weights
    # Sums of two numbers.
    assert np.abs(coupled - incidence * inverse_masses @ incidence.T).max() < 1e-15
    assert len(set(zip(rows.tolist(), columns.tolist(), strict=True))) == len(rows) == np.count_nonzero(coupled)
    assert (np.diff(rows) >= 0).all()
    chain = couplings(np.array([[1, 0], [1, 2], [3, 2]]), np.ones(4))
    assert chain[0].tolist() == [0, 0, 1, 1, 1, 2, 2]
    assert chain[1].tolist() == [1, 0, 0, 2, 1, 1, 2]
    assert chain[2].tolist() == [1, 2, 1, 1, 2, 1, 2]


def test_trees_are_independent_without_a_factorization(mixed, monkeypatch):
    star = Constraints([[0, 1], [0, 2], [0, 3], [4, 5]], np.full(4, 0.1), np.ones(6))
    assert star.rank() == 4
    monkeypatch.setattr("openmm_sier.dynamics.constraints.graph._are_trees", lambda table: False)
    assert star.rank() == 4
