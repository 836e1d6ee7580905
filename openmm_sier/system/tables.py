"""Masses and constraints of a System as arrays.

Every call reads the System, which users may change between Contexts. OpenMM returns each value as a quantity, so that a
million atoms take seconds; inside `read_once` each System is read only once.
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


class Constraints(NamedTuple):
    """Distinct constraints.

    Attributes:
        pairs: particle indices, the smaller first, (c, 2).
        lengths: constrained distances, (c,), nm.
    """

    pairs: np.ndarray
    lengths: np.ndarray

    def by_pair(self) -> dict[tuple[int, int], float]:
        """Return a mapping from pairs of particles, the smaller first, to lengths in nm."""
        return dict(zip(map(tuple, self.pairs.tolist()), self.lengths.tolist(), strict=True))

    def lengths_of(self, pairs: np.ndarray) -> np.ndarray:
        """Return the constrained distance of each pair of particles, (m, 2), in nm, (m,); NaN without a constraint."""
        if not len(self.pairs):
            return np.full(len(pairs), np.nan)
        base = int(max(self.pairs.max(), pairs.max(initial=0))) + 1
        numbers, wanted = self.pairs @ [base, 1], np.sort(pairs, axis=1) @ [base, 1]
        order = np.argsort(numbers)
        places = order[np.searchsorted(numbers, wanted, sorter=order).clip(max=len(order) - 1)]
        return np.where(numbers[places] == wanted, self.lengths[places], np.nan)

    def hold(self, kinds: Iterable[np.ndarray]) -> list[np.ndarray]:
        """Return whether every distance within each cluster of particles is constrained, (m,), for kinds of (m, k)."""
        constrained = self.by_pair()
        return [
            np.array([all(pair in constrained for pair in combinations(sorted(row), 2)) for row in kind.tolist()], bool)
            for kind in kinds
        ]


#: Maximum mass of a hydrogen, also after mass repartitioning, dalton.
HEAVIEST_HYDROGEN = 4.5

#: Maximum mass in dalton given to hydrogens of an atom that is bonded to another heavy atom, since the lighter atom
#: makes that bond faster. With 4 the bonds of aromatic carbons would have a period of 21.3 fs instead of 22.4, too
#: short for kicks every 10 fs; bonds of methyl carbons would become 1.6 instead of 1.2 times as fast, and
#: LangevinMiddle would fail at steps of 5 fs. Water has no such bonds.
HEAVIEST_IN_CHAINS = 3.0

#: Units of charge, sigma and epsilon of atoms, and of exceptions, in a NonbondedForce.
ATOM_UNITS = (unit.elementary_charge, unit.nanometer, unit.kilojoule_per_mole)
PAIR_UNITS = (unit.elementary_charge**2, unit.nanometer, unit.kilojoule_per_mole)


def numbers(quantities: Iterable[unit.Quantity], units: Iterable[unit.Unit]) -> np.ndarray:
    """Return the values of quantities in the given units."""
    return np.array([quantity.value_in_unit(one) for quantity, one in zip(quantities, units, strict=True)])


Table = TypeVar("Table")

#: Cache of `read_once`: (function name, System address) -> (System, table). Holding the System keeps its address
#: unique. None outside the block.
_read: ContextVar[dict[tuple[str, int], tuple[openmm.System, Any]] | None] = ContextVar("read", default=None)


@contextmanager
def read_once() -> Iterator[None]:
    """Context manager inside which each System is read only once, and must not change."""
    token = _read.set({} if _read.get() is None else _read.get())
    try:
        yield
    finally:
        _read.reset(token)


def _once(read: Callable[[openmm.System], Table]) -> Callable[[openmm.System], Table]:
    """Decorator that caches a function of a System inside `read_once`."""

    @wraps(read)
    def cached(system: openmm.System) -> Table:
        cache = _read.get()
        if cache is None:
            return read(system)
        key = read.__name__, int(system.this)
        if key not in cache:
            cache[key] = system, read(system)
        return cache[key][1]

    return cached


def atom_parameters(force: openmm.NonbondedForce) -> np.ndarray:
    """Return charge in e, sigma in nm and epsilon in kJ/mol of each particle of a NonbondedForce, (N, 3)."""
    # OpenMM returns these units; converting each quantity would take ten times as long.
    rows = map(force.getParticleParameters, range(force.getNumParticles()))
    return np.fromiter(
        ((charge._value, sigma._value, epsilon._value) for charge, sigma, epsilon in rows), np.dtype((float, 3))
    )


@_once
def masses(system: openmm.System) -> np.ndarray:
    """Return masses of all particles, (N,), dalton; 0 for virtual sites and frozen atoms."""
    # OpenMM returns dalton and nm; converting each quantity would take ten times as long.
    quantities = map(system.getParticleMass, range(system.getNumParticles()))
    return np.fromiter((mass._value for mass in quantities), float)


@_once
def constraints(system: openmm.System) -> Constraints:
    """Return the acting constraints in the System's order, without repeated ones.

    Constraints between frozen atoms do not act, and OpenMM refuses those between a frozen and a moving atom.
    """
    # An iterator, since a list of all quantities would take most of the memory.
    parameters = map(system.getConstraintParameters, range(system.getNumConstraints()))
    rows = np.fromiter(((a, b, length._value) for a, b, length in parameters), np.dtype((float, 3)))
    pairs, lengths = np.sort(rows[:, :2].astype(np.int64), axis=1), rows[:, 2]
    acting = (masses(system)[pairs] > 0).all(axis=1)
    pairs, lengths = pairs[acting], lengths[acting]
    _, first = np.unique(pairs @ [system.getNumParticles(), 1], return_index=True)
    distinct = np.sort(first)
    return Constraints(pairs[distinct], lengths[distinct])


@_once
def frozen_atoms(system: openmm.System) -> np.ndarray:
    """Return massless particles that are not virtual sites, (f,): they exert forces but do not move."""
    return np.array([i for i in np.flatnonzero(masses(system) == 0).tolist() if not system.isVirtualSite(i)], dtype=int)


@_once
def rigid_sites(system: openmm.System) -> dict[int, list[int]]:
    """Return the particles that place each virtual site; without sites that depend on the box too."""
    massless = np.flatnonzero(masses(system) == 0).tolist()
    sites = {i: system.getVirtualSite(i) for i in massless if system.isVirtualSite(i)}
    return {
        i: [site.getParticle(k) for k in range(site.getNumParticles())]
        for i, site in sites.items()
        if not isinstance(site, openmm.SymmetrySite)
    }


def has_virtual_sites(system: openmm.System) -> bool:
    """Return whether a System has virtual sites."""
    return any(map(system.isVirtualSite, range(system.getNumParticles())))


def with_sites(system: openmm.System, owner: np.ndarray) -> np.ndarray:
    """Return the body of each particle, (N,), where a virtual site placed by particles of one body belongs to it.

    Args:
        system: openmm.System.
        owner: body index of each particle, (N,); -1 without a body.
    """
    extended, sites = owner.copy(), rigid_sites(system)
    # Sites may be placed by other sites, which follow or precede them.
    changed = bool(sites)
    while changed:
        changed = False
        for site, particles in sites.items():
            owners = {int(extended[i]) for i in particles}
            if extended[site] < 0 and len(owners) == 1 and -1 not in owners:
                extended[site] = owners.pop()
                changed = True
    return extended
