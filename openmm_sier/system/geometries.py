"""The geometry of rigid bodies: from constraint lengths, or from the positions of atoms.

All bodies of one kind share one geometry. Each kind adds some 25 us to a step. Lengths or positions from a PDB file are
rounded, and would make every molecule a kind of its own.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from openmm_sier.dynamics.bodies import RigidityError
from openmm_sier.dynamics.species import Species

#: Largest error in nm of a constraint in the geometry that all constraints of a cluster define.
EMBEDDING_TOLERANCE = 1e-4

#: Atoms of a body this close in nm to a line or a plane lie on it; PDB files round to 1e-4 nm.
RESOLUTION = 5e-4

#: Lengths of two molecules that differ by less than this, in nm, count as one length that a PDB file has rounded. There
#: each coordinate is off by up to 5e-5 nm, and so a length by up to sqrt(3) 1e-4 nm. Bonds of different types in a
#: force field differ by 1e-3 nm.
LENGTH_TOLERANCE = 3.5e-4

#: Named bodies with the same masses share a geometry if none of their atoms is further than this from it, in nm.
#: Minimized or thermal molecules of one conformation are within it, since a bond angle that is off by 4 degrees moves a
#: hydrogen by 0.007 nm. A torsion that differs by 10 degrees moves one by 0.017 nm and makes another geometry.
SHARING_TOLERANCE = 0.01

#: Deviations of positions and lengths, in nm, that are the rounding of a PDB file and cause no warning: sqrt(3) 1e-4.
ROUNDING = 1.74e-4

Cluster = tuple[int, ...]

#: Constraint lengths in nm by pairs of particles, the smaller first.
Lengths = dict[tuple[int, int], float]


class Sharing(NamedTuple):
    """Bodies that share one geometry, and how far each deviates from it.

    Attributes:
        clusters: particle indices of each, (m, k).
        deviations: (m,), nm.
    """

    clusters: np.ndarray
    deviations: np.ndarray


class Kind(NamedTuple):
    """Clusters of particles with the same masses in the same order, and the same constraints.

    Attributes:
        masses: (k,), dalton.
        clusters: particle indices of each body, (m, k).
        pairs: constrained pairs of atoms, by their numbers in the cluster.
        lengths: of the pairs, nm; the mean over the clusters.
        deviations: for each body the largest deviation of its lengths from the mean, (m,), nm.
        model: the bodies with the geometry that constraints define; None if constraints do not define it.
    """

    masses: np.ndarray
    clusters: np.ndarray
    pairs: tuple[tuple[int, int], ...]
    lengths: np.ndarray
    deviations: np.ndarray
    model: Species | None = None

    @property
    def needs_positions(self) -> bool:
        """Tell whether only positions decide the geometry, or which of two mirror images it is."""
        return self.model is None or self.model.mirror_distance > 0


def kinds(clusters: Iterable[tuple[Cluster, Lengths]], masses: Sequence[float], describe: Callable) -> list[Kind]:
    """Return clusters of particles sorted into kinds, in the order in which the first of each kind comes.

    Args:
        clusters: particle indices, and the constraints between them.
        masses: of all particles, dalton.
        describe: gives a name to particle indices, for messages.

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
    found = []
    for (mine, pairs), (same, lists) in members.items():
        left, table = np.array(same), np.array(lists).reshape(len(same), len(pairs))
        while len(left):
            near = np.abs(table - table[0]).max(axis=1, initial=0.0) <= LENGTH_TOLERANCE
            # The mean of equal lengths may differ from them by rounding.
            mean = table[0] if (table[near] == table[0]).all() else table[near].mean(axis=0)
            deviations = np.abs(table[near] - mean).max(axis=1, initial=0.0)
            kind = Kind(np.array(mine), left[near], pairs, mean, deviations)
            complete = len(pairs) == len(mine) * (len(mine) - 1) // 2
            found.append(kind._replace(model=_embedded(kind, describe)) if complete else kind)
            left, table = left[~near], table[~near]
    return found


# --- from constraints -------------------------------------------------------------------------------------------------


def _embedded(kind: Kind, describe: Callable) -> Species:
    """Return bodies of the geometry that a length for every pair of atoms defines, up to a reflection."""
    coordinates, excess = embed(len(kind.masses), kind.lengths)
    if excess > EMBEDDING_TOLERANCE:
        raise RigidityError(
            f"the constraints of {describe(kind.clusters[0])} contradict each other: no geometry has the "
            f"lengths {', '.join(f'{d:.4f}' for d in kind.lengths)} nm; the nearest one misses by {excess:.4f} nm. "
            "Correct these lengths, or remove some of the constraints"
        )
    resolution = RESOLUTION if kind.deviations.any() else 0.0
    return Species.from_coordinates(kind.clusters, kind.masses, coordinates, resolution)


def embed(k: int, distances: np.ndarray) -> tuple[np.ndarray, float]:
    """Return coordinates (k, 3) of points with given distances, and the largest distance error.

    Classical multidimensional scaling (Torgerson, Psychometrika 17, 401 (1952)), exact for consistent distances.
    """
    squares = np.zeros((k, k))
    squares[np.triu_indices(k, 1)] = np.square(distances)
    squares += squares.T
    centre = np.eye(k) - 1 / k
    values, vectors = np.linalg.eigh(-0.5 * centre @ squares @ centre)
    # Rounding of squares: without this a planar body would be 1e-8 nm thick.
    values[values < 1e-13 * values.max()] = 0
    kept = min(3, k)
    coordinates = np.zeros((k, 3))
    coordinates[:, :kept] = vectors[:, -kept:] * np.sqrt(np.maximum(values[-kept:], 0))
    found = np.linalg.norm(coordinates[:, None] - coordinates[None], axis=2)
    return coordinates, float(np.abs(found - np.sqrt(squares)).max())


def by_handedness(model: Species, positions: np.ndarray) -> list[Species]:
    """Split the bodies of a species into those with its geometry and those that are mirror images."""
    mirror = model.mirrored()
    arms = _arms(model.masses, positions[model.atoms])
    mirrored = mirror.fit(arms)[1] < model.fit(arms)[1]
    halves = [(model, model.atoms[~mirrored]), (mirror, model.atoms[mirrored])]
    return [species.of_atoms(atoms) for species, atoms in halves if len(atoms)]


# --- from positions ---------------------------------------------------------------------------------------------------


def from_positions(kind: Kind, positions: np.ndarray, describe: Callable) -> tuple[list[Species], list[Sharing]]:
    """Return bodies of the geometries found in positions (N, 3) in nm, as few as `SHARING_TOLERANCE` allows.

    A geometry is the mean over the superimposed bodies that share it, and satisfies their constraints.

    Raises:
        RigidityError: constraints inside a body contradict each other.
    """
    species, sharing, clusters = [], [], kind.clusters
    while len(clusters):
        arms = _arms(kind.masses, positions[clusters])
        model, misfit, near = _superimposed(kind, arms, describe)
        if near.sum() > 1:
            sharing.append(Sharing(clusters[near], misfit[near]))
        species.append(model.of_atoms(clusters[near]))
        clusters = clusters[~near]
    return species, sharing


def _superimposed(kind: Kind, arms: np.ndarray, describe: Callable) -> tuple[Species, np.ndarray, np.ndarray]:
    """Return the geometry of the first body and its like, how far all are from it, (m,), and which share it, (m,)."""
    shape = arms[0]
    # The first may be as far from the mean as any other: others can be near the mean but not near the first. The mean
    # of bodies turned onto a mean would change only in second order of their deviations.
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
    return model, misfit, near


def _constrained(shape: np.ndarray, kind: Kind) -> tuple[np.ndarray, float]:
    """Return a shape (k, 3) moved onto constraints one after another, as SHAKE does, and the largest error left."""
    shape, largest, masses = shape.copy(), 0.0, kind.masses
    # It converges in some ten rounds for the hydrogens of one atom, and more slowly the more constraints share atoms.
    for _ in range(500):
        largest = 0.0
        for (i, j), length in zip(kind.pairs, kind.lengths, strict=True):
            bond = shape[i] - shape[j]
            found = np.linalg.norm(bond)
            shift = bond * ((1 - length / found) / (masses[i] + masses[j]))
            shape[i] -= masses[j] * shift
            shape[j] += masses[i] * shift
            largest = max(largest, abs(found - length))
        if largest < 1e-13:
            break
    return shape, float(largest)


def from_sites(kind: Kind, sites: np.ndarray) -> list[Species]:
    """Return bodies from atom positions in principal frames, (N, 3) in nm; none if these frames are not principal.

    Bodies whose sites are bit-identical form one species.
    """
    clusters, masses = kind.clusters, kind.masses
    frames = sites[clusters]
    inertia = np.einsum("k,mkx,mky->mxy", masses, frames, frames)
    spread = np.trace(inertia, axis1=1, axis2=2)
    off_centre = np.abs(np.einsum("k,mkx->mx", masses, frames)).max(axis=1)
    off_axes = np.abs(inertia * (1 - np.eye(3))).max(axis=(1, 2))
    # For principal frames both are rounding errors; with other masses they are several per cent.
    if (spread == 0).any() or (off_axes > 1e-9 * spread).any() or (off_centre**2 > 1e-18 * masses.sum() * spread).any():
        return []
    species = []
    while len(clusters):
        same = (frames == frames[0]).all(axis=(1, 2))
        species.append(Species.from_sites(clusters[same], masses, frames[0].T))
        clusters, frames = clusters[~same], frames[~same]
    return species


def _arms(masses: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Return positions (m, k, 3) relative to the centres of mass."""
    return positions - np.einsum("k,mkx->mx", masses / masses.sum(), positions)[:, None]
