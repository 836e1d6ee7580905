"""Rigid bodies of an OpenMM System, found in its constraints."""

from __future__ import annotations

from collections import defaultdict
from itertools import combinations

import numpy as np
from openmm import unit

from openmm_sier.bodies import RigidBodies, RigidityError, Species

#: Largest excess in nm of a constraint over the distance in the geometry that all constraints of a cluster define.
EMBEDDING_TOLERANCE = 1e-4


def find_bodies(system, topology=None) -> RigidBodies:
    """Rigid bodies of a System.

    Particles joined by constraints form a body, whose geometry the constraint lengths define; every
    other massive particle is a point body. Virtual sites ride along. Massless particles that are no virtual sites stay
    where they are.

    Args:
        system: openmm.System.
        topology: openmm.app.Topology, for the names of residues in messages.

    Raises:
        RigidityError: a cluster is constrained but not rigid, its lengths contradict each other, or a massless
            particle is constrained.
    """
    labels = None if topology is None else _residue_labels(topology, system.getNumParticles())
    masses = np.array([system.getParticleMass(i).value_in_unit(unit.dalton) for i in range(system.getNumParticles())])
    lengths = _constraint_lengths(system)
    describe = RigidBodies([], len(masses), labels).describe_atoms

    kinds: dict[tuple, list[tuple[int, ...]]] = defaultdict(list)
    free = masses > 0
    for cluster in _clusters(lengths):
        _check_cluster(cluster, lengths, masses, describe)
        free[list(cluster)] = False
        distances = tuple(lengths[pair] for pair in combinations(cluster, 2))
        kinds[(*masses[list(cluster)], *distances)].append(cluster)
    for atom in np.flatnonzero(free):
        kinds[(masses[atom],)].append((int(atom),))

    species = []
    for signature, clusters in kinds.items():
        k = len(clusters[0])
        coordinates, excess = _embed(k, signature[k:])
        if excess > EMBEDDING_TOLERANCE:
            raise RigidityError(
                f"the constraints of {describe(clusters[0])} contradict each other: no geometry has these lengths "
                f"({', '.join(f'{d:.4f}' for d in signature[k:])} nm); the nearest one misses by {excess:.4f} nm"
            )
        species.append(Species.from_coordinates(clusters, signature[:k], coordinates))
    return RigidBodies(species, len(masses), labels)


def _residue_labels(topology, n_particles) -> list[str]:
    labels = [f"{atom.residue.name} {atom.residue.id}" for atom in topology.atoms()]
    if len(labels) != n_particles:
        raise ValueError(f"the topology has {len(labels)} atoms, the System {n_particles} particles")
    return labels


def _constraint_lengths(system) -> dict[tuple[int, int], float]:
    lengths = {}
    for i in range(system.getNumConstraints()):
        a, b, distance = system.getConstraintParameters(i)
        lengths[(min(a, b), max(a, b))] = distance.value_in_unit(unit.nanometer)
    return lengths


def _clusters(pairs) -> list[tuple[int, ...]]:
    """Connected components of a graph, each in ascending order, ordered by their first particle."""
    neighbours: dict[int, list[int]] = defaultdict(list)
    for a, b in pairs:
        neighbours[a].append(b)
        neighbours[b].append(a)
    seen: set[int] = set()
    clusters = []
    for start in sorted(neighbours):
        if start in seen:
            continue
        seen.add(start)
        stack, members = [start], []
        while stack:
            node = stack.pop()
            members.append(node)
            fresh = [other for other in neighbours[node] if other not in seen]
            seen.update(fresh)
            stack.extend(fresh)
        clusters.append(tuple(sorted(members)))
    return clusters


def _check_cluster(cluster, lengths, masses, describe):
    for atom in cluster:
        if masses[atom] == 0:
            raise RigidityError(
                f"{describe(cluster)}: atom {atom} is constrained but has no mass. Give it a mass, or make it a "
                "virtual site"
            )
    missing = [pair for pair in combinations(cluster, 2) if pair not in lengths]
    if missing:
        (a, b), pairs = missing[0], len(cluster) * (len(cluster) - 1) // 2
        raise RigidityError(
            f"{describe(cluster)} is constrained but not rigid: {len(missing)} of its {pairs} distances are free, the "
            f"first between atoms {a} and {b}. A body needs a constraint between every two of its atoms and none to "
            "other atoms. Build the system with rigidWater=True and constraints=None, so that only water is "
            "constrained, or add the missing constraints"
        )


def _embed(k, distances):
    """Coordinates (k, 3) of points with given distances, and the largest distance error.

    Classical multidimensional scaling (Torgerson, Psychometrika 17, 401 (1952)), exact for consistent distances.
    """
    squares = np.zeros((k, k))
    squares[np.triu_indices(k, 1)] = np.square(distances)
    squares += squares.T
    centre = np.eye(k) - 1 / k
    values, vectors = np.linalg.eigh(-0.5 * centre @ squares @ centre)
    kept = min(3, k)
    coordinates = np.zeros((k, 3))
    coordinates[:, :kept] = vectors[:, -kept:] * np.sqrt(np.maximum(values[-kept:], 0))
    found = np.linalg.norm(coordinates[:, None] - coordinates[None], axis=2)
    return coordinates, float(np.abs(found - np.sqrt(squares)).max())
