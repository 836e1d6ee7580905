"""Unconstrained bonds, and the step at which they are stable."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import RigidBodies
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.system.find_bodies import HYDROGEN_GROUPS, constraint_lengths
from openmm_sier.system.notices import tell

#: Longest step, as a fraction of the period of a bond whose forces act within drifts.
RESONANCE = 0.45

SHORTER_STEP = "Take a shorter step; or let bonds act within drifts, by prepare_system and fastForceGroups"
MORE_SUBSTEPS = "Take more substeps or a shorter step"
CONSTRAIN = (
    "hold the bond: by rigidWater=True and constraints=HBonds in createSystem, or hydrogens in rigid bodies with their "
    f'heavy atoms, by bodies=RigidBodies.from_system(system, topology, rigid="{HYDROGEN_GROUPS}", positions=positions)'
)


class Bond(NamedTuple):
    """A bond as a harmonic oscillator.

    Attributes:
        period: 2 pi sqrt(mu / k), ps.
        atoms: particle indices of its ends.
        group: the force group that it is in.
    """

    period: float
    atoms: tuple[int, int]
    group: int


class Vibrations:
    """The fastest unconstrained bonds of a System, and whether a step is short enough for them.

    Only the System's HarmonicBondForces are looked at, as they are when the Context is created. Each bond is treated on
    its own, which gives its period to 1 % for hydrogens; bonds between heavy atoms that share an atom (CO2) vibrate up
    to a quarter faster. Angles are ignored: those of hydrogens are slower than bonds by a factor of two. The energy of
    a CustomBondForce, or of any other force, is an expression, from which no period can be read.
    """

    def __init__(self, system: openmm.System, bodies: RigidBodies):
        """
        Args:
            system: openmm.System.
            bodies: its bodies. Bonds inside them do not count, nor do those that constraints hold.
        """
        self._bodies = bodies
        forces = [force for force in system.getForces() if isinstance(force, openmm.HarmonicBondForce)]
        forces = [force for force in forces if force.getNumBonds()]
        self._bonds: list[Bond] = []
        if forces:
            owner, mobility = bodies.owners, _mobilities(bodies)
            held = set(constraint_lengths(system))
            found = [_fastest(force, owner, mobility, held) for force in forces]
            self._bonds = sorted(bond for bond in found if bond is not None)
        self._warned = False

    def check(self, scheme: Scheme, h: float, groups: int) -> None:
        """Refuse a step at which the fastest bond is unstable; warn, once, if its energy is wrong by a tenth.

        Args:
            scheme: the scheme that makes the step.
            h: the step, ps.
            groups: bit mask of the force groups that act in it.

        Raises:
            openmm.OpenMMException: the step is beyond the scheme's stability limit.
        """
        self._check("A step", scheme, h, groups, SHORTER_STEP)

    def check_nested(self, inner: Scheme, inner_step: float, h: float, groups: int) -> None:
        """The same for fast forces within drifts, which must also not resonate with the kicks.

        Kicks excite a bond if they come once or twice a period: schemes are unstable for steps in windows just below
        half a period and a whole one. The width of these windows is the share of the slow forces in the stiffness of
        the bond.

        Args:
            inner: the scheme within drifts.
            inner_step: its longest step, ps.
            h: the step of the outer scheme, ps.
            groups: bit mask of the fast force groups.

        Raises:
            openmm.OpenMMException: the inner step is beyond the inner scheme's stability limit.
        """
        self._check("An inner step", inner, inner_step, groups, MORE_SUBSTEPS)
        bond = self._fastest_of(groups)
        if bond is not None and h > RESONANCE * bond.period:
            self._tell_once(
                f"A step of {_fs(h)} resonates with fast forces: {self._name(bond)} has a period of "
                f"{_fs(bond.period)}, of which kicks should come more than twice. Take a step of up to "
                f"{_fs(RESONANCE * bond.period)}, or {CONSTRAIN}"
            )

    def longest_step(self, scheme: Scheme, groups: int, fast: int) -> float:
        """The longest step without a warning, ps; infinite where no bond vibrates.

        Args:
            scheme: the scheme that makes the step.
            groups: bit mask of the force groups that act in its kicks.
            fast: bit mask of those that act within its drifts, with inner steps that are short enough.
        """
        slow, within = self._fastest_of(groups), self._fastest_of(fast)
        limits = [scheme.accuracy_limit * slow.period / (2 * math.pi)] if slow else []
        return min([*limits, *([RESONANCE * within.period] if within else [])], default=math.inf)

    def _check(self, what: str, scheme: Scheme, h: float, groups: int, remedy: str) -> None:
        bond = self._fastest_of(groups)
        if bond is None:
            return
        stable, accurate = (limit * bond.period / (2 * math.pi) for limit in _limits(scheme))
        described = (
            f"{self._name(bond)} is not constrained and has a period of {_fs(bond.period)}, which {scheme.name} "
            f"follows with steps of up to {_fs(accurate)} and bears with less than {_fs(stable)}. {remedy}, or "
            f"{CONSTRAIN}"
        )
        if h >= stable:
            raise openmm.OpenMMException(f"{what} of {_fs(h)} is too long: {described}")
        if h > accurate:
            self._tell_once(f"{what} of {_fs(h)} is long: {described}")

    def _fastest_of(self, groups: int) -> Bond | None:
        return next((bond for bond in self._bonds if groups >> bond.group & 1), None)

    def _name(self, bond: Bond) -> str:
        return f"the bond between {_names(bond.atoms, self._bodies.labels)}"

    def _tell_once(self, message: str) -> None:
        if not self._warned:
            self._warned = True
            tell(message)


def _limits(scheme: Scheme) -> tuple[float, float]:
    return scheme.stability_limit, scheme.accuracy_limit


def _names(atoms: tuple[int, int], labels: Sequence[str] | None) -> str:
    residues = "" if labels is None else f" ({' and '.join(dict.fromkeys(labels[i] for i in atoms))})"
    return f"atoms {atoms[0]} and {atoms[1]}{residues}"


def _fs(time: float) -> str:
    return f"{1000 * time:.3g} fs"


def _fastest(
    force: openmm.HarmonicBondForce, owner: np.ndarray, mobility: np.ndarray, held: set[tuple[int, int]]
) -> Bond | None:
    """The bond of shortest period between two bodies whose ends are not a pair in `held`; None if there is none."""
    count = force.getNumBonds()
    ends, strength = np.empty((count, 2), dtype=np.int64), np.empty(count)
    for i in range(count):
        a, b, _, k = force.getBondParameters(i)
        ends[i], strength[i] = (a, b), k._value
    apart = (owner[ends[:, 0]] != owner[ends[:, 1]]) | (owner[ends[:, 0]] < 0)
    apart &= np.array([pair not in held for pair in map(tuple, np.sort(ends, axis=1).tolist())])
    squares = apart * strength * mobility[ends].sum(axis=1)
    fastest = int(squares.argmax())
    if not squares[fastest] > 0:
        return None
    a, b = ends[fastest].tolist()
    return Bond(2 * math.pi / math.sqrt(squares[fastest]), (a, b), force.getForceGroup())


def _mobilities(bodies: RigidBodies) -> np.ndarray:
    """For each particle its largest inverse effective mass in any direction, 1/dalton; 0 for particles of no body.

    A force f at the site r of a body accelerates it there by f / M + I^-1 (r x f) x r.
    """
    mobility = np.zeros(bodies.n_particles)
    for species in bodies.species:
        x, y, z = species.sites
        zero = np.zeros_like(x)
        cross = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
        inverse = np.divide(1.0, species.moments, out=np.zeros(3), where=species.moments > 0)
        turning = np.einsum("kax,a,kay->kxy", cross, inverse, cross)
        mobility[species.atoms] = 1 / species.mass + np.linalg.eigvalsh(turning)[:, -1]
    return mobility
