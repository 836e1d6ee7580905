"""Contents of a System as arrays: masses, constraints, virtual sites, parameters of Forces.

Users may change a System between two calls, so that every call reads it. Inside `read_once`, which lasts as long as one
call by a user, each table is made once, and everything that derives from it takes it from here.

Tables are read by the compiled functions beneath OpenMM's methods. The methods attach a unit to each number, which
takes three times as long; OpenMM's XML takes twice as long. Units are dalton, nm, kJ/mol, e and radians.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from itertools import combinations, repeat
from typing import Any, NamedTuple, TypeVar

import numpy as np
import openmm
from openmm import _openmm


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
        clusters = list(kinds)
        held: list[np.ndarray] = [np.empty(0, dtype=bool)] * len(clusters)
        # All kinds of one size at once: there may be thousands.
        by_size: dict[int, list[int]] = {}
        for number, kind in enumerate(clusters):
            by_size.setdefault(kind.shape[1], []).append(number)
        degree = np.bincount(self.pairs.ravel(), minlength=1)
        for numbers in by_size.values():
            together = self._hold(np.concatenate([clusters[number] for number in numbers]), degree)
            ends = np.cumsum([len(clusters[number]) for number in numbers])
            for number, part in zip(numbers, np.split(together, ends[:-1]), strict=True):
                held[number] = part
        return held

    def _hold(self, clusters: np.ndarray, degree: np.ndarray) -> np.ndarray:
        """Return whether every distance within each cluster (m, k) is constrained, (m,).

        Args:
            clusters: particle indices.
            degree: number of constraints of the particles up to the last constrained one.
        """
        size = clusters.shape[1]
        degrees = np.where(clusters < len(degree), degree[clusters.clip(max=len(degree) - 1)], 0)
        # Large bodies, which have too many pairs to list them, have fewer constraints.
        held = (degrees >= size - 1).all(axis=1)
        if size > 1 and held.any():
            pairs = clusters[held][:, np.array(list(combinations(range(size), 2)))]
            lengths = self.lengths_of(pairs.reshape(-1, 2)).reshape(len(pairs), -1)
            held[held] = ~np.isnan(lengths).any(axis=1)
        return held


#: Maximum mass of a hydrogen, also after mass repartitioning, dalton.
HEAVIEST_HYDROGEN = 4.5

#: Maximum mass in dalton given to hydrogens of an atom that is bonded to another heavy atom, since the lighter atom
#: makes that bond faster. With 4 the bonds of aromatic carbons would have a period of 21.3 fs instead of 22.4, too
#: short for kicks every 10 fs; bonds of methyl carbons would become 1.6 instead of 1.2 times as fast, and
#: LangevinMiddle would fail at steps of 5 fs. Water has no such bonds.
HEAVIEST_IN_CHAINS = 3.0

Table = TypeVar("Table")

#: A System or a Force.
Source = TypeVar("Source", openmm.System, openmm.Force)

#: Cache of `read_once`: (name of the function, address of its argument) -> (argument, table). Holding a System keeps
#: its address unique. None outside the block.
_read: ContextVar[dict[tuple[str, int], tuple[Any, Any]] | None] = ContextVar("read", default=None)


@contextmanager
def read_once() -> Iterator[None]:
    """Context manager inside which each System and Force is read only once, and must not change without `forget`."""
    token = _read.set({} if _read.get() is None else _read.get())
    try:
        yield
    finally:
        _read.reset(token)


def forget() -> None:
    """Read everything again inside `read_once`, since a System was changed."""
    cache = _read.get()
    if cache is not None:
        cache.clear()


def once(read: Callable[[Source], Table]) -> Callable[[Source], Table]:
    """Decorator that caches a function of a System or a Force inside `read_once`; arrays cannot be written."""
    name = f"{read.__module__}.{read.__qualname__}"

    @wraps(read)
    def cached(source: Source) -> Table:
        cache = _read.get()
        if cache is None:
            return _fixed(read(source))
        key = name, int(source.this)
        if key not in cache:
            cache[key] = source, _fixed(read(source))
        return cache[key][1]

    return cached


def _fixed(table: Table) -> Table:
    """Return an array, or a tuple of arrays, that cannot be written."""
    for array in table if isinstance(table, tuple) else (table,):
        if isinstance(array, np.ndarray):
            array.flags.writeable = False
    return table


def rows(source: Any, method: str, count: int) -> Iterator[Any]:
    """Iterate over what a method of a System or Force returns for the indices from 0 to `count`, without units.

    Args:
        source: openmm.System or openmm.Force.
        method: name of a method of an index.
        count: number of rows.
    """
    return map(compiled(source, method), repeat(source), range(count))


def compiled(source: Any, method: str) -> Callable[..., Any]:
    """Return the compiled function beneath a method of a System or Force, which takes it first, and no units."""
    names = [f"{cls.__name__}_{method}" for cls in type(source).__mro__]
    return next(getattr(_openmm, name) for name in names if hasattr(_openmm, name))


def numeric_rows(source: Any, method: str, count: int, columns: int) -> np.ndarray:
    """Return `rows` of numbers, (count, columns)."""
    return np.fromiter(rows(source, method, count), np.dtype((float, columns)), count)


@once
def atom_parameters(force: openmm.NonbondedForce) -> np.ndarray:
    """Return charge in e, sigma in nm and epsilon in kJ/mol of each particle of a NonbondedForce, (N, 3)."""
    return numeric_rows(force, "getParticleParameters", force.getNumParticles(), 3)


@once
def exceptions(force: openmm.NonbondedForce) -> tuple[np.ndarray, np.ndarray]:
    """Return the exceptions of a NonbondedForce.

    Returns:
        Their particles, (x, 2), and charge products in e^2, sigma in nm and epsilon in kJ/mol, (x, 3).
    """
    table = numeric_rows(force, "getExceptionParameters", force.getNumExceptions(), 5)
    return table[:, :2].astype(np.int64), table[:, 2:]


@once
def masses(system: openmm.System) -> np.ndarray:
    """Return masses of all particles, (N,), dalton; 0 for virtual sites and frozen atoms."""
    count = system.getNumParticles()
    return np.fromiter(rows(system, "getParticleMass", count), float, count)


@once
def constraints(system: openmm.System) -> Constraints:
    """Return the acting constraints in the System's order, without repeated ones.

    Constraints between frozen atoms do not act, and OpenMM refuses those between a frozen and a moving atom.

    Raises:
        openmm.OpenMMException: a constraint has a particle that does not exist, of which OpenMM speaks only when a
            Context is made, or a length that is not positive, of which it never speaks.
    """
    table = numeric_rows(system, "getConstraintParameters", system.getNumConstraints(), 3)
    pairs, lengths = np.sort(table[:, :2].astype(np.int64), axis=1), table[:, 2]
    count = system.getNumParticles()
    wrong = (pairs < 0) | (pairs >= count)
    if wrong.any():
        number = int(wrong.any(axis=1).argmax())
        raise openmm.OpenMMException(
            f"Constraint {number} has particle {pairs[number][wrong[number]][0]}, and the System has {count} "
            "particles, from 0 on: correct it with system.setConstraintParameters, or add the particles first"
        )
    acting = (masses(system)[pairs] > 0).all(axis=1)
    pairs, lengths = pairs[acting], lengths[acting]
    is_length = (lengths > 0) & (lengths < np.inf)
    if not is_length.all():
        first = is_length.argmin()
        (i, j), length = pairs[first], lengths[first]
        raise openmm.OpenMMException(f"The constraint of atoms {i} and {j} has a length of {length:g} nm, not above 0")
    distinct = first_of_each(pairs)
    return Constraints(pairs[distinct], lengths[distinct])


def first_of_each(pairs: np.ndarray) -> np.ndarray:
    """Return the places of distinct pairs of particles (m, 2) where each occurs first, ascending."""
    _, first = np.unique(pairs @ [int(pairs.max(initial=0)) + 1, 1], return_index=True)
    return np.sort(first)


@once
def virtual_sites(system: openmm.System) -> np.ndarray:
    """Return the virtual sites, ascending, (v,). OpenMM makes no Context of a System in which one has a mass."""
    massless = np.flatnonzero(masses(system) == 0)
    return massless[np.fromiter(map(system.isVirtualSite, massless.tolist()), bool, len(massless))]


@once
def frozen_atoms(system: openmm.System) -> np.ndarray:
    """Return massless particles that are not virtual sites, (f,): unless a body moves them, they do not move."""
    return np.setdiff1d(np.flatnonzero(masses(system) == 0), virtual_sites(system), assume_unique=True)


def frozen_without(system: openmm.System, owner: np.ndarray) -> np.ndarray:
    """Return the frozen atoms of a System that are in no body, (f,), for the body of each particle, (N,), or -1."""
    frozen = frozen_atoms(system)
    return frozen[owner[frozen] < 0]


@once
def rigid_sites(system: openmm.System) -> dict[int, list[int]]:
    """Return the particles that place each virtual site; without sites that depend on the box too."""
    sites = {i: system.getVirtualSite(i) for i in virtual_sites(system).tolist()}
    return {
        i: [site.getParticle(k) for k in range(site.getNumParticles())]
        for i, site in sites.items()
        if not isinstance(site, openmm.SymmetrySite)
    }


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
