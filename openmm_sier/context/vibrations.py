"""Bonds that nothing holds, and the step that they bear."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import openmm

from openmm_sier.context.find_bodies import HYDROGEN_GROUPS
from openmm_sier.context.notices import tell
from openmm_sier.dynamics.bodies import RigidBodies
from openmm_sier.dynamics.schemes import Scheme


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

    Only the System's HarmonicBondForces are looked at, as they are when the Context is created. Each bond is taken
    alone, which gives its period to 1 % for hydrogens; bonds between heavy atoms that share one (CO2) vibrate up to a
    quarter faster. Angles are ignored: those of hydrogens are slower than bonds by a factor of two. The energy of a
    CustomBondForce, or of any other force, is an expression, from which no period can be read.
    """

    def __init__(self, system, bodies: RigidBodies):
        """
        Args:
            system: openmm.System.
            bodies: its bodies. Bonds inside them do not count.
        """
        self._bodies = bodies
        forces = [force for force in system.getForces() if isinstance(force, openmm.HarmonicBondForce)]
        forces = [force for force in forces if force.getNumBonds()]
        self._bonds: list[Bond] = []
        if forces:
            owner, mobility = bodies.owners, _mobilities(bodies)
            found = [_fastest(force, owner, mobility) for force in forces]
            self._bonds = sorted(bond for bond in found if bond is not None)
        self._warned = False

    def check(self, scheme: Scheme, h: float, groups: int) -> None:
        """Refuse a step at which the fastest bond is unstable; warn, once, where its energy is wrong by a tenth.

        Args:
            scheme: the scheme that makes the step.
            h: the step, ps.
            groups: bit mask of the force groups that act.

        Raises:
            openmm.OpenMMException: the step is beyond the scheme's stability limit.
        """
        bond = next((bond for bond in self._bonds if groups >> bond.group & 1), None)
        if bond is None:
            return
        stable, accurate = (limit * bond.period / (2 * math.pi) for limit in _limits(scheme))
        if h >= stable:
            raise openmm.OpenMMException(f"A step of {_fs(h)} is too long: {self._describe(bond, scheme)}")
        if h > accurate and not self._warned:
            self._warned = True
            tell(f"A step of {_fs(h)} is long: {self._describe(bond, scheme)}")

    def _describe(self, bond: Bond, scheme: Scheme) -> str:
        stable, accurate = (_fs(limit * bond.period / (2 * math.pi)) for limit in _limits(scheme))
        return (
            f"the bond between {_names(bond.atoms, self._bodies.labels)} is not constrained and has a period of "
            f"{_fs(bond.period)}, which {scheme.name} follows with steps of up to {accurate} and bears with less than "
            f"{stable}. Take a shorter step, or hold the bond in a rigid body: water by rigidWater=True in "
            "createSystem, other hydrogens by bodies=RigidBodies.from_system(system, topology, "
            f'rigid="{HYDROGEN_GROUPS}", positions=positions)'
        )


def _limits(scheme: Scheme) -> tuple[float, float]:
    return scheme.stability_limit, scheme.accuracy_limit


def _names(atoms: tuple[int, int], labels) -> str:
    residues = "" if labels is None else f" ({' and '.join(dict.fromkeys(labels[i] for i in atoms))})"
    return f"atoms {atoms[0]} and {atoms[1]}{residues}"


def _fs(time: float) -> str:
    return f"{1000 * time:.3g} fs"


def _fastest(force, owner, mobility) -> Bond | None:
    """The bond of the shortest period between two bodies, if there is one."""
    count = force.getNumBonds()
    ends, strength = np.empty((count, 2), dtype=np.int64), np.empty(count)
    for i in range(count):
        a, b, _, k = force.getBondParameters(i)
        ends[i], strength[i] = (a, b), k._value
    apart = (owner[ends[:, 0]] != owner[ends[:, 1]]) | (owner[ends[:, 0]] < 0)
    squares = apart * strength * mobility[ends].sum(axis=1)
    fastest = int(squares.argmax())
    if not squares[fastest] > 0:
        return None
    a, b = ends[fastest].tolist()
    return Bond(2 * math.pi / math.sqrt(squares[fastest]), (a, b), force.getForceGroup())


def _mobilities(bodies: RigidBodies):
    """For each particle the largest inverse of the mass in dalton that resists a force on it; 0 where it has no body.

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
