"""Geometries of rigid bodies, from constraint lengths or atom positions.

Bodies share a geometry if theirs are equal up to rounding: otherwise every molecule of a PDB file would be a kind of
its own. Mirror images are different kinds.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np
from openmm import unit

from openmm_sier.dynamics.bodies import RigidityError
from openmm_sier.dynamics.species import Species
from openmm_sier.system.arguments import Quantity, quantity_to_float

#: Largest error of a constraint in the geometry defined by all constraints of a cluster, nm.
EMBEDDING_TOLERANCE = 1e-4

#: Largest distance in nm within which the atoms of a body are moved onto a line or plane: lengths that are rounded to
#: 1e-6 nm bend a line of 0.2 nm by 3e-4 nm.
RESOLUTION = 5e-4

#: Largest distance in nm by which an atom is moved so that bodies share a geometry, unless users choose. A PDB file
#: rounds coordinates by up to 5e-5 nm and moves atoms by up to 0.87e-4 nm; a fit to the rounded positions adds at most
#: as much. A GRO file rounds ten times as much: it needs 2e-3 nm, by which users may mean two sizes.
TOLERANCE = 2e-4

#: Distance in nm within which users probably mean one geometry: a deviation of a bond angle by 4 degrees moves a
#: hydrogen by 0.007 nm, one of a torsion by 10 degrees by 0.017 nm.
THERMAL = 0.01

#: Rounding of geometries in double precision, nm: the least tolerance.
ROUNDING = 1e-9

#: Number of atoms whose distances from the centre of mass are compared first.
MOST_RADII = 6

Cluster = tuple[int, ...]


class Clusters(NamedTuple):
    """Clusters of particles with constraints between the same atoms of each.

    Attributes:
        atoms: particle indices of each cluster, (m, k).
        pairs: constrained pairs of atoms, by their indices in the cluster, (p, 2), the smaller first, in order.
        lengths: constrained distances, (m, p), nm.
    """

    atoms: np.ndarray
    pairs: np.ndarray
    lengths: np.ndarray


class Kind(NamedTuple):
    """Clusters of particles with the same masses in the same order, and the same constraints.

    Attributes:
        masses: (k,), dalton.
        clusters: particle indices of each body, (m, k).
        pairs: constrained pairs of atoms, by their indices in the cluster.
        lengths: lengths of the pairs, nm; means over the clusters.
        moved: largest difference of a length from its mean, nm.
        model: the bodies with the geometry defined by constraints; None if constraints do not define one.
    """

    masses: np.ndarray
    clusters: np.ndarray
    pairs: tuple[tuple[int, int], ...]
    lengths: np.ndarray
    moved: float = 0.0
    model: Species | None = None

    @property
    def needs_positions(self) -> bool:
        """Whether positions must decide the geometry, or between two mirror images of one that is not flat."""
        return self.model is None or bool(self.model.sites.any(axis=1).all())


def kinds(found: Iterable[Clusters], masses: np.ndarray, describe: Callable, tolerance: float) -> list[Kind]:
    """Sort clusters of particles into kinds, in the order of their first clusters.

    Args:
        found: the clusters.
        masses: masses of all particles, (N,), dalton.
        describe: names particle indices in messages.
        tolerance: distance in nm by which each atom may move, so that twice as much is added to a length.

    Raises:
        RigidityError: constraint lengths contradict each other.
    """
    members: dict[tuple, list[Clusters]] = {}
    for clusters in found:
        key_of_pairs = tuple(map(tuple, clusters.pairs.tolist()))
        for kind_masses, part in _of_equal_masses(clusters, masses):
            members.setdefault((kind_masses, key_of_pairs), []).append(part)
    sorted_kinds = []
    for (kind_masses, pairs), parts in members.items():
        alike, table = np.concatenate([part.atoms for part in parts]), np.concatenate([part.lengths for part in parts])
        for near in _near(table, 2 * tolerance):
            lengths, first = table[near], table[near[0]]
            # The mean of equal lengths may differ from them by rounding.
            mean = first if (lengths == first).all() else lengths.mean(axis=0)
            moved = float(np.abs(lengths - mean).max(initial=0.0))
            kind = Kind(np.array(kind_masses), alike[near], pairs, mean, moved)
            complete = len(pairs) == len(kind_masses) * (len(kind_masses) - 1) // 2
            sorted_kinds.append(kind._replace(model=_embedded(kind, describe)) if complete else kind)
    return sorted_kinds


def _of_equal_masses(clusters: Clusters, masses: np.ndarray) -> Iterator[tuple[tuple[float, ...], Clusters]]:
    """Divide clusters by the masses of their atoms, in the order of the first ones; yield masses and clusters."""
    rows = masses[clusters.atoms]
    if (rows == rows[0]).all():
        yield tuple(rows[0].tolist()), clusters
        return
    _, first, number = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(number.ravel(), kind="stable")
    groups = np.split(order, np.cumsum(np.bincount(number.ravel()))[:-1])
    for k in np.argsort(first).tolist():
        group = groups[k]
        yield tuple(rows[group[0]].tolist()), Clusters(clusters.atoms[group], clusters.pairs, clusters.lengths[group])


def _near(table: np.ndarray, distance: float, choose: Callable | None = None) -> Iterator[np.ndarray]:
    """Divide bodies into groups, each around the first body that is left; yield ascending indices.

    Args:
        table: numbers that describe each body, (m, d).
        distance: largest difference of each number from that of the first body of the group.
        choose: returns the group, for the index of the first body and those of bodies near it; None takes all of these.
    """
    left, everything = np.ones(len(table), dtype=bool), np.arange(len(table))
    if (np.abs(table - table[0]) <= distance).all():
        neighbours = None
    else:
        from scipy.spatial import KDTree

        neighbours = KDTree(table)
    for first in everything.tolist():
        if not left[first]:
            continue
        near = everything
        if neighbours is not None:
            near = np.sort(neighbours.query_ball_point(table[first], distance, p=np.inf))
        near = near[left[near]]
        group = near if choose is None else choose(first, near)
        left[group] = False
        yield group


# --- from constraints -------------------------------------------------------------------------------------------------


def _embedded(kind: Kind, describe: Callable) -> Species:
    """Return bodies with the geometry defined by the lengths of all pairs of atoms, up to a reflection."""
    if len(kind.masses) == 1:
        return Species.from_sites(kind.clusters, kind.masses, np.zeros((3, 1)))
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


def from_positions(
    kind: Kind, positions: np.ndarray, tolerance: float, describe: Callable
) -> list[tuple[Species, float]]:
    """Return bodies with geometries from positions, and the largest distance in nm of an atom from its site.

    A geometry is the mean over the superimposed bodies that share it, and satisfies their constraints.

    Args:
        kind: the bodies.
        positions: (N, 3), nm.
        tolerance: largest distance in nm of an atom from the mean, before constraints move it.
        describe: names particle indices in messages.

    Raises:
        RigidityError: constraints inside a body contradict each other.
    """
    arms = _arms(kind.masses, positions[kind.clusters])
    radii = np.linalg.norm(arms, axis=2)
    # A few radii tell most geometries apart, and a tree of many dimensions is slow.
    chosen = np.unique(np.linspace(0, radii.shape[1] - 1, MOST_RADII).astype(int))
    table = np.column_stack([radii[:, chosen], radii.mean(axis=1)])
    species = []
    for group in _near(table, 2 * tolerance, lambda first, near: _alike(kind, arms, first, near, tolerance)):
        shape, excess = _constrained(_mean(kind, arms, group), kind)
        if excess > EMBEDDING_TOLERANCE:
            raise RigidityError(
                f"the constraints inside {describe(kind.clusters[group[0]])} contradict each other: the geometry "
                f"nearest to the positions misses their lengths by {excess:.4f} nm. Correct the lengths, or remove "
                "some of the constraints"
            )
        flat = min(tolerance, RESOLUTION)
        model = Species.from_coordinates(kind.clusters[group], kind.masses, shape, flat)
        species.append((model, float(model.fit(arms[group])[1].max())))
    return species


def differences(kind: Kind, positions: np.ndarray) -> np.ndarray:
    """Return the largest distance of an atom of each body from its place in the first body, (m,), nm."""
    arms = _arms(kind.masses, positions[kind.clusters])
    return _placed(kind, arms[0], arms)[1]


def _alike(kind: Kind, arms: np.ndarray, first: int, near: np.ndarray, tolerance: float) -> np.ndarray:
    """Return the indices of the bodies near the first one that share a geometry with it, ascending.

    Args:
        kind: the bodies.
        arms: atom positions from the centres of mass, (m, k, 3), nm.
        first: index of the first body.
        near: indices of the bodies that may be alike, ascending, with the first one.
        tolerance: largest distance of an atom from its place in the mean, nm.
    """
    if len(near) == 1:
        return near
    # The first body may be as far from the mean as any other.
    _, misfit = _placed(kind, arms[first], arms[near])
    group = near[misfit <= 2 * tolerance]
    for _ in range(2):
        _, misfit = _placed(kind, _mean(kind, arms, group), arms[near])
        if not misfit[near == first] <= tolerance:
            return np.array([first])
        before, group = group, near[misfit <= tolerance]
        if np.array_equal(group, before):
            # Its mean would be the same.
            break
    return group


def _mean(kind: Kind, arms: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return the mean (k, 3) of the superimposed bodies of a group in nm, in any frame."""
    attitudes, _ = _placed(kind, arms[group[0]], arms[group])
    return np.einsum("axm,mkx->ka", attitudes, arms[group]) / len(group)


def _placed(kind: Kind, shape: np.ndarray, arms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return attitudes of bodies with a shape (k, 3), and the largest distance of their atoms from their places."""
    return Species.from_coordinates(kind.clusters, kind.masses, shape).fit(arms)


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


def checked_tolerance(tolerance: Quantity) -> float:
    """Return a tolerance in nm, not below rounding.

    Raises:
        ValueError: it is negative.
        TypeError: it is not a length.
    """
    distance = quantity_to_float("tolerance", tolerance, unit.nanometer, "nm")
    if distance < 0:
        raise ValueError(f"tolerance must not be negative, got {distance:g} nm")
    return max(distance, ROUNDING)
