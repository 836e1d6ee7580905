"""Find the rigid bodies of a System, defined by its constraints or named by the user."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, combinations

import numpy as np
import openmm

from openmm_sier.dynamics import bodies as dynamics
from openmm_sier.dynamics.bodies import RigidityError
from openmm_sier.dynamics.constraints.graph import joined
from openmm_sier.dynamics.index_ranges import distinct
from openmm_sier.dynamics.species import Species
from openmm_sier.system import geometries, tables
from openmm_sier.system.arguments import (
    Positions,
    Quantity,
    checked_clusters,
    checked_positions,
    checked_system,
)
from openmm_sier.system.body_types import BodyType
from openmm_sier.system.cut_molecules import Wholeness
from openmm_sier.system.geometries import Cluster, Clusters, Kind
from openmm_sier.system.links import Links, joins_a_body, linked, links_of
from openmm_sier.system.typed_bodies import typed_species
from openmm_sier.system.user_warnings import warn

#: Values of the argument `rigid`.
Rigid = Sequence[Sequence[int]] | None


class UnknownShapeError(RigidityError):
    """Bodies whose shape only positions can give."""


class RigidBodies(dynamics.BodySet):
    """Rigid and point bodies of an OpenMM System; see `from_system`.

    >>> bodies = RigidBodies.from_system(system, topology)
    >>> print(bodies)
    <RigidBodies: 59 rigid of 3 atoms>
    >>> bodies.dof
    354

    Bodies are numbered as they were listed, followed by those that constraints form and by points, each in the order of
    their particles.
    """

    @classmethod
    @tables.read_once()
    def from_system(
        cls,
        system: openmm.System,
        topology: openmm.app.Topology | None = None,
        rigid: Rigid = None,
        positions: Positions | None = None,
        tolerance: Quantity | None = None,
    ) -> RigidBodies:
        """Find the bodies of a System.

        Named bodies are rigid and take their shape from the positions. Molecules with all distances constrained, such
        as water, are rigid too and take their shape from the constraints. All other atoms are points with their
        constraints. Virtual sites follow their atoms. Massless particles that are not virtual sites are frozen: they
        do not move, and constraints between them are ignored.

        >>> named = RigidBodies.from_system(system, topology, [[0, 1, 2, 3, 4, 5]], positions)
        >>> integrator = SIERIntegrator(4*femtoseconds, bodies=named)

        Bodies of the same masses that differ only by the rounding of a PDB file share their mean geometry; all others
        keep their own, and mirror images are different. `print(bodies)` shows the number of kinds, and by how much an
        atom was moved.

        Args:
            system: the System.
            topology: the topology, for residue names in messages.
            rigid: lists of particle indices, as returned by `select_bodies`, of rigid bodies in addition to those
                defined by constraints.
            positions: (N, 3), nm or a Quantity, with the shapes of the bodies in `rigid`.
            tolerance: distance by which each atom may be moved so that bodies share a geometry, a quantity or a number
                in nm; 0 gives each body its own. None takes 0.0002 nm, the rounding of PDB files, and warns of bodies
                that probably are of one kind. Positions from a GRO file need 0.002 nm, molecules with thermal motion
                0.01 nm.

        Raises:
            RigidityError: constraint lengths contradict each other, a constraint joins a body to another particle, a
                body contains a massless particle that is not a virtual site, required positions are missing, or the
                periodic boundary cuts a body that takes its shape from the positions.
            ValueError: `rigid` names nonexistent particles, or a particle twice; it has an empty list; positions
                have the wrong shape; or `tolerance` is negative.
            TypeError: `system` is not an openmm.System, or `rigid` contains anything but lists of particle indices.
        """
        n = checked_system(system).getNumParticles()
        coordinates = None if positions is None else checked_positions(positions, n)
        return BodyPlan(system, topology, rigid, tolerance).bodies(coordinates)

    @classmethod
    @tables.read_once()
    def from_types(
        cls,
        system: openmm.System,
        types: Mapping[BodyType, Sequence[Sequence[int]]],
        positions: Positions,
        topology: openmm.app.Topology | None = None,
    ) -> RigidBodies:
        """Find the bodies of a System of which some have types, whose shapes they have exactly.

        >>> system, topology = openmm.System(), openmm.app.Topology()
        >>> dimer = BodyType("dimer", [[0, 0, 0], [0.3, 0, 0]], [40, 40])
        >>> dimers, positions = add_bodies(system, topology, dimer, [[0, 0, 0], [1, 0, 0]])
        >>> print(RigidBodies.from_types(system, {dimer: dimers}, positions))
        <RigidBodies: 2 dimer of 2 atoms>

        Other bodies are found as by `from_system`.

        Args:
            system: the System, in which particles have the masses of their sites.
            types: for each type lists of particle indices, one for each body, in the order of the sites.
            positions: positions of all particles, (N, 3), nm or a Quantity, with bodies whole; only their fit to the
                types is checked.
            topology: the topology, for residue names in messages.

        Raises:
            RigidityError: the positions do not fit a type, as the message says by how much; the last axis of a body
                with `Motion.IN_PLANE` is not along z; a constraint joins a body to another particle, or has another
                length than in the type; or see `from_system`.
            ValueError: a list does not have a particle for each site, a particle is in two lists or has another mass
                than its site, two types have one name, or positions have the wrong shape.
            TypeError: `types` is no mapping from types to lists of particle indices.
        """
        n = checked_system(system).getNumParticles()
        coordinates = checked_positions(positions, n)
        typed = typed_species(system, types, coordinates)
        return BodyPlan(system, topology, typed=typed).bodies(coordinates)


class BodyPlan:
    """Rigid bodies of a System before positions are known.

    See `RigidBodies.from_system` for arguments, rules and errors.

    Attributes:
        kinds: the kinds of body.
    """

    def __init__(
        self,
        system: openmm.System,
        topology: openmm.app.Topology | None = None,
        rigid: Rigid = None,
        tolerance: Quantity | None = None,
        typed: Sequence[Species] = (),
    ):
        self._typed = tuple(typed)
        self._warns = tolerance is None
        self._tolerance = geometries.TOLERANCE if tolerance is None else geometries.checked_tolerance(tolerance)
        n = system.getNumParticles()
        self._labels = None if topology is None else _residue_labels(topology, n)
        self._n = n
        self._describe = RigidBodies([], n, self._labels).describe_atoms
        self._masses = tables.masses(system)
        self._links = links_of(system)
        clusters = self._clusters(self._checked(rigid, system))
        self.kinds = geometries.kinds(clusters, self._masses, self._describe, self._tolerance)
        self._wholeness = Wholeness(system, topology) if self.needs_positions else None

    @property
    def species(self) -> tuple[Species, ...]:
        """Kinds of body whose geometry constraints define; some may also have mirror images."""
        return tuple(kind.model for kind in self.kinds if kind.model is not None)

    @property
    def needs_positions(self) -> bool:
        """Whether some bodies take their geometry from positions."""
        return any(kind.needs_positions for kind in self.kinds)

    def bodies(self, positions: np.ndarray | None = None) -> RigidBodies:
        """Return all bodies.

        Args:
            positions: (N, 3), nm, in the default box of the System.

        Raises:
            UnknownShapeError: required positions are missing.
            RigidityError: they contradict the constraints, or the boundary cuts a body that takes its shape from them.
        """
        if positions is None:
            if self.needs_positions:
                raise UnknownShapeError(
                    "named bodies, and rigid molecules that are not flat, take their shape from positions: give "
                    "positions, as in bodies=RigidBodies.from_system(system, topology, rigid, positions)"
                )
            positions = np.empty((0, 3))
        species = list(self._typed)
        moved = [kind.moved for kind in self.kinds]
        self._refuse_unusable([kind.clusters for kind in self.kinds if kind.needs_positions], positions)
        for kind in self.kinds:
            if kind.model is None:
                shaped = geometries.from_positions(kind, positions, self._tolerance, self._describe)
                species += [model for model, _ in shaped]
                moved += [distance for _, distance in shaped]
                if len(shaped) > 1 and self._warns:
                    self._warn_if_one_is_meant(kind, len(shaped), positions)
            elif kind.needs_positions:
                species += geometries.by_handedness(kind.model, positions)
            else:
                species.append(kind.model)
        numbers = self._numbered(species)
        bodies = RigidBodies(species, self._n, self._labels, moved=max(moved, default=0.0), numbers=numbers)
        return self._links.link(bodies)

    def _numbered(self, species: Sequence[Species]) -> list[np.ndarray]:
        """Return the indices of the bodies of each kind: listed ones in their order, then others, then points."""
        if not species:
            return []
        counts = [len(kind.atoms) for kind in species]
        first = np.concatenate([kind.atoms[:, 0] for kind in species])
        is_point = np.repeat([kind.atoms.shape[1] == 1 for kind in species], counts)
        listed = self._list[first]
        rank = np.where(listed >= 0, listed - self._n, first + self._n * is_point)
        return np.split(np.argsort(np.argsort(rank)), np.cumsum(counts)[:-1])

    # --- which particles ---

    def _checked(self, rigid: Rigid, system: openmm.System) -> list[Cluster]:
        """Return named bodies without virtual sites, and without bodies that are frozen entirely."""
        clusters: list[Cluster] = []
        sites = set(tables.virtual_sites(system).tolist())
        massless = set(np.flatnonzero(self._masses == 0).tolist())
        for number, particles in enumerate(checked_clusters([] if rigid is None else rigid)):
            if not particles:
                raise ValueError(f"each body must have particles, but the list of body {number} is empty")
            if min(particles) < 0 or max(particles) >= self._n:
                outside = next(i for i in particles if not 0 <= i < self._n)
                raise ValueError(f"bodies name particle {outside}, but the System has only {self._n} particles")
            if massless.isdisjoint(particles):
                clusters.append(tuple(particles))
                continue
            cluster = tuple(i for i in particles if i not in sites)
            without = [i for i in cluster if i in massless]
            if len(without) == len(cluster):
                continue
            if without:
                raise RigidityError(
                    f"{self._describe(cluster)}: atom {without[0]} has no mass and is not a virtual site. Take a "
                    "BodyType with moments and RigidBodies.from_types, which have massless sites; give it a mass, and "
                    "the body its moments by set_inertia; make it a virtual site of the others; or freeze all atoms of "
                    "the body"
                )
            clusters.append(cluster)
        times = np.bincount(np.fromiter(chain.from_iterable(clusters), np.int64), minlength=1)
        if times.max() > 1:
            raise ValueError(f"bodies name particle {times.argmax()} twice")
        return clusters

    def _clusters(self, named: list[Cluster]) -> Iterator[Clusters]:
        """Yield all bodies: named ones, those that constraints form, and single atoms.

        Raises:
            RigidityError: a constraint joins a body to another particle.
        """
        pairs, lengths = self._links.constraints
        owner = np.full(self._n, -1)
        if named:
            owner[np.concatenate(named)] = np.repeat(np.arange(len(named)), list(map(len, named)))
        count = len(named)
        for kind in self._typed:
            owner[kind.atoms] = np.arange(count, count + len(kind.atoms))[:, None]
            count += len(kind.atoms)
        self._list = owner
        ends = owner[pairs]
        if (joins := ends[:, 0] != ends[:, 1]).any():
            raise joins_a_body(*pairs[joins.argmax()].tolist())
        inside = np.flatnonzero((ends[:, 0] >= 0) & (ends[:, 0] < len(named)))
        yield from _named_clusters(named, ends[inside, 0], pairs[inside], lengths[inside])
        free = (self._masses > 0) & (owner < 0)
        for atoms in _rigid_molecules(pairs[ends[:, 0] < 0], self._links):
            size = atoms.shape[1]
            places = np.array(list(combinations(range(size), 2)))
            distances = self._links.constraints.lengths_of(atoms[:, places].reshape(-1, 2))
            yield Clusters(atoms, places, distances.reshape(len(atoms), len(places)))
            free[atoms] = False
        points = np.flatnonzero(free)[:, None]
        if len(points):
            yield Clusters(points, np.empty((0, 2), dtype=np.int64), np.empty((len(points), 0)))

    def _warn_if_one_is_meant(self, kind: Kind, number: int, positions: np.ndarray) -> None:
        """Warn about shapes that differ so little that they may be one with thermal motion, or from a GRO file."""
        largest = geometries.differences(kind, positions).max()
        if largest <= geometries.THERMAL:
            warn(
                f"{len(kind.clusters)} bodies like {self._describe(kind.clusters[0])} have {number} shapes, which "
                f"differ by at most {largest:.2g} nm. If they are one shape, rounded in a GRO file or with thermal "
                "motion, give RigidBodies.from_system(…, tolerance=0.002) or 0.01; if not, tolerance=0"
            )

    def _refuse_unusable(self, kinds: list[np.ndarray], positions: np.ndarray) -> None:
        """Refuse positions that give bodies, (m, k) particles of each kind, no shape."""
        for clusters in kinds:
            is_finite = np.isfinite(positions[clusters]).all(axis=(1, 2))
            if not is_finite.all():
                raise RigidityError(f"the positions of {self._describe(clusters[is_finite.argmin()])} are not finite")
        if self._wholeness is not None:
            self._wholeness.refuse_cut(positions, kinds, self._describe)


def bodies_of(system: openmm.System, bodies: dynamics.BodySet | None) -> dynamics.BodySet:
    """Return the bodies of a System for the argument `bodies` of an integrator; None finds them in the constraints.

    Raises:
        ValueError: the bodies belong to a System with another number of particles or other masses.
        RigidityError: see `RigidBodies.from_system` and `linked`.
    """
    return _formed_by_constraints(system) if bodies is None else linked(system, bodies)


@tables.once
def _formed_by_constraints(system: openmm.System) -> RigidBodies:
    """Return the bodies that the constraints of a System form."""
    return BodyPlan(system).bodies()


def _residue_labels(topology: openmm.app.Topology, n_particles: int) -> list[str]:
    labels = [f"{atom.residue.name} {atom.residue.id}" for atom in topology.atoms()]
    if len(labels) != n_particles:
        raise ValueError(f"the topology has {len(labels)} atoms, but the System has {n_particles} particles")
    return labels


# --- constraints ------------------------------------------------------------------------------------------------------


def _named_clusters(
    named: list[Cluster], bodies: np.ndarray, pairs: np.ndarray, lengths: np.ndarray
) -> Iterator[Clusters]:
    """Yield named bodies with the constraints inside them, those that follow each other and are alike together.

    Args:
        named: particle indices of each.
        bodies: the body of each constraint, (c,).
        pairs, lengths: the constraints inside them, (c, 2) and (c,).
    """
    order = np.argsort(bodies, kind="stable")
    ends = np.searchsorted(bodies[order], np.arange(len(named) + 1))
    alike: list[tuple[Cluster, list[float]]] = []
    last: tuple = ()
    for cluster, start, end in zip(named, ends[:-1].tolist(), ends[1:].tolist(), strict=True):
        rows: list[tuple[int, int, float]] = []
        if start < end:
            place = {particle: i for i, particle in enumerate(cluster)}
            inside = order[start:end]
            local = (sorted((place[a], place[b])) for a, b in pairs[inside].tolist())
            rows = sorted((*ends, length) for ends, length in zip(local, lengths[inside].tolist(), strict=True))
        key = len(cluster), tuple((i, j) for i, j, _ in rows)
        if alike and key != last:
            yield _stacked(alike, last)
            alike = []
        last = key
        alike.append((cluster, [length for _, _, length in rows]))
    if alike:
        yield _stacked(alike, last)


def _stacked(alike: list[tuple[Cluster, list[float]]], key: tuple) -> Clusters:
    """Return clusters, and lengths inside them, whose `key` is the number of atoms and the constrained pairs."""
    atoms, lengths = zip(*alike, strict=True)
    return Clusters(np.array(atoms), np.array(key[1], dtype=np.int64).reshape(-1, 2), np.array(lengths, dtype=float))


def _rigid_molecules(pairs: np.ndarray, links: Links) -> Iterator[np.ndarray]:
    """Yield the molecules that constraints (c, 2) make rigid, those of one size that follow each other as (m, k).

    Every distance in them is constrained. A rigid group in a larger molecule does not count: fast forces move only
    points, so its atoms keep constraints.
    """
    if not len(pairs):
        return
    members, first = distinct(pairs), joined(links.n_particles, pairs)
    names, number, sizes = np.unique(first[members], return_inverse=True, return_counts=True)
    counts = np.bincount(np.searchsorted(names, first[pairs[:, 0]]), minlength=len(names))
    complete = counts == sizes * (sizes - 1) // 2
    cluster = np.full(links.n_particles, -1)
    cluster[members] = number
    chosen = np.flatnonzero(complete & ~links.leave(cluster, len(names)))
    ordered, starts = members[np.argsort(number, kind="stable")], np.cumsum(sizes) - sizes
    for run in np.split(chosen, np.flatnonzero(np.diff(sizes[chosen])) + 1) if chosen.size else ():
        yield ordered[starts[run][:, None] + np.arange(sizes[run[0]])]
