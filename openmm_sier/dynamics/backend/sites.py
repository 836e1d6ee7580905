"""Which atoms make up bodies, and where in the bodies they are."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np


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
    def columns(self) -> list[slice | np.ndarray]:
        """For each site, what picks its atoms out of an array of particles: a slice where the spacing is even."""
        return [_as_slice(column) for column in self.atoms.T]

    @cached_property
    def ones(self) -> np.ndarray:
        """(k,), the weights of a plain sum over the atoms."""
        return np.ones(self.atoms.shape[1])

    @cached_property
    def extents(self) -> tuple[list[int], np.ndarray]:
        """The principal axes along which the body extends, and for each site 1 and its coordinates on those."""
        axes = np.flatnonzero(self.places.any(axis=1)).tolist()
        return axes, np.vstack([self.ones, self.places[axes]])


def _as_slice(indices: np.ndarray) -> slice | np.ndarray:
    if indices.size == 1:
        return slice(int(indices[0]), int(indices[0]) + 1)
    step = int(indices[1] - indices[0]) if indices.size else 0
    if step > 0 and np.all(np.diff(indices) == step):
        return slice(int(indices[0]), int(indices[-1]) + 1, step)
    return indices
