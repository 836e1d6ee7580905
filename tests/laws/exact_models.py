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

from tests.laws.linear_maps import Oscillator
from tests.support.oracles import random_attitudes

#: Coordinates of rigid bodies, nm, and relative masses of their atoms. No two moments of "corner" are equal.
SHAPES = {
    "triangle": (((0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (-0.03, 0.08, 0.0)), (8.0, 1.0, 2.0)),
    "pair": (((0.0, 0.0, 0.0), (0.0, 0.0, 0.11)), (3.0, 2.0)),
    "corner": (((0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.13, 0.0), (0.0, 0.0, 0.07)), (1.0, 2.0, 3.0, 4.0)),
}

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
    """

    thermal: float
    step: float
    oscillator: Callable[[float], Oscillator]
    error: Callable[[float], float]
    keeps: tuple[float, float] | None = None


@dataclass
class Assembly:
    """A System of many molecules, and its start.

    Attributes:
        system: openmm.System.
        rng: source of random places.
        positions: of the atoms so far, each (k, 3), nm.
        bodies: atoms of named bodies.
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
        observe: a function of positions and velocities (..., n, k, 3), in nm and nm/ps, that returns values of the copies,
            (..., n), by name.
        exact: their averages.
        rate: of the slowest relaxation in a step without friction: the smallest pace.
        remember: such a function of positions and velocities before a step and after it; None without.
        remembered: averages of its values.
    """

    atoms: np.ndarray
    observe: Callable[[np.ndarray, np.ndarray], dict[str, np.ndarray]]
    exact: dict[str, Exact]
    pace: float
    remember: Callable[..., dict[str, np.ndarray]] | None = None
    remembered: dict[str, Exact] = {}


# --- points -----------------------------------------------------------------------------------------------------------


def _external(assembly: Assembly, energy: str, atoms, *columns, names=()) -> None:
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
            _external(assembly, energy, atoms, *centres.T, names=("x0", "y0", "z0"))

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
        _external(assembly, energy, atoms, *centres.T, names=("x0", "y0", "z0"))

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


# --- rigid bodies -----------------------------------------------------------------------------------------------------


class Frame:
    """Principal axes of a rigid body, found without the package.

    Attributes:
        places: of the atoms in the frame, (k, 3), nm.
        masses: dalton.
        moments: ascending, dalton nm^2; the first is 0 for a linear body.
    """

    def __init__(self, shape: str, pace: float, at: Conditions):
        coordinates, weights = (np.array(each) for each in SHAPES[shape])
        places, moments = _principal(coordinates, weights)
        # The masses make the thermal turn of a step about the slimmest axis the pace.
        scale = at.thermal * (at.step / pace) ** 2 / moments[moments > 1e-12].min()
        self.places, self.masses, self.moments = places, scale * weights, scale * moments
        self._inverse = None if len(places) == 2 else np.linalg.inv(self._basis(places))

    @staticmethod
    def _basis(places: np.ndarray) -> np.ndarray:
        """Return three vectors of each body as columns, of places (..., k, 3)."""
        one, two = places[..., 1, :] - places[..., 0, :], places[..., 2, :] - places[..., 0, :]
        return np.stack([one, two, _cross(one, two)], axis=-1)

    def attitudes(self, x: np.ndarray) -> np.ndarray:
        """Return rotations (..., 3, 3) from the frame to the lab, of atoms (..., k, 3)."""
        return self._basis(x) @ self._inverse

    def momentum(self, x, v) -> np.ndarray:
        return self.masses @ v

    def angular_momentum(self, x, v) -> np.ndarray:
        """Return the angular momenta about the centres of mass in the lab frame, (..., 3)."""
        return _angular_momentum(self.masses, x, v)

    def energies(self, x, v, thermal) -> dict[str, np.ndarray]:
        """Return kinetic energies of translation and about each axis in kT/2, and squares of that of translation."""
        p, L = self.momentum(x, v), self.angular_momentum(x, v)
        square = p * p / (self.masses.sum() * thermal)
        result = {"translation": square.mean(axis=-1), "translation^2": (square * square).mean(axis=-1)}
        if self._inverse is None:
            return result | {"rotation": (L * L).sum(axis=-1) / (2 * self.moments[-1] * thermal)}
        in_frame = (L[..., None, :] @ self.attitudes(x))[..., 0, :]
        return result | _turning(in_frame**2 / (self.moments * thermal))

    def exact(self, margin: float) -> dict[str, Exact]:
        result = {"translation": Exact(1.0, margin), "translation^2": Exact(3.0, 6 * margin)}
        turns = ["rotation"] if self._inverse is None else [f"rotation {axis}" for axis in range(3)]
        return result | dict.fromkeys(turns, Exact(1.0, margin))


def _principal(coordinates: np.ndarray, masses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return coordinates along the principal axes, and the moments."""
    arms = coordinates - masses @ coordinates / masses.sum()
    tensor = np.einsum(
        "k,kab->ab", masses, (arms**2).sum(1)[:, None, None] * np.eye(3) - arms[:, :, None] * arms[:, None]
    )
    moments, axes = np.linalg.eigh(tensor)
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    return arms @ axes, np.where(moments > 1e-12 * moments.max(), moments, 0.0)


def _cross(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """Return cross products; NumPy's function takes several times as long for a few vectors."""
    (a, b, c), (x, y, z) = np.moveaxis(one, -1, 0), np.moveaxis(two, -1, 0)
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=-1)


def _angular_momentum(masses: np.ndarray, x: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the angular momenta of molecules about their centres of mass, (..., 3)."""
    centre = masses @ x / masses.sum()
    return masses @ _cross(x - centre[..., None, :], v)


def _turning(energies: np.ndarray) -> dict[str, np.ndarray]:
    """Return energies about each axis, (..., 3), by name."""
    return {f"rotation {axis}": energies[..., axis] for axis in range(3)}


def _turned(rng, n: int) -> np.ndarray:
    """Return random rotations, (n, 3, 3)."""
    return np.moveaxis(random_attitudes(rng, n), 2, 0)


@dataclass(frozen=True)
class Free:
    """Rigid bodies without forces: Maxwell's distribution, and how momenta are forgotten."""

    shape: str = "triangle"
    named: bool = False
    pace: float = 0.15

    is_free = True

    def put(self, assembly: Assembly, n: int, at: Conditions) -> None:
        frame = Frame(self.shape, self.pace, at)
        atoms = assembly.add(assembly.scatter(frame.places @ _turned(assembly.rng, n)), frame.masses)
        assembly.make_rigid(atoms, frame.places, self.named)
        assembly.molecules += n

        def remember(x0, v0, x, v):
            p, L = (frame.momentum(x0, v0), frame.angular_momentum(x0, v0))
            later = frame.momentum(x, v), frame.angular_momentum(x, v)
            scale = frame.masses.sum() * at.thermal, frame.moments.sum() / 3 * at.thermal
            return {
                "p kept": (p * later[0]).mean(axis=-1) / scale[0],
                "L kept": (L * later[1]).mean(axis=-1) / scale[1],
            }

        # Velocities that are solved for in a drift of finite length are off by its square.
        margin = at.error(self.pace)
        memory = {}
        if at.keeps is not None:
            memory = {"p kept": Exact(at.keeps[0]), "L kept": Exact(at.keeps[1], margin)}
        assembly.parts.append(
            Part(atoms, lambda x, v: frame.energies(x, v, at.thermal), frame.exact(margin), 1.0, remember, memory)
        )


@dataclass(frozen=True)
class Dipoles:
    """Rigid bodies with two charges in a uniform field, of which one may be on a virtual site: Langevin's function.

    Attributes:
        field: energy of the dipole in the field over kT.
    """

    shape: str = "triangle"
    field: float = 3.0
    named: bool = False
    site: bool = False
    pace: float = 0.15

    is_free = True

    def put(self, assembly: Assembly, n: int, at: Conditions) -> None:
        frame = Frame(self.shape, self.pace, at)
        weights = np.zeros(len(frame.places))
        weights[1] = 1.0
        if self.site:
            # A virtual site between the atoms.
            weights[:] = np.arange(1, 1 + len(weights)) / np.arange(1, 1 + len(weights)).sum()
        arm = weights @ frame.places - frame.places[0]
        length = float(np.linalg.norm(arm))
        turns = _towards(assembly.rng, arm / length, _cosines(assembly.rng, self.field, n))
        places = assembly.scatter(frame.places @ np.swapaxes(turns, 1, 2))
        atoms = assembly.add(places, frame.masses)
        charged = atoms[:, 1]
        if self.site:
            charged = assembly.add((weights @ places)[:, None], (0.0,))[:, 0]
            for site, parents in zip(charged.tolist(), atoms.tolist(), strict=True):
                average = openmm.TwoParticleAverageSite if len(parents) == 2 else openmm.ThreeParticleAverageSite
                assembly.system.setVirtualSite(site, average(*parents, *weights.tolist()))
        assembly.make_rigid(atoms, frame.places, self.named)
        assembly.molecules += n
        pull = self.field * at.thermal / length
        charges = np.repeat([1.0, -1.0], n)
        _external(assembly, f"{-pull!r}*charge*z", np.concatenate([charged, atoms[:, 0]]), charges, names=("charge",))

        def observe(x, v):
            cosines = (x[..., 2] @ weights - x[..., 0, 2]) / length
            return {"cos": cosines, "cos^2": cosines**2} | frame.energies(x, v, at.thermal)

        langevin = 1 / math.tanh(self.field) - 1 / self.field
        second = 1 - 2 * langevin / self.field
        margin = at.error(self.pace * math.sqrt(1 + self.field))
        exact = {"cos": Exact(langevin, margin / self.field), "cos^2": Exact(second, margin / self.field)}
        pace = self.pace * math.sqrt(frame.moments[frame.moments > 0].min() / frame.moments.max())
        assembly.parts.append(Part(atoms, observe, exact | frame.exact(margin), pace))


def _cosines(rng, strength: float, n: int) -> np.ndarray:
    """Return cosines with a density exp(strength c)."""
    low = math.exp(-2 * strength)
    return 1 + np.log(low + (1 - low) * rng.random(n)) / strength


def _towards(rng, axis: np.ndarray, cosines: np.ndarray) -> np.ndarray:
    """Return random rotations (n, 3, 3) that give an axis these cosines with z."""
    n = len(cosines)
    turns = _turned(rng, n)
    now = turns @ axis
    angle = rng.uniform(0, 2 * np.pi, n)
    sines = np.sqrt(1 - cosines**2)
    wanted = np.stack([sines * np.cos(angle), sines * np.sin(angle), cosines], axis=1)
    # The shortest rotation from one to the other: two reflections, in the plane across the sum.
    half = now + wanted
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    about = 2 * half[:, :, None] * half[:, None] - np.eye(3)
    flip = 2 * now[:, :, None] * now[:, None] - np.eye(3)
    return about @ flip @ turns


@dataclass(frozen=True)
class Tethered:
    """Bodies of six atoms with springs to their places, V = k (dr)^2/2 - c tr A, and three different moments.

    Attributes:
        stiffness: c over kT.
    """

    stiffness: float = 2.0
    pace: float = 0.15

    is_free = False

    def put(self, assembly: Assembly, n: int, at: Conditions) -> None:
        arms = np.array([0.05, 0.08, 0.11])
        places = np.concatenate([np.diag(arms), -np.diag(arms)])
        # Springs with equal k arm^2 along each axis, and masses with different m arm^2.
        weights = np.tile(np.array([1.0, 1.6, 2.5]) / arms**2, 2)
        squares = (weights * np.tile(arms**2, 2))[:3] * 2
        weights *= at.thermal * (at.step / self.pace) ** 2 / (squares.sum() - squares.max())
        springs = np.tile(self.stiffness * at.thermal / (2 * arms**2), 2)
        # A rotation by an angle has the density (1 - cos) exp(2 c cos/kT).
        angles = _from_density(
            assembly.rng, lambda a: (1 - np.cos(a)) * np.exp(2 * self.stiffness * (np.cos(a) - 1)), n
        )
        axes = assembly.rng.normal(size=(n, 3))
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        turns = _rotations(axes, angles)
        centres = assembly.centres(n)[:, None]
        spring = springs.sum()
        shifts = assembly.rng.normal(scale=math.sqrt(at.thermal / spring), size=(n, 1, 3))
        atoms = assembly.add(places @ np.swapaxes(turns, 1, 2) + centres + shifts, weights)
        assembly.bodies += atoms.tolist()
        homes = (places + centres).reshape(-1, 3)
        energy = "0.5*spring*((x-x0)^2+(y-y0)^2+(z-z0)^2)"
        _external(assembly, energy, atoms, np.tile(springs, n), *homes.T, names=("spring", "x0", "y0", "z0"))
        mass = weights.sum()
        moments = (squares.sum() - squares) * weights[0] / (1.0 / arms[0] ** 2)

        def observe(x, v):
            centre = x.mean(axis=-2)
            across = (x[..., :3, :] - x[..., 3:, :]) / (2 * arms[:, None])
            L = _angular_momentum(weights, x, v)
            in_frame = (across @ L[..., None])[..., 0]
            velocity = weights @ v / mass
            result = {
                "q^2": ((centre - centres[:, 0]) ** 2).mean(axis=-1) * spring / at.thermal,
                "translation": (velocity**2).mean(axis=-1) * mass / at.thermal,
                "tr A": np.trace(across, axis1=-2, axis2=-1),
            }
            return result | _turning(in_frame**2 / (moments * at.thermal))

        grid = np.linspace(0, np.pi, 4001)
        density = (1 - np.cos(grid)) * np.exp(2 * self.stiffness * (np.cos(grid) - 1))
        trace = float(np.average(1 + 2 * np.cos(grid), weights=density))
        pace = at.step * math.sqrt(spring / mass)
        q2, p2, _ = at.oscillator(pace)
        margin = at.error(self.pace * math.sqrt(1 + 2 * self.stiffness))
        exact = {"q^2": Exact(q2), "translation": Exact(p2), "tr A": Exact(trace, margin / self.stiffness)}
        exact |= {f"rotation {axis}": Exact(1.0, margin) for axis in range(3)}
        slowest = self.pace * math.sqrt(moments.min() / moments.max())
        assembly.parts.append(Part(atoms, observe, exact, min(slowest, pace)))


def _from_density(rng, density, n: int) -> np.ndarray:
    """Return angles between 0 and pi with a density."""
    grid = np.linspace(0, np.pi, 4001)
    sums = np.concatenate([[0.0], np.cumsum((density(grid[1:]) + density(grid[:-1])) / 2)])
    return np.interp(rng.random(n), sums / sums[-1], grid)


def _rotations(axes: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Return rotations about unit axes (n, 3), by Rodrigues' formula."""
    cross = np.cross(np.eye(3)[None], axes[:, None])
    sines, cosines = np.sin(angles)[:, None, None], np.cos(angles)[:, None, None]
    return np.eye(3) + sines * cross + (1 - cosines) * cross @ cross


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
class Joined:
    """Two bodies that a spring of no length joins: its energy is 3/2 kT, whatever the bodies are."""

    shape: str = "triangle"
    pace: float = 0.15
    stiffness: float = 4.0

    is_free = True

    def put(self, assembly: Assembly, n: int, at: Conditions) -> None:
        frame = Frame(self.shape, self.pace, at)
        spring = self.stiffness * at.thermal / np.linalg.norm(np.ptp(frame.places, axis=0)) ** 2
        first, second = (frame.places @ _turned(assembly.rng, n) for _ in range(2))
        apart = assembly.rng.normal(scale=math.sqrt(at.thermal / spring), size=(n, 1, 3))
        second += first[:, 1:2] + apart - second[:, :1]
        k = len(frame.masses)
        atoms = assembly.add(assembly.scatter(np.concatenate([first, second], axis=1)), np.tile(frame.masses, 2))
        assembly.bodies += atoms[:, :k].tolist() + atoms[:, k:].tolist()
        assembly.molecules += n
        force = openmm.HarmonicBondForce()
        for molecule in atoms.tolist():
            force.addBond(molecule[1], molecule[k], 0.0, spring)
        assembly.system.addForce(force)

        def observe(x, v):
            stretch = x[..., 1, :] - x[..., k, :]
            result = {"stretch^2": (stretch**2).mean(axis=-1) * spring / at.thermal}
            halves = [frame.energies(*each, at.thermal) for each in zip(*(_halves(y) for y in (x, v)), strict=True)]
            return result | {name: (halves[0][name] + halves[1][name]) / 2 for name in halves[0]}

        # The spring pulls at an arm about the slimmest axis: the pace of its fastest motion squared.
        margin = at.error(self.pace * math.sqrt(2 * self.stiffness))
        exact = {"stretch^2": Exact(1.0, margin)} | frame.exact(margin)
        slowest = self.pace * math.sqrt(frame.moments[frame.moments > 0].min() / frame.moments.max())
        assembly.parts.append(Part(atoms, observe, exact, slowest))


def _halves(atoms: np.ndarray) -> list[np.ndarray]:
    return np.split(atoms, 2, axis=-2)


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
