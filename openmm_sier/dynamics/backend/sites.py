"""Tell which atoms make up bodies, and where in the bodies they are.

Bodies have centres q, momenta p and angular momenta L, (3, n), and attitudes A, (3, 3, n). With small sets of bodies
the number of calls determines the cost, so that sites are handled one by one, and all bodies at once.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from openmm_sier.dynamics.backend.formulas import combine


@dataclass(frozen=True, eq=False)
class AlikeSites:
    """The atoms of bodies that share one geometry.

    Attributes:
        part: which of all bodies they are.
        atoms: particle indices, (m, k): m bodies of k atoms.
        places: atom positions in the principal frame, (3, k), nm.
    """

    part: slice
    atoms: np.ndarray
    places: np.ndarray

    @cached_property
    def _columns(self) -> list[slice | np.ndarray]:
        """Return for each site the index of its atoms in arrays of particles: a slice where the spacing is even."""
        return [as_slice(column) for column in self.atoms.T]

    def arms(self, A: np.ndarray) -> Iterator[tuple[slice | np.ndarray, np.ndarray]]:
        """Return for each site the index of its atoms, and their places relative to the centres, (3, m)."""
        x, y, z = A[:, :, self.part]
        for column, place in zip(self._columns, self.places.T, strict=True):
            yield column, combine(place, x, y, z)


class Sites:
    """The atoms of all bodies, set by set for NumPy, and in tables for compiled loops over all sets.

    Attributes:
        alike: sets of bodies, one after the other.
        sets: for each set its first body and the end of its bodies, the number of atoms of each body, and where the
            set begins in `places` and in `atoms`, (m, 5).
        places: atom positions in the principal frame, once for each set, (3, k), nm.
        atoms: particle indices, body by body.
        ones: for each of `places` the weight 1, (k,).
    """

    def __init__(self, alike: Sequence[AlikeSites]) -> None:
        self.alike = tuple(alike)
        sizes = [each.atoms.shape[1] for each in alike]
        places, atoms = np.cumsum([0, *sizes]), np.cumsum([0, *(each.atoms.size for each in alike)])
        rows = zip(alike, sizes, places[:-1], atoms[:-1], strict=True)
        self.sets = np.array([(each.part.start, each.part.stop, *row) for each, *row in rows], np.int64).reshape(-1, 5)
        self.places = np.concatenate([np.empty((3, 0)), *(each.places for each in alike)], axis=1)
        self.atoms = np.concatenate([np.empty(0, np.int64), *(each.atoms.ravel() for each in alike)], dtype=np.int64)
        self.ones = np.ones(self.places.shape[1])

    def at(self, atoms: np.ndarray) -> "Sites":
        """Return the places at which any body of a set has one of some atoms, and what these bodies have there."""
        found = []
        for each in self.alike:
            wanted = np.isin(each.atoms, atoms).any(axis=0)
            found.append(replace(each, atoms=each.atoms[:, wanted], places=each.places[:, wanted]))
        return Sites(found)

    def by_set(self, values: np.ndarray) -> list[np.ndarray]:
        """Divide values, one for each of `places`."""
        return [values[first : first + size] for _, _, size, first, _ in self.sets.tolist()]


def as_slice(indices: np.ndarray) -> slice | np.ndarray:
    """Return indices, (k,), as a slice where their spacing is even: a slice of an array is no copy."""
    if indices.size == 1:
        return slice(int(indices[0]), int(indices[0]) + 1)
    step = int(indices[1] - indices[0]) if indices.size else 0
    if step > 0 and np.all(np.diff(indices) == step):
        return slice(int(indices[0]), int(indices[-1]) + 1, step)
    return indices
