"""Rigid bodies whose canonical averages are known exactly, as the kinds of `exact_models`."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import openmm

from tests.laws.exact_models import Assembly, Conditions, Exact, Part, add_external
from tests.laws.mechanics import angular_momentum, centre_of, cross, principal_axes
from tests.support.oracles import random_attitudes

#: Coordinates of rigid bodies, nm, and relative masses of their atoms. No two moments of "corner" are equal.
COORDINATES = {
    "triangle": (((0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (-0.03, 0.08, 0.0)), (8.0, 1.0, 2.0)),
    "pair": (((0.0, 0.0, 0.0), (0.0, 0.0, 0.11)), (3.0, 2.0)),
    "corner": (((0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.13, 0.0), (0.0, 0.0, 0.07)), (1.0, 2.0, 3.0, 4.0)),
}


class Frame:
    """Principal axes of a rigid body, found without the package.

    Attributes:
        places: of the atoms in the frame, (k, 3), nm.
        masses: dalton.
        moments: ascending, dalton nm^2; the first is 0 for a linear body.
    """

    def __init__(self, shape: str, pace: float, at: Conditions):
        coordinates, weights = (np.array(each) for each in COORDINATES[shape])
        places, moments = principal_axes(weights, coordinates)
        # The masses make the thermal turn of a step about the slimmest axis the pace.
        scale = at.thermal * (at.step / pace) ** 2 / moments[moments > 1e-12].min()
        self.places = places
        self.masses = scale * weights
        self.moments = scale * moments
        self._inverse = None if len(places) == 2 else np.linalg.inv(self._basis(places))

    @staticmethod
    def _basis(places: np.ndarray) -> np.ndarray:
        """Return three vectors of each body as columns, of places (..., k, 3)."""
        one, two = places[..., 1, :] - places[..., 0, :], places[..., 2, :] - places[..., 0, :]
        return np.stack([one, two, cross(one, two)], axis=-1)

    def attitudes(self, x: np.ndarray) -> np.ndarray:
        """Return rotations (..., 3, 3) from the frame to the lab, of atoms (..., k, 3)."""
        return self._basis(x) @ self._inverse

    def momentum(self, x, v) -> np.ndarray:
        return self.masses @ v

    def energies(self, x, v, thermal) -> dict[str, np.ndarray]:
        """Return kinetic energies of translation and about each axis in kT/2, and squares of that of translation."""
        p, L = self.momentum(x, v), angular_momentum(self.masses, x, v)
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
            p, L = (frame.momentum(x0, v0), angular_momentum(frame.masses, x0, v0))
            later = frame.momentum(x, v), angular_momentum(frame.masses, x, v)
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
        add_external(
            assembly, f"{-pull!r}*charge*z", np.concatenate([charged, atoms[:, 0]]), charges, names=("charge",)
        )

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
class Suspended:
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
        grid = np.linspace(0, np.pi, 4001)
        density = (1 - np.cos(grid)) * np.exp(2 * self.stiffness * (np.cos(grid) - 1))
        angles = _from_density(assembly.rng, grid, density, n)
        axes = assembly.rng.normal(size=(n, 3))
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        turns = _rotations(axes, angles)
        centres = assembly.centres(n)[:, None]
        spring = springs.sum()
        shifts = assembly.rng.normal(scale=math.sqrt(at.thermal / spring), size=(n, 1, 3))
        atoms = assembly.add(places @ np.swapaxes(turns, 1, 2) + centres + shifts, weights)
        assembly.make_rigid(atoms, places, named=True)
        homes = (places + centres).reshape(-1, 3)
        energy = "0.5*spring*((x-x0)^2+(y-y0)^2+(z-z0)^2)"
        add_external(assembly, energy, atoms, np.tile(springs, n), *homes.T, names=("spring", "x0", "y0", "z0"))
        mass = weights.sum()
        moments = (squares.sum() - squares) * weights[0] / (1.0 / arms[0] ** 2)

        def observe(x, v):
            centre = x.mean(axis=-2)
            across = (x[..., :3, :] - x[..., 3:, :]) / (2 * arms[:, None])
            L = angular_momentum(weights, x, v)
            in_frame = (across @ L[..., None])[..., 0]
            velocity = centre_of(weights, v)
            result = {
                "q^2": ((centre - centres[:, 0]) ** 2).mean(axis=-1) * spring / at.thermal,
                "translation": (velocity**2).mean(axis=-1) * mass / at.thermal,
                "tr A": np.trace(across, axis1=-2, axis2=-1),
            }
            return result | _turning(in_frame**2 / (moments * at.thermal))

        trace = float(np.average(1 + 2 * np.cos(grid), weights=density))
        pace = at.step * math.sqrt(spring / mass)
        q2, p2, _ = at.oscillator(pace)
        margin = at.error(self.pace * math.sqrt(1 + 2 * self.stiffness))
        exact = {"q^2": Exact(q2), "translation": Exact(p2), "tr A": Exact(trace, margin / self.stiffness)}
        exact |= {f"rotation {axis}": Exact(1.0, margin) for axis in range(3)}
        slowest = self.pace * math.sqrt(moments.min() / moments.max())
        assembly.parts.append(Part(atoms, observe, exact, min(slowest, pace)))


def _from_density(rng, grid: np.ndarray, density: np.ndarray, n: int) -> np.ndarray:
    """Return random numbers with a density on a grid."""
    sums = np.concatenate([[0.0], np.cumsum(density[1:] + density[:-1])])
    return np.interp(rng.random(n), sums / sums[-1], grid)


def _rotations(axes: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Return rotations about unit axes (n, 3), by Rodrigues' formula."""
    crossed = np.cross(np.eye(3)[None], axes[:, None])
    sines, cosines = np.sin(angles)[:, None, None], np.cos(angles)[:, None, None]
    return np.eye(3) + sines * crossed + (1 - cosines) * crossed @ crossed


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
        for half in (atoms[:, :k], atoms[:, k:]):
            assembly.make_rigid(half, frame.places, named=True)
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
