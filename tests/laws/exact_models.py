"""Kinds of molecules whose canonical averages are known exactly, in copies that do not interact.

Each kind is a frozen dataclass with plain values. `put` adds copies to a System, each at a place drawn from the exact
distribution, and returns what is to be observed. Lengths of time are in units of the step: a `pace` is the step times a
frequency, or times the thermal frequency sqrt(kT/I) of the smallest moment.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import openmm

from openmm_sier import BodyType
from tests.laws.linear_maps import Oscillator

#: Force group of fast bonds.
FAST = 1


class Exact(NamedTuple):
    """An exact average.

    Attributes:
        value: the average.
        margin: bound of the deviation that the step makes.
    """

    value: float
    margin: float = 0.0


@dataclass(frozen=True)
class Conditions:
    """What averages depend on.

    Attributes:
        thermal: kT, kJ/mol.
        step: of the scheme, ps.
        oscillator: covariances of an oscillator at the ends of steps, for its pace.
        error: bound of the relative error of averages of an anharmonic motion, for its pace.
        keeps: factors of momenta and angular momenta from one step to the next, without forces; None if unknown.
        pushed: mean momentum under a constant force, over force times step, for such a factor.
    """

    thermal: float
    step: float
    oscillator: Callable[[float], Oscillator]
    error: Callable[[float], float]
    keeps: tuple[float, float] | None = None
    pushed: Callable[[float], float] | None = None


@dataclass
class Assembly:
    """A System of many molecules, and its start.

    Attributes:
        system: openmm.System.
        rng: source of random places.
        positions: of the atoms so far, each (k, 3), nm.
        bodies: atoms of named bodies.
        types: atoms of each body of a type.
        molecules: number of molecules that fill the box.
        freedoms: degrees of freedom that have kinetic energy.
        parts: what is to be observed.
        box: its edge, nm.
        is_pressed: whether the volume changes.
    """

    rng: np.random.Generator
    system: openmm.System = field(default_factory=openmm.System)
    positions: list[np.ndarray] = field(default_factory=list)
    bodies: list[list[int]] = field(default_factory=list)
    types: dict[BodyType, list[list[int]]] = field(default_factory=dict)
    molecules: int = 0
    freedoms: int = 0
    parts: list[Part] = field(default_factory=list)
    box: float = 3.0
    is_pressed: bool = False

    def add(self, places: np.ndarray, masses) -> np.ndarray:
        """Add molecules with atoms at places (n, k, 3); return the numbers of atoms, (n, k)."""
        n, k, _ = places.shape
        first = self.system.getNumParticles()
        for _ in range(n):
            for mass in masses:
                self.system.addParticle(mass)
        self.positions.append(places.reshape(-1, 3))
        self.freedoms += 3 * n * np.count_nonzero(masses)
        return first + np.arange(n * k).reshape(n, k)

    def centres(self, n: int) -> np.ndarray:
        """Return centres of wells, (n, 3), nm: the origin if the volume changes, which moves them least."""
        return np.zeros((n, 3)) if self.is_pressed else self.rng.uniform(0, self.box, (n, 3))

    def scatter(self, shapes: np.ndarray) -> np.ndarray:
        """Return molecules (n, k, 3) at random places in the box."""
        return shapes + self.rng.uniform(0, self.box, (len(shapes), 1, 3))

    def hold(self, atoms: np.ndarray, pairs, places: np.ndarray) -> None:
        """Constrain pairs of each molecule to their distances in places (k, 3)."""
        for molecule in atoms.tolist():
            for i, j in pairs:
                self.system.addConstraint(molecule[i], molecule[j], float(np.linalg.norm(places[i] - places[j])))
        self.freedoms -= len(atoms) * len(pairs)

    def make_rigid(self, atoms: np.ndarray, places: np.ndarray, named: bool) -> None:
        """Make molecules rigid, by name or by constraints."""
        if named:
            self.bodies += atoms.tolist()
            self.freedoms -= len(atoms) * (3 * len(places) - (5 if len(places) == 2 else 6))
        else:
            k = atoms.shape[1]
            self.hold(atoms, [(i, j) for i in range(k) for j in range(i + 1, k)], places)


class Part(NamedTuple):
    """Copies of one kind in a System.

    Attributes:
        atoms: their numbers, (n, k).
        observe: a function of positions and velocities (..., n, k, 3), in nm and nm/ps, that returns values (..., n) of
            the copies by name.
        exact: their averages.
        pace: of the slowest motion.
        remember: such a function of positions and velocities before a step and after it; None without.
        remembered: averages of its values.
    """

    atoms: np.ndarray
    observe: Callable[[np.ndarray, np.ndarray], dict[str, np.ndarray]]
    exact: dict[str, Exact]
    pace: float
    remember: Callable[..., dict[str, np.ndarray]] | None = None
    remembered: dict[str, Exact] | None = None


# --- points -----------------------------------------------------------------------------------------------------------


def add_external(assembly: Assembly, energy: str, atoms, *columns, names=()) -> None:
    """Add an energy of each atom, with parameters of its own."""
    force = openmm.CustomExternalForce(energy)
    for name in names:
        force.addPerParticleParameter(name)
    for atom, *values in zip(np.ravel(atoms).tolist(), *columns, strict=True):
        force.addParticle(atom, values)
    assembly.system.addForce(force)


@dataclass(frozen=True)
class Wells:
    """Points in harmonic wells, of a field or of springs to frozen atoms."""

    mass: float = 12.0
    pace: float = 0.5
    anchored: bool = False

    is_free = False

    def put(self, assembly: Assembly, n: int, at: Conditions) -> None:
        spring = self.mass * (self.pace / at.step) ** 2
        centres = assembly.centres(n)
        width = math.sqrt(at.thermal / spring)
        atoms = assembly.add((centres + assembly.rng.normal(scale=width, size=(n, 3)))[:, None], (self.mass,))
        if self.anchored:
            anchors = assembly.add(centres[:, None], (0.0,))
            force = openmm.HarmonicBondForce()
            for atom, anchor in zip(atoms[:, 0].tolist(), anchors[:, 0].tolist(), strict=True):
                force.addBond(anchor, atom, 0.0, spring)
            assembly.system.addForce(force)
        else:
            energy = f"{spring / 2!r}*((x-x0)^2+(y-y0)^2+(z-z0)^2)"
            add_external(assembly, energy, atoms, *centres.T, names=("x0", "y0", "z0"))

        def observe(x, v):
            q, v = x[..., 0, :] - centres, v[..., 0, :]
            return {
                "q^2": (q * q).mean(axis=-1) * spring / at.thermal,
                "p^2": (v * v).mean(axis=-1) * self.mass / at.thermal,
                "qp": (q * v).mean(axis=-1) * math.sqrt(spring * self.mass) / at.thermal,
            }

        q2, p2, qp = at.oscillator(self.pace)
        exact = {"q^2": Exact(q2), "p^2": Exact(p2), "qp": Exact(qp)}
        assembly.parts.append(Part(atoms, observe, exact, self.pace))


@dataclass(frozen=True)
class Quartics:
    """Points in wells of fourth order, whose energies have a gamma distribution; the pace is that of thermal motion."""

    mass: float = 12.0
    pace: float = 0.15

    is_free = False

    def put(self, assembly: Assembly, n: int, at: Conditions) -> None:
        width = math.sqrt(at.thermal / self.mass) * at.step / self.pace
        constant = at.thermal / width**4
        centres = assembly.centres(n)
        signs = assembly.rng.choice([-1.0, 1.0], (n, 3))
        places = centres + signs * width * assembly.rng.gamma(0.25, size=(n, 3)) ** 0.25
        atoms = assembly.add(places[:, None], (self.mass,))
        energy = f"{constant!r}*((x-x0)^4+(y-y0)^4+(z-z0)^4)"
        add_external(assembly, energy, atoms, *centres.T, names=("x0", "y0", "z0"))

        def observe(x, v):
            energies = constant * (x[..., 0, :] - centres) ** 4 / at.thermal
            return {
                "V": energies.mean(axis=-1),
                "V^2": (energies**2).mean(axis=-1),
                "p^2": (v[..., 0, :] ** 2).mean(axis=-1) * self.mass / at.thermal,
            }

        margin = at.error(self.pace)
        exact = {"V": Exact(1 / 4, margin / 4), "V^2": Exact(5 / 16, margin), "p^2": Exact(1.0, margin)}
        assembly.parts.append(Part(atoms, observe, exact, self.pace))


# --- molecules --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Chains:
    """Atoms on a line of rigid bonds, without angles: the density of their angles has the metric tensor's factor."""

    masses: tuple[float, ...] = (2.0, 1.0, 3.0)
    pace: float = 0.15

    is_free = True
    BOND = 0.1

    def density(self, cosines: np.ndarray) -> np.ndarray:
        """Return the density of cosines (bonds - 1, ...), each uniform without constraints."""
        inverse = 1 / np.array(self.masses)
        bonds = len(self.masses) - 1
        metric = np.zeros((*cosines.shape[1:], bonds, bonds))
        for b in range(bonds):
            metric[..., b, b] = inverse[b] + inverse[b + 1]
            if b:
                metric[..., b, b - 1] = metric[..., b - 1, b] = cosines[b - 1] * inverse[b]
        return np.sqrt(np.linalg.det(metric))

    def put(self, assembly: Assembly, n: int, at: Conditions) -> None:
        scale = at.thermal * (at.step / (self.pace * self.BOND)) ** 2 / min(self.masses)
        masses, joints = scale * np.array(self.masses), len(self.masses) - 2
        cosines = assembly.rng.uniform(-1, 1, (joints, 40 * n))
        densities = self.density(cosines)
        largest = math.sqrt(math.prod(1 / a + 1 / b for a, b in zip(self.masses, self.masses[1:], strict=False)))
        cosines = cosines[:, assembly.rng.random(40 * n) * largest < densities][:, :n]
        directions = [assembly.rng.normal(size=(n, 3))]
        directions[0] /= np.linalg.norm(directions[0], axis=1, keepdims=True)
        for cosine in cosines:
            last = directions[-1]
            across = np.cross(last, assembly.rng.normal(size=(n, 3)))
            across /= np.linalg.norm(across, axis=1, keepdims=True)
            directions.append(cosine[:, None] * last + np.sqrt(1 - cosine**2)[:, None] * across)
        steps = np.stack([np.zeros((n, 3)), *directions], axis=1)
        places = assembly.scatter(self.BOND * np.cumsum(steps, axis=1))
        atoms = assembly.add(places, masses)
        line = self.BOND * np.arange(joints + 2)[:, None] * np.array([1.0, 0.0, 0.0])
        assembly.hold(atoms, [(i, i + 1) for i in range(joints + 1)], line)
        assembly.molecules += n
        freedoms = 3 * len(masses) - (joints + 1)

        def observe(x, v):
            arms = np.diff(x, axis=-2) / self.BOND
            cosines = (arms[..., 1:, :] * arms[..., :-1, :]).sum(axis=-1)
            kinetic = (masses @ (v * v)).sum(axis=-1) / (freedoms * at.thermal)
            result = {"kinetic": kinetic, "kinetic^2": kinetic**2}
            for joint in range(joints):
                result[f"cos {joint}"] = cosines[..., joint]
                result[f"cos^2 {joint}"] = cosines[..., joint] ** 2
            return result

        margin = at.error(self.pace)
        exact = {"kinetic": Exact(1.0, margin), "kinetic^2": Exact(1 + 2 / freedoms, 3 * margin)}
        nodes, weights = np.polynomial.legendre.leggauss(40)
        grid = np.stack(np.meshgrid(*joints * [nodes], indexing="ij"))
        density = self.density(grid)
        for _ in range(joints):
            density = density * weights
            weights = weights[:, None]
        for joint in range(joints):
            for name, values in ((f"cos {joint}", grid[joint]), (f"cos^2 {joint}", grid[joint] ** 2)):
                exact[name] = Exact(float((density * values).sum() / density.sum()), margin)
        assembly.parts.append(Part(atoms, observe, exact, 2 * self.pace))


@dataclass(frozen=True)
class FastBonds:
    """Two atoms and a fast spring of no length, for which a step has inner steps."""

    masses: tuple[float, float] = (12.0, 1.0)
    pace: float = 1.0

    is_free = True

    def put(self, assembly: Assembly, n: int, at: Conditions) -> None:
        reduced = math.prod(self.masses) / sum(self.masses)
        spring = reduced * (self.pace / at.step) ** 2
        bond = assembly.rng.normal(scale=math.sqrt(at.thermal / spring), size=(n, 3))
        atoms = assembly.add(assembly.scatter(np.stack([0 * bond, bond], axis=1)), self.masses)
        assembly.molecules += n
        force = openmm.HarmonicBondForce()
        force.setForceGroup(FAST)
        for i, j in atoms.tolist():
            force.addBond(i, j, 0.0, spring)
        assembly.system.addForce(force)

        def observe(x, v):
            stretch = x[..., 1, :] - x[..., 0, :]
            result = {"stretch^2": (stretch**2).mean(axis=-1) * spring / at.thermal}
            squares = (v * v).mean(axis=-1) * np.array(self.masses) / at.thermal
            return result | {"p^2 0": squares[..., 0], "p^2 1": squares[..., 1]}

        exact = dict.fromkeys(("stretch^2", "p^2 0", "p^2 1"), Exact(1.0))
        assembly.parts.append(Part(atoms, observe, exact, self.pace))
