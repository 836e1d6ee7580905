"""Atoms of bodies, and their positions in the bodies."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True, eq=False)
class AlikeSites:
    """Atoms of bodies that share one geometry.

    Attributes:
        bodies: indices of these bodies, (m,).
        atoms: particle indices, (m, k): m bodies of k atoms.
        places: atom positions in the principal frame, (3, k), nm.
    """

    bodies: np.ndarray
    atoms: np.ndarray
    places: np.ndarray


class Sites:
    """Atoms of all bodies, in tables for kernels.

    Attributes:
        alike: sets of bodies.
        bodies: indices of the bodies, set by set, (n,).
        sets: start and end of each set in `bodies`, number of atoms per body, and start of the set in `places` and in
            `atoms`, (m, 5).
        places: atom positions in the principal frame, once for each set, (3, k), nm.
        atoms: particle indices, body by body.
        ones: weights 1 of all `places`, (k,).
        tables: arguments of kernels: sets, bodies, places and atoms.
    """

    def __init__(self, alike: Sequence[AlikeSites]) -> None:
        self.alike = tuple(alike)
        sizes = [group.atoms.shape[1] for group in alike]
        places, atoms = np.cumsum([0, *sizes]), np.cumsum([0, *(group.atoms.size for group in alike)])
        ends = np.cumsum([0, *(len(group.bodies) for group in alike)])
        rows = list(zip(ends[:-1], ends[1:], sizes, places[:-1], atoms[:-1], strict=True))
        self.sets = np.array(rows, np.int64).reshape(-1, 5)
        self.bodies = np.concatenate([np.empty(0, np.int64), *(group.bodies for group in alike)])
        self.places = np.concatenate([np.empty((3, 0)), *(group.places for group in alike)], axis=1)
        self.atoms = np.concatenate([np.empty(0, np.int64), *(group.atoms.ravel() for group in alike)], dtype=np.int64)
        self.ones = np.ones(self.places.shape[1])
        self.tables = self.sets, self.bodies, self.places, self.atoms

    def at(self, atoms: np.ndarray) -> "Sites":
        """Return the sites at which any body of a set has one of the given atoms, for all bodies of the set."""
        selected = []
        for group in self.alike:
            is_selected = np.isin(group.atoms, atoms).any(axis=0)
            selected.append(replace(group, atoms=group.atoms[:, is_selected], places=group.places[:, is_selected]))
        return Sites(selected)
