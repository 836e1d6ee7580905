"""Rigid molecules of every kind, and a smooth model potential between them, for the tests that need no Context."""

import numpy as np
from scipy.integrate import solve_ivp

from openmm_sier import BodyState, RigidBodies
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.species import Species
from openmm_sier.dynamics.vectors import body_frame
from tests.support.oracles import random_attitudes, skew

TETRAHEDRON = 0.0629 * np.array([[0, 0, 0], [1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
RING = [[0.139 * np.cos(a), 0.139 * np.sin(a), 0.0] for a in np.pi / 3 * np.arange(6)]

WATER, METHANE, CARBON_DIOXIDE, ION = "water", "methane", "carbon dioxide", "ion"

#: Masses, coordinates and degrees of freedom.
GEOMETRIES = {
    WATER: ([15.999, 1.008, 1.008], [[0, 0, 0], [0.0957, 0, 0], [-0.024, 0.0927, 0]], 6),
    "handed": ([12.0, 1.0, 35.0, 80.0], [[0, 0, 0], [0.11, 0, 0], [-0.03, 0.17, 0], [-0.03, -0.08, 0.18]], 6),
    METHANE: ([12.011] + 4 * [1.008], TETRAHEDRON, 6),
    "ring": (6 * [13.019], RING, 6),
    CARBON_DIOXIDE: ([15.999, 12.011, 15.999], [[0, 0, 0], [0.1, 0.05, -0.02], [0.2, 0.1, -0.04]], 5),
    "pair": ([14.007, 15.999], [[1, 2, 3], [1.1, 2, 3]], 5),
    ION: ([22.99], [[5, 5, 5]], 3),
}

#: Of the sites that the model potential knows, elementary charges.
CHARGES = {
    WATER: [-0.83, 0.415, 0.415],
    METHANE: [-0.48, 0.12, 0.12, 0.12, 0.12],
    CARBON_DIOXIDE: [-0.35, 0.7, -0.35],
    ION: [1.0],
}


def species(kind, atoms) -> Species:
    masses, coordinates, _ = GEOMETRIES[kind]
    return Species.from_coordinates(atoms, masses, coordinates)


def scattered(kinds, each=4, n_free=3) -> RigidBodies:
    """`each` bodies of every kind, their atoms out of order among free particles."""
    shuffled = np.random.default_rng(11).permutation(sum(each * len(GEOMETRIES[k][0]) for k in kinds) + n_free)
    results, start = [], 0
    for kind in kinds:
        k = len(GEOMETRIES[kind][0])
        results.append(species(kind, shuffled[start : start + each * k].reshape(each, k)))
        start += each * k
    return RigidBodies(results, shuffled.size)


def thermal_state(rng, bodies, q, temperature=300.0) -> BodyState:
    """Bodies at q with random attitudes and momenta."""
    thermal, A = GAS_CONSTANT * temperature, random_attitudes(rng, bodies.n)
    p = rng.normal(size=(3, bodies.n)) * np.sqrt(thermal * bodies.masses)
    body_L = rng.normal(size=(3, bodies.n)) * np.sqrt(thermal * bodies.moments)
    return BodyState(q, p, A, np.einsum("abn,an->bn", A, body_L))


def ensemble(kind, n) -> tuple[RigidBodies, BodyState]:
    """n bodies of one kind, far from equilibrium: at rest but for a large common momentum and angular momentum."""
    k = len(GEOMETRIES[kind][0])
    one = species(kind, np.arange(n * k).reshape(n, k))
    A = random_attitudes(np.random.default_rng(3), n)
    tilde = np.where(one.moments > 0, 1.0, 0.0)[:, None] * np.ones((3, n))
    L = np.einsum("abn,an->bn", A, tilde)
    return RigidBodies([one], n * k), BodyState(np.zeros((3, n)), np.full((3, n), 20.0), A, L)


class SoftCluster:
    """Rigid bodies whose sites act on those of other bodies by smooth forces.

    V = sum q q' C / sqrt(r^2 + s^2) + E exp(-r^2 / (2 w^2)) over pairs of sites of different bodies.
    """

    COULOMB, SOFTENING = 138.935, 0.12
    WALL, WIDTH = 60.0, 0.13

    def __init__(self, kinds):
        """One body for each kind named."""
        results, charges, owner = [], [], []
        for number, kind in enumerate(kinds):
            k = len(CHARGES[kind])
            results.append(species(kind, [range(len(owner), len(owner) + k)]))
            charges += CHARGES[kind]
            owner += k * [number]
        self.bodies = RigidBodies(results, len(owner))
        self.products = self.COULOMB * np.outer(charges, charges) * np.not_equal.outer(owner, owner)
        self.walls = self.WALL * np.not_equal.outer(owner, owner)

    def sites(self, q, A):
        return self.bodies.place(q, A, np.empty((self.bodies.n_particles, 3)))

    def potential_energy(self, state):
        x = self.sites(state.q, state.A)
        square = ((x[:, None] - x[None]) ** 2).sum(axis=2)
        pairs = self.products / np.sqrt(square + self.SOFTENING**2) + self.walls * np.exp(-square / (2 * self.WIDTH**2))
        return 0.5 * pairs.sum()

    def forces(self, q, A):
        x = self.sites(q, A)
        apart = x[:, None] - x[None]
        square = (apart**2).sum(axis=2)
        strength = self.products / (square + self.SOFTENING**2) ** 1.5
        strength += self.walls * np.exp(-square / (2 * self.WIDTH**2)) / self.WIDTH**2
        return self.bodies.forces_and_torques((strength[:, :, None] * apart).sum(axis=1), A)

    def start(self, rng):
        """Bodies near the corners of a cube, at 300 K."""
        n = self.bodies.n
        corners = 0.32 * np.array([[i & 1, i >> 1 & 1, i >> 2 & 1] for i in range(n)]).T
        return thermal_state(rng, self.bodies, corners + rng.normal(scale=0.01, size=(3, n)))

    def exact_flow(self, state, time):
        """The equations of motion integrated by DOP853."""
        n, masses, inverse = self.bodies.n, self.bodies.masses, self.bodies.inverse_moments

        def derivative(_, y):
            q, p, L = y[: 9 * n].reshape(3, 3, n)
            A = y[9 * n :].reshape(3, 3, n)
            F, tau = self.forces(q, A)
            omega = body_frame(A, L) * inverse
            turn = [-skew(omega[:, i]) @ A[:, :, i] for i in range(n)]
            return np.concatenate([v.ravel() for v in (p / masses, F, tau, np.stack(turn, axis=2))])

        start = np.concatenate([v.ravel() for v in (state.q, state.p, state.L, state.A)])
        y = solve_ivp(derivative, (0, time), start, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
        q, p, L = y[: 9 * n].reshape(3, 3, n)
        return BodyState(q, p, y[9 * n :].reshape(3, 3, n), L)
