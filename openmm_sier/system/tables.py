"""Masses and constraints of a System as arrays.

They are read anew at each call, since users change them between Contexts. OpenMM gives them one by one, each as a
quantity, so that a million atoms take seconds; within `read_once` they are read a single time.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from itertools import combinations
from typing import Any, NamedTuple, TypeVar

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import RigidityError
from openmm_sier.system.geometries import EMBEDDING_TOLERANCE


class Constraints(NamedTuple):
    """Distances that are held fixed.

    Attributes:
        pairs: particle indices, the smaller first, (c, 2); no pair is there twice.
        lengths: (c,), nm.
    """

    pairs: np.ndarray
    lengths: np.ndarray

    def by_pair(self) -> dict[tuple[int, int], float]:
        """Return lengths in nm by pairs of particles, the smaller first."""
        return dict(zip(map(tuple, self.pairs.tolist()), self.lengths.tolist(), strict=True))

    def hold(self, clusters: np.ndarray) -> np.ndarray:
        """Return for each cluster of particles, (m, k), whether every distance in it is fixed, (m,)."""
        held = self.by_pair()
        return np.array([all(pair in held for pair in combinations(sorted(row), 2)) for row in clusters.tolist()], bool)


#: Dalton. The most that hydrogens may weigh, also those that were made heavier before.
HEAVIEST_HYDROGEN = 4.5

#: Dalton. The most that hydrogens get whose atom is bonded to another heavy atom, to which its loss matters. With 4
#: the bonds of aromatic carbons would have a period of 21.3 fs in place of 22.4, and bear no kicks every 10 fs; those
#: of a methyl's carbon would become 1.6 times as fast as they were, in place of 1.2, and LangevinMiddle fails at steps
#: of 5 fs. Water has no such bonds.
HEAVIEST_IN_CHAINS = 3.0

#: Units of the parameters of atoms, and of exceptions, in a NonbondedForce: charge, sigma and epsilon.
ATOM_UNITS = (unit.elementary_charge, unit.nanometer, unit.kilojoule_per_mole)
PAIR_UNITS = (unit.elementary_charge**2, unit.nanometer, unit.kilojoule_per_mole)


def numbers(quantities: Iterable[unit.Quantity], units: Iterable[unit.Unit]) -> np.ndarray:
    """Return quantities as numbers of units, one for each."""
    return np.array([quantity.value_in_unit(one) for quantity, one in zip(quantities, units, strict=True)])


Table = TypeVar("Table")

#: What was read within `read_once`, by the name of the function and the address of the System, with the System, whose
#: address must not become that of another; None outside.
_read: ContextVar[dict[tuple[str, int], tuple[openmm.System, Any]] | None] = ContextVar("read", default=None)


@contextmanager
def read_once() -> Iterator[None]:
    """Read masses and constraints of each System only once within the block, in which nobody may change them."""
    token = _read.set({} if _read.get() is None else _read.get())
    try:
        yield
    finally:
        _read.reset(token)


def _once(read: Callable[[openmm.System], Table]) -> Callable[[openmm.System], Table]:
    """Let a function of a System give what it gave before, within `read_once`."""

    @wraps(read)
    def found(system: openmm.System) -> Table:
        known = _read.get()
        if known is None:
            return read(system)
        key = read.__name__, int(system.this)
        if key not in known:
            known[key] = system, read(system)
        return known[key][1]

    return found


def atom_parameters(force: openmm.NonbondedForce) -> np.ndarray:
    """Return charge in e, sigma in nm and epsilon in kJ/mol of each particle of a NonbondedForce, (N, 3)."""
    # OpenMM gives these units. To convert those of each quantity would take ten times as long.
    rows = map(force.getParticleParameters, range(force.getNumParticles()))
    return np.fromiter(
        ((charge._value, sigma._value, epsilon._value) for charge, sigma, epsilon in rows), np.dtype((float, 3))
    )


@_once
def masses(system: openmm.System) -> np.ndarray:
    """Return masses of all particles, (N,), dalton; 0 for virtual sites and for atoms that are frozen."""
    # OpenMM gives dalton and nm. To convert the units of each quantity would take ten times as long.
    found = map(system.getParticleMass, range(system.getNumParticles()))
    return np.fromiter((mass._value for mass in found), float)


@_once
def constraint_rows(system: openmm.System) -> np.ndarray:
    """Return all constraints as the System has them, (c, 3): two particles, and the length in nm."""
    # An iterator, since a list of all quantities would be the largest thing in memory.
    found = map(system.getConstraintParameters, range(system.getNumConstraints()))
    return np.fromiter(((a, b, length._value) for a, b, length in found), np.dtype((float, 3)))


@_once
def constraints(system: openmm.System) -> Constraints:
    """Return the constraints that act, in the System's order: those between two frozen atoms do not, as in OpenMM.

    Raises:
        RigidityError: a constraint joins an atom with mass to one without, which OpenMM refuses too, or a pair of atoms
            has two lengths.
    """
    rows = constraint_rows(system)
    pairs, lengths = np.sort(rows[:, :2].astype(np.int64), axis=1), rows[:, 2]
    frozen = masses(system)[pairs] == 0
    if (wrong := np.flatnonzero(frozen[:, 0] != frozen[:, 1])).size:
        row = int(wrong[0])
        still, moving = pairs[row][np.argsort(~frozen[row])].tolist()
        raise RigidityError(
            f"a constraint joins atom {moving} to atom {still}, which has no mass; OpenMM refuses that. Give both a "
            f"mass, or freeze both with mass 0; if atom {still} is a virtual site, remove the constraint"
        )
    acting = ~frozen.any(axis=1)
    pairs, lengths = pairs[acting], lengths[acting]
    _, first, same = np.unique(pairs @ [system.getNumParticles(), 1], return_index=True, return_inverse=True)
    others = lengths[first[same]]
    if (wrong := np.flatnonzero(np.abs(lengths - others) > EMBEDDING_TOLERANCE)).size:
        (a, b), other, length = pairs[wrong[0]], others[wrong[0]], lengths[wrong[0]]
        raise RigidityError(
            f"the constraints of atoms {a} and {b} contradict each other: one has the length {other:.4f} nm, the "
            f"other {length:.4f} nm. Remove one of them"
        )
    kept = np.sort(first)
    return Constraints(pairs[kept], lengths[kept])


@_once
def frozen_atoms(system: openmm.System) -> np.ndarray:
    """Return particles without mass that are no virtual sites, (f,): they exert forces and do not move."""
    return np.array([i for i in np.flatnonzero(masses(system) == 0).tolist() if not system.isVirtualSite(i)], dtype=int)
