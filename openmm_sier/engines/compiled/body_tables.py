"""Tables of the bodies and points of a System, as `motion.cc` reads them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.rotation.axes import axes_of
from openmm_sier.dynamics.species import Species
from openmm_sier.engines.compiled.movers import MOST_IN_CLUSTER, Bodies, Clusters, LargeBodies, Mover, Points

#: Atoms no further from a line than this part of its length are on it.
LINE = 1e-6

#: Number of atoms above which a team of threads moves a body.
MOST_FOR_A_THREAD = 24


class ClusterError(ValueError):
    """Constraints are not those of atoms to one other atom each."""


class BodyTables(NamedTuple):
    """All that moves.

    Attributes:
        integers, numbers: tables, by their names.
        others: movers without fast forces.
        members: movers on which fast forces act; all where there are none.
        atoms: of the bodies of each kind, (m, k).
    """

    integers: dict[str, np.ndarray]
    numbers: dict[str, np.ndarray]
    others: tuple[Mover, ...]
    members: tuple[Mover, ...]
    atoms: tuple[np.ndarray, ...]


def tables_of(bodies: BodySet, is_member: np.ndarray) -> BodyTables:
    """Return the tables of bodies.

    Args:
        bodies: all bodies and points.
        is_member: whether fast forces act on each of them, (n,).
    """
    kinds = [(s, is_member[columns]) for s, columns in zip(bodies.species, bodies.columns, strict=True)]
    extended = [(kind, members) for kind, members in kinds if len(kind.masses) > 1]
    # Points and clusters move within members' inner steps whether fast forces act on them or not.
    single = [kind.atoms[:, 0] for kind, _ in kinds if len(kind.masses) == 1]
    clusters, lengths = clusters_of(bodies)
    free = np.concatenate(single) if single else np.empty(0, dtype=np.int64)
    points = free[~np.isin(free, clusters[:, 1:])]
    records, sets = _records(extended)
    movers: dict[bool, list[Mover]] = {False: [], True: []}
    part = 0
    for (belongs, team), (first, number) in sets.items():
        if number:
            movers[belongs].append(team(first, number, part))
            part += number
    if len(points):
        movers[True].append(Points(0, len(points), part))
        part += len(points)
    if len(clusters):
        movers[True].append(Clusters(0, len(clusters), part))
    integers = {
        "bodies": records,
        "bodyAtoms": np.concatenate([*(kind.atoms.ravel() for kind, _ in extended), [0]]),
        "references": np.array([(*spanning_atoms(in_order(kind)[0]), 0) for kind, _ in extended] or [(0, 0, 0, 0)]),
        "points": points if len(points) else np.zeros(1),
        "clusters": clusters if len(clusters) else np.zeros(1),
    }
    numbers = {
        "sites": np.concatenate([*(_sites(kind) for kind, _ in extended), np.zeros((1, 4))]),
        "kinds": np.concatenate([*(kind_table(kind) for kind, _ in extended), np.zeros((1, 4))]),
        "clusterLengths": lengths if len(lengths) else np.zeros(1),
    }
    together = tuple(kind.atoms for kind, _ in extended)
    if not is_member.any():
        return BodyTables(integers, numbers, (), (*movers[False], *movers[True]), together)
    return BodyTables(integers, numbers, tuple(movers[False]), tuple(movers[True]), together)


def clusters_of(bodies: BodySet) -> tuple[np.ndarray, np.ndarray]:
    """Return the clusters of constrained points, (m, 1 + k), and lengths, (m, k), k being `MOST_IN_CLUSTER`.

    A row has the number of atoms, the centre and the others; without an atom it has -1. The first length is not used.

    Raises:
        ClusterError: constraints have another form.
    """
    pairs, lengths = bodies.links
    neighbours: dict[int, list[tuple[int, float]]] = {}
    for (first, second), length in zip(pairs.tolist(), lengths.tolist(), strict=True):
        neighbours.setdefault(first, []).append((second, length))
        neighbours.setdefault(second, []).append((first, length))
    rows, distances = [], []
    for body, joined in neighbours.items():
        others = [other for other, _ in joined]
        # Of a pair the first atom is the centre.
        is_centre = len(joined) > 1 or (len(neighbours[others[0]]) == 1 and body < others[0])
        if not is_centre:
            continue
        atoms = [int(bodies.atoms_of(each)[0]) for each in (body, *others)]
        if len(atoms) > MOST_IN_CLUSTER or any(len(neighbours[other]) > 1 for other in others):
            raise ClusterError(f"atom {atoms[0]}")
        padding = MOST_IN_CLUSTER - len(atoms)
        rows.append([len(atoms), *atoms, *[-1] * padding])
        distances.append([0.0, *(length for _, length in joined), *[0.0] * padding])
    shape = -1, MOST_IN_CLUSTER
    return np.array(rows, dtype=np.int64).reshape(-1, MOST_IN_CLUSTER + 1), np.array(distances).reshape(shape)


def _records(
    kinds: Sequence[tuple[Species, np.ndarray]],
) -> tuple[np.ndarray, dict[tuple[bool, type[Bodies]], tuple[int, int]]]:
    """Return records of all bodies, (n, 4), and the first and the number of those that move in one way.

    Args:
        kinds: kinds of body, each with whether fast forces act on its bodies.
    """
    rows: dict[tuple[bool, type[Bodies]], list[tuple[int, int, int, int]]] = {
        (belongs, team): [] for belongs in (False, True) for team in (Bodies, LargeBodies)
    }
    first_atom = first_site = 0
    for number, (kind, members) in enumerate(kinds):
        size = len(kind.masses)
        team = Bodies if size <= MOST_FOR_A_THREAD else LargeBodies
        for belongs in members.tolist():
            rows[belongs, team].append((first_atom, size, first_site, number))
            first_atom += size
        first_site += size
    sets = {}
    first = 0
    for way, found in rows.items():
        sets[way] = first, len(found)
        first += len(found)
    together = [row for found in rows.values() for row in found]
    return np.array(together or [(0, 0, 0, 0)]), sets


def in_order(kind: Species) -> tuple[np.ndarray, np.ndarray]:
    """Return sites, (3, k), and principal moments, (3,), with the axes in the order of ascending moments."""
    order = np.argsort(kind.moments, kind="stable")
    sites = kind.sites[order].copy()
    sites[1] *= np.linalg.det(np.eye(3)[order])
    return sites, kind.moments[order]


def _sites(kind: Species) -> np.ndarray:
    """Return places in the principal frame, and masses, (k, 4)."""
    return np.column_stack([in_order(kind)[0].T, kind.masses])


def kind_table(kind: Species) -> np.ndarray:
    """Return the six vectors of a kind of body, (6, 4)."""
    sites, moments = in_order(kind)
    origin, along, across = spanning_atoms(sites)
    table = np.zeros((6, 4))
    table[0, :3] = np.divide(1.0, moments, out=np.zeros(3), where=moments > 0)
    table[0, 3] = 1 / kind.mass
    table[1, :3] = axes_of(moments).rates
    table[1, 3] = np.sqrt(kind.mass)
    table[2, :3] = np.sqrt(moments)
    first = _unit(sites[:, along] - sites[:, origin])
    # Across a line any direction will do: it has its moment about none.
    other = sites[:, across] - sites[:, origin] if across >= 0 else np.array([0.0, 1.0, 0.0])
    third = _unit(np.cross(first, other))
    table[3:, :3] = first, np.cross(third, first), third
    return table


def spanning_atoms(sites: np.ndarray) -> tuple[int, int, int]:
    """Return three atoms far from each other and from a line, or two and -1 where all are on a line.

    Args:
        sites: (3, k), at least two.
    """
    origin = int(np.argmax((sites**2).sum(axis=0)))
    arms = sites - sites[:, [origin]]
    along = int(np.argmax((arms**2).sum(axis=0)))
    length = np.linalg.norm(arms[:, along])
    distances = np.linalg.norm(np.cross(arms.T, _unit(arms[:, along])), axis=1)
    across = int(np.argmax(distances))
    return origin, along, across if distances[across] > LINE * length else -1


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)
