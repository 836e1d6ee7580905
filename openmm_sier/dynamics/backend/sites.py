"""Which atoms make up bodies, and where in the bodies they are.

Bodies have centres q, momenta p and angular momenta L, (3, n), and attitudes A, (3, 3, n). With small sets of bodies
the number of calls determines the cost, so that sites are handled one by one, and all bodies at once.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from openmm_sier.dynamics.backend.formulas import combine


@dataclass(frozen=True, eq=False)
class Sites:
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


def as_slice(indices: np.ndarray) -> slice | np.ndarray:
    """Return indices, (k,), as a slice where their spacing is even: a slice of an array is no copy."""
    if indices.size == 1:
        return slice(int(indices[0]), int(indices[0]) + 1)
    step = int(indices[1] - indices[0]) if indices.size else 0
    if step > 0 and np.all(np.diff(indices) == step):
        return slice(int(indices[0]), int(indices[-1]) + 1, step)
    return indices
