"""Unconstrained bonds and librations, and the steps at which they are stable."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import RigidBodies
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.system import tables
from openmm_sier.system.bonded_terms import harmonic_bonds
from openmm_sier.system.find_bodies import HYDROGEN_GROUPS
from openmm_sier.system.librations import HEATING, HOPELESS, Libration, fastest_librations
from openmm_sier.system.notices import tell

#: Longest step, as a fraction of the period of a bond whose forces act within drifts.
RESONANCE = 0.45

#: From this step in ps on, a number in fs has more likely been given than a step of picoseconds been meant.
SLIP = 0.5

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
    """The fastest unconstrained bonds and librations of a System, and whether a step is short enough for them.

    Of bonded forces only the System's HarmonicBondForces are looked at, as they are when the Context is created. Each
    bond is treated on its own, which gives its period to 1 % for hydrogens; bonds between heavy atoms that share an
    atom (CO2) vibrate up to a quarter faster. Angles are ignored: those of hydrogens are slower than bonds by a factor
    of two. The energy of a CustomBondForce, or of any other force, is an expression, from which no period can be read.
    Librations are estimates, see `librations`.
    """

    def __init__(self, system: openmm.System, bodies: RigidBodies):
        """
        Args:
            system: openmm.System.
            bodies: its bodies. Bonds inside them do not count, nor do those that constraints hold.
        """
        self._bodies = bodies
        mobility = mobilities(bodies)
        self._bonds = list(_fastest_bonds(system, bodies, mobility))
        self._librations = fastest_librations(system, bodies, mobility)
        self._warned = False

    def check(self, scheme: Scheme, h: float, groups: int) -> None:
        """Refuse a step at which the fastest bond is unstable; warn, once, if its energy is wrong by a tenth.

        The same holds for librations, whose frequencies are estimates: steps are refused for them only from twice the
        stability limit on.

        Args:
            scheme: the scheme that makes the step.
            h: the step, ps.
            groups: bit mask of the force groups that act in it.

        Raises:
            openmm.OpenMMException: the step is beyond the scheme's stability limit.
        """
        self._check("A step", scheme, h, groups, SHORTER_STEP)
        self._check_libration(scheme, h, groups)

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
        bond = _fastest(self._bonds, groups)
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
        slow = _fastest(self._bonds, groups), _fastest(self._librations, groups)
        limits = [_limits(scheme, motion.period)[1] for motion in slow if motion is not None]
        within = _fastest(self._bonds, fast)
        return min([*limits, *([RESONANCE * within.period] if within else [])], default=math.inf)

    def _check(self, what: str, scheme: Scheme, h: float, groups: int, remedy: str) -> None:
        bond = _fastest(self._bonds, groups)
        if bond is None:
            return
        stable, accurate = _limits(scheme, bond.period)
        described = (
            f"{self._name(bond)} is not constrained and has a period of {_fs(bond.period)}. {scheme.name} follows it "
            f"accurately with steps of up to {_fs(accurate)}, and is unstable from {_fs(stable)} on. {remedy}, or "
            f"{CONSTRAIN}"
        )
        if h >= stable:
            raise openmm.OpenMMException(f"{what} of {_fs(h)} is too long: {described}")
        if h > accurate:
            self._tell_once(f"{what} of {_fs(h)} is long: {described}")

    def _check_libration(self, scheme: Scheme, h: float, groups: int) -> None:
        libration = _fastest(self._librations, groups)
        if libration is None:
            return
        stable, accurate = _limits(scheme, libration.period)
        body = self._bodies.describe(int(self._bodies.owners[libration.atom]))
        described = (
            f"other molecules can make {body} swing with a period of {_fs(libration.period)}. {scheme.name} follows "
            f"that accurately with steps of up to {_fs(accurate)}, and liquids heat up from about "
            f"{_fs(max(accurate, HEATING * stable))} on"
        )
        if h >= HOPELESS * stable:
            slip = f". A number is a time in ps: for {h:g} fs give {h:g}*unit.femtoseconds" if h >= SLIP else ""
            raise openmm.OpenMMException(f"A step of {_fs(h)} is too long: {described}{slip}")
        if h > accurate:
            self._tell_once(f"A step of {_fs(h)} is long: {described}. Take a shorter step")

    def _name(self, bond: Bond) -> str:
        labels = self._bodies.labels
        residues = "" if labels is None else f" ({' and '.join(dict.fromkeys(labels[i] for i in bond.atoms))})"
        return f"the bond between atoms {bond.atoms[0]} and {bond.atoms[1]}{residues}"

    def _tell_once(self, message: str) -> None:
        if not self._warned:
            self._warned = True
            tell(message)


def _limits(scheme: Scheme, period: float) -> tuple[float, float]:
    """Steps in ps at which a motion becomes unstable, and up to which its energies are right within a tenth."""
    return scheme.stability_limit * period / (2 * math.pi), scheme.accuracy_limit * period / (2 * math.pi)


def _fs(time: float) -> str:
    return f"{1000 * time:.3g} fs" if time < 1 else f"{time:.4g} ps"


Motion = TypeVar("Motion", Bond, Libration)


def _fastest(motions: Sequence[Motion], groups: int) -> Motion | None:
    """The motion of shortest period in force groups, a bit mask; None if there is none."""
    return min((motion for motion in motions if groups >> motion.group & 1), default=None)


def _fastest_bonds(system: openmm.System, bodies: RigidBodies, mobility: np.ndarray) -> Iterator[Bond]:
    """Of each HarmonicBondForce the bond of shortest period between two bodies that no constraint holds."""
    forces = [force for force in system.getForces() if isinstance(force, openmm.HarmonicBondForce)]
    for force in [force for force in forces if force.getNumBonds()]:
        ends, strength = harmonic_bonds(force)
        held, owner = tables.constraints(system).by_pair(), bodies.owners[ends]
        apart = (owner[:, 0] != owner[:, 1]) | (owner[:, 0] < 0)
        apart &= np.array([pair not in held for pair in map(tuple, np.sort(ends, axis=1).tolist())])
        squares = apart * strength * mobility[ends].sum(axis=1)
        fastest = int(squares.argmax())
        if squares[fastest] > 0:
            a, b = ends[fastest].tolist()
            yield Bond(2 * math.pi / math.sqrt(squares[fastest]), (a, b), force.getForceGroup())


def mobilities(bodies: RigidBodies) -> np.ndarray:
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
