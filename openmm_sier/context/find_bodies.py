"""Rigid bodies of an OpenMM System: those that its constraints make, and those that the user names."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from itertools import combinations
from typing import NamedTuple

import numpy as np
from openmm import unit

from openmm_sier.dynamics.bodies import FIT_TOLERANCE, LINEAR_MOMENT, RigidBodies, RigidityError, Species, fit_attitudes

#: Largest error in nm of a constraint in the geometry that all constraints of a cluster define.
EMBEDDING_TOLERANCE = 1e-4

#: Atoms of a named body this close in nm to a line or a plane lie on it; PDB files round to 1e-4 nm.
RESOLUTION = 5e-4

Cluster = tuple[int, ...]

#: Constraint lengths in nm by ascending pairs of particles.
Lengths = dict[tuple[int, int], float]


class Kind(NamedTuple):
    """Clusters of particles with the same masses, in their order, and the same constraints.

    Attributes:
        masses: dalton.
        clusters: particle indices of each body.
        model: the bodies with the geometry that constraints give them; None where constraints do not.
    """

    masses: tuple[float, ...]
    clusters: list[Cluster]
    model: Species | None

    @property
    def needs_positions(self) -> bool:
        """Whether constraints leave the geometry or the choice between two mirror images open."""
        return self.model is None or bool(self.model.sites.any(axis=1).all())


class BodyPlan:
    """Which particles of a System form rigid bodies.

    Particles that the user names form bodies of the geometry that they have. Of the others, those joined by
    constraints form bodies whose geometry the constraint lengths define, and every massive particle that is left is a
    point body. Virtual sites ride along. Massless particles that are no virtual sites stay where they are.
    """

    def __init__(self, system, topology=None, rigid=None):
        """
        Args:
            system: openmm.System.
            topology: openmm.app.Topology, for the names of residues.
            rigid: further rigid bodies: lists of particle indices, or a mapping {residue name: "rigid"}, which needs
                the topology.

        Raises:
            RigidityError: a cluster is constrained but not rigid, its lengths contradict each other, a constraint joins
                a body to another particle, or a massless particle that is no virtual site is in a body.
            ValueError: `rigid` names particles or residues that do not exist, or a particle twice.
        """
        n = system.getNumParticles()
        self._labels = None if topology is None else _residue_labels(topology, n)
        self._n = n
        self._describe = RigidBodies([], n, self._labels).describe_atoms
        self._masses = np.array([system.getParticleMass(i).value_in_unit(unit.dalton) for i in range(n)])
        named = self._named_clusters(system, topology, rigid)
        self.kinds = self._collect(named, _constraint_lengths(system))

    @property
    def needs_positions(self) -> bool:
        """Whether only positions tell the geometry of some body."""
        return any(kind.needs_positions for kind in self.kinds)

    def bodies(self, positions=None, sites=None) -> RigidBodies:
        """The bodies.

        Args:
            positions: (N, 3), nm. Bodies of one kind share the geometry of the first of them that fits.
            sites: (N, 3), nm, the atoms in the principal frames of their bodies, which named bodies get to the bit
                unless these are no principal frames.

        Raises:
            RigidityError: positions are needed and there are none, or they contradict the constraints.
        """
        if positions is None and self.needs_positions:
            raise RigidityError("the geometry of these bodies is known from positions only: give positions")
        species: list[Species] = []
        for kind in self.kinds:
            if kind.needs_positions:
                self._demand_extent(kind, positions)
            if kind.model is None:
                species += _from_sites(kind, sites) or self._from_positions(kind, positions)
            elif kind.needs_positions:
                species += _by_handedness(kind.model, positions)
            else:
                species.append(kind.model)
        return RigidBodies(species, self._n, self._labels)

    # --- which particles ---

    def _named_clusters(self, system, topology, rigid) -> list[Cluster]:
        if rigid is None:
            return []
        if isinstance(rigid, Mapping):
            rigid = _residues_named(topology, rigid)
        clusters = []
        seen: set[int] = set()
        for indices in rigid:
            cluster = tuple(int(i) for i in indices if not (0 <= int(i) < self._n and system.isVirtualSite(int(i))))
            for i in cluster:
                if not 0 <= i < self._n:
                    raise ValueError(f"bodies name particle {i}, the System has {self._n} particles")
                if i in seen:
                    raise ValueError(f"bodies name particle {i} twice")
                if self._masses[i] == 0:
                    raise RigidityError(
                        f"{self._describe(cluster)}: atom {i} has no mass and is no virtual site. Give it a mass, or "
                        "leave it out of the body"
                    )
                seen.add(i)
            if cluster:
                clusters.append(cluster)
        return clusters

    def _collect(self, named: list[Cluster], lengths: Lengths) -> list[Kind]:
        owner = {i: number for number, cluster in enumerate(named) for i in cluster}
        loose = {}
        for (a, b), length in lengths.items():
            if owner.get(a) != owner.get(b):
                raise RigidityError(
                    f"a constraint between atoms {a} and {b} joins a rigid body to another particle. Put all atoms "
                    "that are joined by constraints into one body, or build the System without that constraint"
                )
            if a not in owner:
                loose[a, b] = length

        kinds: dict[tuple, list[Cluster]] = defaultdict(list)
        free = self._masses > 0
        for cluster in named:
            free[list(cluster)] = False
            kinds[(tuple(self._masses[list(cluster)]), None)].append(cluster)
        for cluster in _clusters(loose):
            self._check(cluster, lengths)
            free[list(cluster)] = False
            distances = tuple(lengths[pair] for pair in combinations(cluster, 2))
            kinds[(tuple(self._masses[list(cluster)]), distances)].append(cluster)
        for atom in np.flatnonzero(free):
            kinds[((self._masses[atom],), ())].append((int(atom),))
        return [
            Kind(masses, clusters, None if distances is None else self._embed(masses, distances, clusters))
            for (masses, distances), clusters in kinds.items()
        ]

    def _check(self, cluster: Cluster, lengths: Lengths) -> None:
        for atom in cluster:
            if self._masses[atom] == 0:
                raise RigidityError(
                    f"{self._describe(cluster)}: atom {atom} is constrained but has no mass. Give it a mass, or make "
                    "it a virtual site"
                )
        pairs = list(combinations(cluster, 2))
        missing = [pair for pair in pairs if pair not in lengths]
        if missing:
            a, b = missing[0]
            raise RigidityError(
                f"{self._describe(cluster)} is constrained but not rigid: {len(missing)} of its {len(pairs)} distances "
                f"are free, the first between atoms {a} and {b}. A body needs a constraint between every two of its "
                "atoms and none to other atoms. Build the System with rigidWater=True and constraints=None, so that "
                "only water is constrained, or name the atoms in `bodies` to make them one rigid body"
            )

    # --- their geometry ---

    def _embed(self, masses, distances, clusters) -> Species:
        coordinates, excess = _embed(len(masses), distances)
        if excess > EMBEDDING_TOLERANCE:
            raise RigidityError(
                f"the constraints of {self._describe(clusters[0])} contradict each other: no geometry has the "
                f"lengths {', '.join(f'{d:.4f}' for d in distances)} nm; the nearest one misses by {excess:.4f} nm"
            )
        return Species.from_coordinates(clusters, masses, coordinates)

    def _demand_extent(self, kind: Kind, positions) -> None:
        for cluster in kind.clusters:
            x = positions[list(cluster)]
            if not np.isfinite(x).all():
                raise RigidityError(f"the positions of {self._describe(cluster)} are not finite")
            if len(cluster) > 1 and not np.ptp(x, axis=0).any():
                raise RigidityError(
                    f"{self._describe(cluster)}: its atoms lie on one point, where positions must tell its geometry. "
                    "Set the positions first"
                )

    def _from_positions(self, kind: Kind, positions) -> list[Species]:
        species = []
        clusters = np.array(kind.clusters)
        masses = np.array(kind.masses)
        while len(clusters):
            model = Species.from_coordinates(clusters, masses, positions[clusters[0]], resolution=RESOLUTION)
            model = _of_sites(clusters, masses, model.sites.T)
            fits = fit_attitudes(model, _arms(masses, positions[clusters]))[1] <= FIT_TOLERANCE
            species.append(model.of_atoms(clusters[fits]))
            clusters = clusters[~fits]
        return species


def find_bodies(system, topology=None, rigid=None, positions=None) -> RigidBodies:
    """Rigid bodies of a System; see `BodyPlan` for the arguments and the errors raised.

    Args:
        system: openmm.System.
        topology: openmm.app.Topology.
        rigid: rigid bodies besides those that constraints make.
        positions: (N, 3), nm or a Quantity, where the geometry of `rigid` is to be taken from.
    """
    if unit.is_quantity(positions):
        positions = positions.value_in_unit(unit.nanometer)
    return BodyPlan(system, topology, rigid).bodies(None if positions is None else np.array(positions, dtype=float))


def _residue_labels(topology, n_particles) -> list[str]:
    labels = [f"{atom.residue.name} {atom.residue.id}" for atom in topology.atoms()]
    if len(labels) != n_particles:
        raise ValueError(f"the topology has {len(labels)} atoms, the System {n_particles} particles")
    return labels


def _residues_named(topology, rigid: Mapping) -> Iterable[list[int]]:
    """Particle indices of the residues in a mapping {residue name: "rigid"}."""
    if topology is None:
        raise ValueError("bodies by residue name need the topology: RigidBodies.from_system(system, topology, rigid)")
    wrong = [value for value in rigid.values() if value != "rigid"]
    if wrong:
        raise ValueError(f'bodies by residue name must be "rigid", got {wrong[0]!r}')
    residues = list(topology.residues())
    for name in rigid:
        if all(residue.name != name for residue in residues):
            raise ValueError(f"bodies name residue {name}, which the topology does not have")
    return [[atom.index for atom in residue.atoms()] for residue in residues if residue.name in rigid]


def _constraint_lengths(system) -> Lengths:
    lengths: Lengths = {}
    for i in range(system.getNumConstraints()):
        a, b, distance = system.getConstraintParameters(i)
        length = distance.value_in_unit(unit.nanometer)
        pair = min(a, b), max(a, b)
        other = lengths.setdefault(pair, length)
        if abs(other - length) > EMBEDDING_TOLERANCE:
            raise RigidityError(
                f"the constraints of atoms {pair[0]} and {pair[1]} contradict each other: they are to be {other:.4f} "
                f"and {length:.4f} nm apart"
            )
    return lengths


def _clusters(pairs) -> list[Cluster]:
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


def _from_sites(kind: Kind, sites) -> list[Species]:
    """The species whose principal frames `BodyPlan.bodies` was given; none if these masses do not balance in them."""
    if sites is None:
        return []
    clusters, masses = np.array(kind.clusters), np.array(kind.masses)
    frames = sites[clusters]
    inertia = np.einsum("k,mkx,mky->mxy", masses, frames, frames)
    spread = np.trace(inertia, axis1=1, axis2=2)
    off_centre = np.abs(np.einsum("k,mkx->mx", masses, frames)).max(axis=1)
    off_axes = np.abs(inertia * (1 - np.eye(3))).max(axis=(1, 2))
    # Both are rounding for principal frames; other masses leave per cents.
    if (spread == 0).any() or (off_axes > 1e-9 * spread).any() or (off_centre**2 > 1e-18 * masses.sum() * spread).any():
        return []
    species = []
    while len(clusters):
        same = (frames == frames[0]).all(axis=(1, 2))
        species.append(_of_sites(clusters[same], masses, frames[0]))
        clusters, frames = clusters[~same], frames[~same]
    return species


def _of_sites(clusters, masses, frame) -> Species:
    """A species whose moments depend, to the bit, on nothing but its sites (k, 3) and masses."""
    sites = np.ascontiguousarray(frame.T)
    squares = (masses * sites**2).sum(axis=1)
    moments = squares.sum() - squares
    moments[moments <= LINEAR_MOMENT * moments.max()] = 0.0
    return Species(clusters, masses, sites, moments)


def refuse_other_masses(system, bodies: RigidBodies) -> None:
    """Refuse bodies whose masses are not those of the System.

    Raises:
        ValueError: naming the first body and atom.
    """
    masses = np.array([system.getParticleMass(i).value_in_unit(unit.dalton) for i in range(bodies.n_particles)])
    for species in bodies.species:
        wrong = np.argwhere(masses[species.atoms] != species.masses)
        if len(wrong):
            body, site = wrong[0]
            atom = species.atoms[body, site]
            raise ValueError(
                f"{bodies.describe_atoms(species.atoms[body])} was made with a mass of {species.masses[site]} for atom "
                f"{atom}, the System has {masses[atom]}: make the bodies anew"
            )


def _by_handedness(model: Species, positions) -> list[Species]:
    """The bodies of a species apart from those that are its mirror images."""
    mirror = model.mirrored()
    arms = _arms(model.masses, positions[model.atoms])
    mirrored = fit_attitudes(mirror, arms)[1] < fit_attitudes(model, arms)[1]
    halves = [(model, model.atoms[~mirrored]), (mirror, model.atoms[mirrored])]
    return [species.of_atoms(atoms) for species, atoms in halves if len(atoms)]


def _arms(masses, positions):
    """Positions (m, k, 3) from the centres of mass."""
    return positions - np.einsum("k,mkx->mx", masses / masses.sum(), positions)[:, None]


def _embed(k, distances):
    """Coordinates (k, 3) of points with given distances, and the largest distance error.

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
