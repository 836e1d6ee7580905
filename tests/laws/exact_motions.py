"""Bodies of types that move along some axes only, whose averages are known, as kinds of `exact_models`."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import openmm
from scipy.special import ive

from openmm_sier import BodyType, Motion
from tests.laws.exact_bodies import Frame, _cosines, _towards
from tests.laws.exact_models import Assembly, Conditions, Exact, Part, add_external
from tests.laws.mechanics import angular_momentum

NONE, ALONG_X = (False, False, False), (True, False, False)

MOTIONS = {
    "rotating": Motion.ROTATING,
    "in plane": Motion.IN_PLANE,
    "hinged": Motion(NONE, (False, False, True)),
    "free on a line": Motion(translations=ALONG_X),
    "translating": Motion.TRANSLATING,
}


@dataclass(frozen=True)
class Held:
    """Dipoles of a type in a field, with a spring between each centre of mass and its place.

    Attributes:
        shape: of `COORDINATES`.
        motion: of `MOTIONS`.
        field: energy of the dipole in the field over kT.
        pace: of the rotation.
        oscillation: pace of the spring.
    """

    shape: str = "triangle"
    motion: str = "in plane"
    field: float = 2.0
    pace: float = 0.15
    oscillation: float = 0.5

    is_free = False

    def put(self, assembly: Assembly, n: int, at: Conditions) -> None:
        frame = Frame(self.shape, self.pace, at)
        motion = MOTIONS[self.motion]
        kind = BodyType(f"{self.shape} {self.motion}", frame.places, frame.masses, motion=motion)
        moves = np.array(motion.translations)
        turns = (frame.moments > 0) & motion.rotations
        arm = frame.places[1] - frame.places[0]
        length = float(np.linalg.norm(arm))
        # Hinges leave the last axis along z, and the field is across it.
        is_flat = turns.sum() < 2
        # The part of the dipole that a hinge turns through the field.
        reach = math.hypot(arm[0], arm[1]) / length if is_flat else 1.0
        strength = self.field * reach
        attitudes = _turns(assembly.rng, arm / length, strength, n, is_flat)
        mass = frame.masses.sum()
        spring = mass * (self.oscillation / at.step) ** 2
        centres = assembly.centres(n)[:, None]
        shifts = assembly.rng.normal(scale=math.sqrt(at.thermal / spring), size=(n, 1, 3)) * moves
        atoms = assembly.add(centres + shifts + frame.places @ np.swapaxes(attitudes, 1, 2), frame.masses)
        assembly.types[kind] = atoms.tolist()
        assembly.freedoms -= n * (3 * len(frame.masses) - kind.dof)
        # Springs in proportion to the masses exert no torque.
        springs = np.tile(spring * frame.masses / mass, n)
        homes = np.broadcast_to(centres, (n, len(frame.masses), 3)).reshape(-1, 3)
        energy = "0.5*spring*((x-x0)^2+(y-y0)^2+(z-z0)^2)"
        add_external(assembly, energy, atoms, springs, *homes.T, names=("spring", "x0", "y0", "z0"))
        along = "xyz"[self._axis]
        pull = self.field * at.thermal / length
        ends = np.concatenate([atoms[:, 1], atoms[:, 0]])
        add_external(assembly, f"{-pull!r}*charge*{along}", ends, np.repeat([1.0, -1.0], n), names=("charge",))

        def observe(x, v):
            centre = frame.masses @ x / mass
            squares = (centre - centres[:, 0]) ** 2 * spring / at.thermal
            momenta = (frame.masses @ v) ** 2 / (mass * at.thermal)
            result = {f"{axis}^2": squares[..., i] for i, axis in enumerate("xyz")}
            result |= {f"p{axis}^2": momenta[..., i] for i, axis in enumerate("xyz")}
            cosines = (x[..., 1, self._axis] - x[..., 0, self._axis]) / length
            result |= {"cos": cosines, "cos^2": cosines**2}
            L = angular_momentum(frame.masses, x, v)
            return result | {"rotation": (L * _angular_velocity(frame, x, L)).sum(axis=-1) / at.thermal}

        q2, p2, _ = at.oscillator(self.oscillation)
        exact = {f"{axis}^2": Exact(q2 * along) for axis, along in zip("xyz", moves, strict=True)}
        exact |= {f"p{axis}^2": Exact(p2 * along) for axis, along in zip("xyz", moves, strict=True)}
        margin = at.error(self.pace * math.sqrt(1 + self.field))
        exact["rotation"] = Exact(float(turns.sum()), margin * turns.sum())
        if turns.any():
            cosine = ive(1, strength) / ive(0, strength) if is_flat else 1 / math.tanh(strength) - 1 / strength
            second = 1 - (1 if is_flat else 2) * cosine / strength
            exact["cos"] = Exact(reach * cosine, margin / strength)
            exact["cos^2"] = Exact(reach**2 * second, margin / strength)
        slowest = self.pace * math.sqrt(frame.moments[frame.moments > 0].min() / frame.moments.max())
        assembly.parts.append(Part(atoms, observe, exact, min(slowest, self.oscillation)))

    @property
    def _axis(self) -> int:
        """Return the axis of the field."""
        return 0 if self.motion in ("in plane", "hinged") else 2


@dataclass(frozen=True)
class Driven:
    """Bodies of a type that move along x and turn about z, under a constant force and a constant torque.

    In a bath they come to a mean momentum and angular momentum, about which both are canonical.

    Attributes:
        shape: of `COORDINATES`.
        pace: of the rotation.
    """

    shape: str = "triangle"
    pace: float = 0.1

    is_free = False

    def put(self, assembly: Assembly, n: int, at: Conditions) -> None:
        frame = Frame(self.shape, self.pace, at)
        motion = Motion(ALONG_X, (False, False, True))
        kind = BodyType(f"driven {self.shape}", frame.places, frame.masses, motion=motion)
        angles = assembly.rng.uniform(0, 2 * np.pi, n)
        atoms = assembly.add(assembly.scatter(frame.places @ np.swapaxes(_about_z(angles), 1, 2)), frame.masses)
        assembly.types[kind] = atoms.tolist()
        assembly.freedoms -= n * (3 * len(frame.masses) - kind.dof)
        mass = frame.masses.sum()
        thermal = [math.sqrt(each * at.thermal) for each in (mass, frame.moments[2])]
        # The means are near the thermal momenta.
        pushes = [(1 - kept) * each for kept, each in zip(at.keeps, thermal, strict=True)]
        shares = np.tile(frame.masses / mass, n)
        add_external(assembly, f"{-pushes[0] / at.step!r}*share*x", atoms, shares, names=("share",))
        # The energy has a jump, and the torque none.
        torque = openmm.CustomCompoundBondForce(2, f"{-pushes[1] / at.step!r}*atan2(y2-y1, x2-x1)")
        for molecule in atoms.tolist():
            torque.addBond(molecule[:2], [])
        assembly.system.addForce(torque)

        def observe(x, v):
            p = (frame.masses @ v)[..., 0] / thermal[0]
            L = angular_momentum(frame.masses, x, v)[..., 2] / thermal[1]
            return {"p": p, "p^2": p**2, "L": L, "L^2": L**2}

        exact = {}
        for name, kept in zip("pL", at.keeps, strict=True):
            mean = (1 - kept) * at.pushed(kept)
            exact |= {name: Exact(mean), f"{name}^2": Exact(1 + mean**2)}
        assembly.parts.append(Part(atoms, observe, exact, 1.0))


def _turns(rng, arm: np.ndarray, strength: float, n: int, is_flat: bool) -> np.ndarray:
    """Return rotations (n, 3, 3) from the frame to the lab for dipoles along `arm` in a field."""
    if not is_flat:
        return _towards(rng, arm, _cosines(rng, strength, n))
    return _about_z(rng.vonmises(0.0, strength, n) - math.atan2(arm[1], arm[0]))


def _about_z(angles: np.ndarray) -> np.ndarray:
    """Return rotations (n, 3, 3) by angles about z."""
    turns = np.zeros((len(angles), 3, 3))
    turns[:, 0, 0] = turns[:, 1, 1] = np.cos(angles)
    turns[:, 1, 0] = np.sin(angles)
    turns[:, 0, 1] = -turns[:, 1, 0]
    turns[:, 2, 2] = 1.0
    return turns


def _angular_velocity(frame: Frame, x: np.ndarray, L: np.ndarray) -> np.ndarray:
    """Return angular velocities in the lab frame, (..., 3)."""
    if frame.moments[0] == 0:
        return L / frame.moments[-1]
    attitudes = frame.attitudes(x)
    in_frame = (L[..., None, :] @ attitudes)[..., 0, :] / frame.moments
    return (attitudes @ in_frame[..., None])[..., 0]
