"""Geometries of rigid bodies, from constraint lengths or atom positions.

All bodies of one kind share a geometry: each kind adds some 25 us to a step, and rounded lengths or positions from a
PDB file would make every molecule a kind of its own.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from openmm_sier.dynamics.bodies import RigidityError
from openmm_sier.dynamics.species import Species

#: Largest error of a constraint in the geometry defined by all constraints of a cluster, nm.
EMBEDDING_TOLERANCE = 1e-4

#: Distance in nm within which the atoms of a body lie on a line or plane; PDB files round to 1e-4 nm.
RESOLUTION = 5e-4

#: Difference in nm up to which lengths of two molecules count as one length rounded by a PDB file. Rounding changes
#: each coordinate by up to 5e-5 nm, and so a length by up to sqrt(3) 1e-4 nm. Bonds of different types in a force field
#: differ by 1e-3 nm.
LENGTH_TOLERANCE = 3.5e-4

#: Distance in nm of atoms from a geometry up to which named bodies with the same masses share it. Minimized or thermal
#: molecules of one conformation do: a deviation of a bond angle by 4 degrees moves a hydrogen by 0.007 nm. A deviation
#: of a torsion by 10 degrees moves one by 0.017 nm and makes another geometry.
SHARING_TOLERANCE = 0.01

Cluster = tuple[int, ...]

#: Constraint lengths in nm by pairs of particles, the smaller first.
Lengths = dict[tuple[int, int], float]


class Kind(NamedTuple):
    """Clusters of particles with the same masses in the same order, and the same constraints.

    Attributes:
        masses: (k,), dalton.
        clusters: particle indices of each body, (m, k).
        pairs: constrained pairs of atoms, by their indices in the cluster.
        lengths: lengths of the pairs, nm; means over the clusters.
        model: the bodies with the geometry defined by constraints; None if constraints do not define one.
    """

    masses: np.ndarray
    clusters: np.ndarray
    pairs: tuple[tuple[int, int], ...]
    lengths: np.ndarray
    model: Species | None = None

    @property
    def needs_positions(self) -> bool:
        """Whether positions must decide the geometry, or between two mirror images of one that is not flat."""
        return self.model is None or bool(self.model.sites.any(axis=1).all())


def kinds(clusters: Iterable[tuple[Cluster, Lengths]], masses: Sequence[float], describe: Callable) -> list[Kind]:
    """Sort clusters of particles into kinds, in the order of their first clusters.

    Args:
        clusters: particle indices, and the constraints between them.
        masses: masses of all particles, dalton.
        describe: names particle indices in messages.

    Raises:
        RigidityError: constraint lengths contradict each other.
    """
    members: dict[tuple, tuple[list[Cluster], list[list[float]]]] = {}
    for cluster, lengths in clusters:
        number = {particle: i for i, particle in enumerate(cluster)}
        numbered = sorted((*sorted((number[a], number[b])), length) for (a, b), length in lengths.items())
        key = tuple(masses[i] for i in cluster), tuple((i, j) for i, j, _ in numbered)
        same, rows = members.setdefault(key, ([], []))
        same.append(cluster)
        rows.append([length for _, _, length in numbered])
    sorted_kinds = []
    for (kind_masses, pairs), (same, lists) in members.items():
        clusters_left, table = np.array(same), np.array(lists).reshape(len(same), len(pairs))
        while len(clusters_left):
            near = np.abs(table - table[0]).max(axis=1, initial=0.0) <= LENGTH_TOLERANCE
            # The mean of equal lengths may differ from them by rounding.
            mean = table[0] if (table[near] == table[0]).all() else table[near].mean(axis=0)
            kind = Kind(np.array(kind_masses), clusters_left[near], pairs, mean)
            complete = len(pairs) == len(kind_masses) * (len(kind_masses) - 1) // 2
            sorted_kinds.append(kind._replace(model=_embedded(kind, describe)) if complete else kind)
            clusters_left, table = clusters_left[~near], table[~near]
    return sorted_kinds


# --- from constraints -------------------------------------------------------------------------------------------------


def _embedded(kind: Kind, describe: Callable) -> Species:
    """Return bodies with the geometry defined by the lengths of all pairs of atoms, up to a reflection."""
    coordinates, excess = embed(len(kind.masses), kind.lengths)
    if excess > EMBEDDING_TOLERANCE:
        raise RigidityError(
            f"the constraints of {describe(kind.clusters[0])} contradict each other: no geometry has the "
            f"lengths {', '.join(f'{d:.4f}' for d in kind.lengths)} nm; the nearest one is off by {excess:.4f} nm. "
            "Correct these lengths, or remove some of the constraints"
        )
    return Species.from_coordinates(kind.clusters, kind.masses, coordinates, RESOLUTION)


def embed(k: int, distances: np.ndarray) -> tuple[np.ndarray, float]:
    """Return coordinates (k, 3) of points with the given distances, and the largest error of a distance.

    Classical multidimensional scaling (Torgerson, Psychometrika 17, 401 (1952)), exact for consistent distances.
    """
    squares = np.zeros((k, k))
    squares[np.triu_indices(k, 1)] = np.square(distances)
    squares += squares.T
    centre = np.eye(k) - 1 / k
    values, vectors = np.linalg.eigh(-0.5 * centre @ squares @ centre)
    # Rounding of squares: without this a planar body would be 1e-8 nm thick.
    values[values < 1e-13 * values.max()] = 0
    dimensions = min(3, k)
    coordinates = np.zeros((k, 3))
    coordinates[:, :dimensions] = vectors[:, -dimensions:] * np.sqrt(np.maximum(values[-dimensions:], 0))
    embedded = np.linalg.norm(coordinates[:, None] - coordinates[None], axis=2)
    return coordinates, float(np.abs(embedded - np.sqrt(squares)).max())


def by_handedness(model: Species, positions: np.ndarray) -> list[Species]:
    """Split the bodies of a species into bodies with its geometry and mirror images."""
    mirror = model.mirrored()
    arms = _arms(model.masses, positions[model.atoms])
    mirrored = mirror.fit(arms)[1] < model.fit(arms)[1]
    halves = [(model, model.atoms[~mirrored]), (mirror, model.atoms[mirrored])]
    return [species.of_atoms(atoms) for species, atoms in halves if len(atoms)]


# --- from positions ---------------------------------------------------------------------------------------------------


def from_positions(kind: Kind, positions: np.ndarray, describe: Callable) -> list[Species]:
    """Return bodies with geometries from positions (N, 3) in nm, as few geometries as `SHARING_TOLERANCE` allows.

    A geometry is the mean over the superimposed bodies that share it, and satisfies their constraints.

    Raises:
        RigidityError: constraints inside a body contradict each other.
    """
    species, clusters = [], kind.clusters
    while len(clusters):
        arms = _arms(kind.masses, positions[clusters])
        model, near = _superimposed(kind, arms, describe)
        species.append(model.of_atoms(clusters[near]))
        clusters = clusters[~near]
    return species


def _superimposed(kind: Kind, arms: np.ndarray, describe: Callable) -> tuple[Species, np.ndarray]:
    """Return the mean geometry around the first body, and which bodies share it, (m,)."""
    shape = arms[0]
    # The first body may be as far from the mean as any other, so bodies near the mean need not be near the first.
    # Superposing bodies on a mean again changes it only in second order of their deviations.
    for _ in range(3):
        shape, excess = _constrained(shape, kind)
        if excess > EMBEDDING_TOLERANCE:
            raise RigidityError(
                f"the constraints inside {describe(kind.clusters[0])} contradict each other: the geometry nearest to "
                f"the positions misses their lengths by {excess:.4f} nm. Correct the lengths, or remove some of the "
                "constraints"
            )
        model = Species.from_coordinates(kind.clusters, kind.masses, shape, resolution=RESOLUTION)
        attitudes, misfit = model.fit(arms)
        near = misfit <= SHARING_TOLERANCE
        # The first body always shares the geometry, even if constraints move the model away from it.
        near[0] = True
        if near.sum() == 1:
            break
        shape = np.einsum("axm,mkx->ka", attitudes[:, :, near], arms[near]) / near.sum()
    return model, near


def _constrained(shape: np.ndarray, kind: Kind) -> tuple[np.ndarray, float]:
    """Return a shape (k, 3) moved onto its constraints by SHAKE, and the largest remaining error."""
    shape, largest, masses = shape.copy(), 0.0, kind.masses
    # Some ten rounds suffice for the hydrogens of one atom, more if more constraints share atoms.
    for _ in range(500):
        largest = 0.0
        for (i, j), length in zip(kind.pairs, kind.lengths, strict=True):
            bond = shape[i] - shape[j]
            distance = np.linalg.norm(bond)
            shift = bond * ((1 - length / distance) / (masses[i] + masses[j]))
            shape[i] -= masses[j] * shift
            shape[j] += masses[i] * shift
            largest = max(largest, abs(distance - length))
        if largest < 1e-13:
            break
    return shape, float(largest)


def _arms(masses: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Return positions (m, k, 3) relative to the centres of mass."""
    return positions - np.einsum("k,mkx->mx", masses / masses.sum(), positions)[:, None]
