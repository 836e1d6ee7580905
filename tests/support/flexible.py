"""Points with distance constraints, springs and smooth forces, for the tests of constrained and flexible molecules."""

import numpy as np
from scipy.integrate import solve_ivp

from openmm_sier import BodyState
from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.constraints import Constraints
from openmm_sier.dynamics.species import Species

BOND = 0.109
CARBON, HYDROGEN = 12.0, 1.0

#: Directions from the centre of a tetrahedron to its corners.
CORNERS = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)

#: RATTLE steps of sixth order as fractions of a drift (Kahan and Li, Math. Comput. 66, 1089 (1997), 9 stages).
WING = (0.39216144400731413928, 0.33259913678935943860, -0.70624617255763935981, 0.08221359629355080023)
KAHAN_LI = (*WING, 1 - 2 * sum(WING), *reversed(WING))


def repeated(times, fractions):
    """Fractions of a drift as those of equal parts of it."""
    return tuple(fraction / times for fraction in fractions) * times


class Points:
    """Points with constraints in a smooth potential.

    V is the sum of an external field, c_i E sin(k_i.x_i + i), of springs, k (|x_i - x_j| - l)^2 / 2, and of soft
    charges on different molecules, Q c_i c_j / sqrt(r^2 + s^2).
    """

    FIELD, WAVES = 60.0, 12.0
    COULOMB, SOFTENING = 138.935, 0.12

    def __init__(self, x, masses, pairs=(), lengths=(), springs=(), charges=None, molecules=None, field=True):
        """
        Args:
            x: (n, 3), a start that satisfies the constraints nearly.
            springs: tuples (i, j, length, constant).
            charges: (n,); None: alternating.
            molecules: (n,); None: one.
        """
        self.x = np.array(x, dtype=float).T
        self.masses = np.array(masses, dtype=float)
        n = len(self.masses)
        self.pairs, self.lengths = np.array(pairs, dtype=int).reshape(-1, 2), np.array(lengths, dtype=float)
        table = np.array(springs, dtype=float).reshape(-1, 4).T
        self.springs = table[0].astype(int), table[1].astype(int), table[2], table[3]
        self.charges = 0.3 * (-1.0) ** np.arange(n) if charges is None else np.array(charges)
        self.molecules = np.zeros(n, int) if molecules is None else np.array(molecules)
        self.products = self.COULOMB * np.outer(self.charges, self.charges)
        self.products *= np.not_equal.outer(self.molecules, self.molecules)
        self.field = self.FIELD * field
        self.waves = self.WAVES * np.random.default_rng(8).normal(size=(3, n)) / np.sqrt(3)

    def constraints(self):
        return Constraints(self.pairs, self.lengths, self.masses)

    @property
    def bodies(self):
        n = len(self.masses)
        kinds = [Species(np.array([[i]]), self.masses[i : i + 1], np.zeros((3, 1)), np.zeros(3)) for i in range(n)]
        return BodySet(kinds, n)

    def start(self, rng, temperature=300.0):
        constraints = self.constraints()
        q = constraints.satisfied(self.x)
        p = rng.normal(size=q.shape) * np.sqrt(GAS_CONSTANT * temperature * self.masses)
        n = len(self.masses)
        return BodyState(q, constraints.project(q, p), np.repeat(np.eye(3)[:, :, None], n, axis=2), np.zeros((3, n)))

    # --- forces ---

    def slow_forces(self, q):
        phase = (self.waves * q).sum(axis=0) + np.arange(q.shape[1])
        F = -self.charges * self.field * np.cos(phase) * self.waves
        apart = q[:, :, None] - q[:, None]
        strength = self.products / ((apart**2).sum(axis=0) + self.SOFTENING**2) ** 1.5
        return F + (strength * apart).sum(axis=2)

    def fast_forces(self, q):
        i, j, length, constant = self.springs
        apart = q[:, i] - q[:, j]
        distance = np.sqrt((apart**2).sum(axis=0))
        pull = constant * (distance - length) / distance * apart
        n = q.shape[1]
        return np.array([np.bincount(j, row, n) - np.bincount(i, row, n) for row in pull])

    def forces(self, q):
        return self.slow_forces(q) + self.fast_forces(q)

    # --- an independent solution ---

    def exact_flow(self, state, time):
        """The equations of motion of index 1, integrated by DOP853.

        Multipliers follow from the second time derivative of the constraints, by a pseudo-inverse, so that redundant
        constraints do no harm. Deviations from the constraints grow as the square of the time from rounding only.
        """
        n = len(self.masses)
        i, j = self.pairs.T

        def derivative(_, y):
            q, v = y.reshape(2, 3, n)
            F = self.forces(q)
            rows = np.zeros((len(i), 3, n))
            bonds = (q[:, i] - q[:, j]).T
            rows[np.arange(len(i)), :, i] = bonds
            rows[np.arange(len(i)), :, j] = -bonds
            G = rows.reshape(len(i), 3 * n)
            weighted = (rows / self.masses).reshape(len(i), 3 * n)
            bending = ((v[:, i] - v[:, j]) ** 2).sum(axis=0)
            multipliers = -np.linalg.pinv(weighted @ G.T, rcond=1e-10) @ (weighted @ F.ravel() + bending)
            return np.concatenate([v.ravel(), ((F + (multipliers @ G).reshape(3, n)) / self.masses).ravel()])

        start = np.concatenate([state.q.ravel(), (state.p / self.masses).ravel()])
        y = solve_ivp(derivative, (0, time), start, method="DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
        q, v = y.reshape(2, 3, n)
        return BodyState(q, self.masses * v, state.A, state.L)


def rotor(leaves, centre=(0.1, -0.2, 0.3), **options):
    """A carbon with hydrogens at constrained distances."""
    x = np.vstack([np.zeros(3), BOND * CORNERS[:leaves]]) + centre
    pairs = [(0, b + 1) for b in range(leaves)]
    return Points(x, [CARBON] + leaves * [HYDROGEN], pairs, leaves * [BOND], **options)


def ring(size=6, **options):
    """A puckered ring of constrained bonds, each atom with a constrained hydrogen."""
    angles = 2 * np.pi * np.arange(size) / size
    pucker = 0.025 * (-1.0) ** np.arange(size)
    heavy = np.stack([0.15 * np.cos(angles), 0.15 * np.sin(angles), pucker], axis=1)
    light = heavy + BOND * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    bonds = np.linalg.norm(heavy - np.roll(heavy, -1, axis=0), axis=1)
    pairs = [(i, (i + 1) % size) for i in range(size)] + [(i, size + i) for i in range(size)]
    masses, lengths = size * [CARBON] + size * [HYDROGEN], [*bonds, *size * [BOND]]
    return Points(np.vstack([heavy, light]), masses, pairs, lengths, **options)


def cage(**options):
    """Five atoms with all ten distances fixed, one of which is redundant, and a hydrogen on the first."""
    x = np.array([[0, 0, 0.12], [0, 0, -0.12], [0.12, 0, 0], [-0.06, 0.1, 0], [-0.06, -0.1, 0.01], [0.03, 0.03, 0.22]])
    pairs = [(i, j) for i in range(5) for j in range(i)] + [(0, 5)]
    lengths = [np.linalg.norm(x[i] - x[j]) for i, j in pairs]
    return Points(x, [12, 14, 12, 16, 12, 1], pairs, lengths, **options)


def chains(constrained=True, **options):
    """Two interacting chains of three CH2 with springs for bonds and angles; C-H is constrained or a spring too."""
    x, masses, pairs, lengths, springs, molecules = [], [], [], [], [], []
    for molecule, origin in enumerate(([0, 0, 0], [0.05, 0.4, 0.1])):
        first = len(x)
        for i in range(3):
            place = np.add(origin, [0.13 * i, 0.07 * (i % 2), 0.02 * i])
            side = np.array([0, 0.58 * (-1) ** (i + 1), 0])
            up = np.array([0, 0, 0.815])
            x += [place, place + BOND * (side + up), place + BOND * (side - up)]
            masses += [CARBON, HYDROGEN, HYDROGEN]
            molecules += 3 * [molecule]
            at = first + 3 * i
            # Springs between atoms two bonds apart stand for angles.
            springs.append((at + 1, at + 2, 0.178, 1e4))
            for hydrogen in (at + 1, at + 2):
                if constrained:
                    pairs.append((at, hydrogen))
                    lengths.append(BOND)
                else:
                    springs.append((at, hydrogen, BOND, 2.8e5))
                springs += [(other, hydrogen, 0.21, 4e4) for other in (at - 3, at + 3) if first <= other < first + 9]
            if i:
                springs.append((at - 3, at, 0.15, 2.6e5))
        springs.append((first, first + 6, 0.26, 5e4))
    return Points(x, masses, pairs, lengths, springs, molecules=molecules, **options)


def many(*kinds, apart=0.7):
    """Molecules of several kinds in one system, out of order among two free points."""
    x, masses, pairs, lengths = [np.zeros(3)], [20.0], [], []
    for number, kind in enumerate(kinds):
        first = len(x)
        x += list(kind.x.T + apart * np.array([number % 3, number // 3, 0.1 * number]))
        masses += list(kind.masses)
        pairs += [(i + first, j + first) for i, j in kind.pairs]
        lengths += list(kind.lengths)
    x.append(np.ones(3))
    masses.append(30.0)
    place = np.random.default_rng(5).permutation(len(x))
    order = np.argsort(place)
    return Points(np.array(x)[order], np.array(masses)[order], place[np.array(pairs)], lengths)


def mixture():
    """Stars of every size and graphs, out of order."""
    return many(rotor(1), rotor(2), rotor(3), ring(), rotor(3), cage(), rotor(4), ring(5), rotor(1), rotor(2))


def residual(constraints, q):
    """Largest relative deviation of a constrained length at positions (3, n)."""
    norms = np.linalg.norm(q[:, constraints.pairs[:, 0]] - q[:, constraints.pairs[:, 1]], axis=0)
    return np.abs(norms / constraints.lengths - 1).max(initial=0.0)
