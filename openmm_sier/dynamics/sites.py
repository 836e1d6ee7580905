"""Which atoms make up bodies, and where in the bodies they are."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np


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


class Sites:
    """The atoms of all bodies, in tables for kernels.

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
