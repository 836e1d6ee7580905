"""Find the rigid bodies of a System, defined by its constraints or named by the user."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import chain, combinations

import numpy as np
import openmm

from openmm_sier.dynamics import bodies as dynamics
from openmm_sier.dynamics.bodies import RigidityError
from openmm_sier.dynamics.constraints.graph import joined
from openmm_sier.dynamics.species import Species
from openmm_sier.system import geometries, tables
from openmm_sier.system.arguments import Positions, checked_clusters, checked_positions, checked_system
from openmm_sier.system.cut_molecules import Wholeness
from openmm_sier.system.geometries import Cluster, Kind, Lengths
from openmm_sier.system.links import Links, joins_a_body, linked

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
    """

    @classmethod
    def from_system(
        cls,
        system: openmm.System,
        topology: openmm.app.Topology | None = None,
        rigid: Rigid = None,
        positions: Positions | None = None,
    ) -> RigidBodies:
        """Find the bodies of a System.

        Named bodies are rigid and take their shape from the positions. Molecules with all distances constrained, such
        as water, are rigid too and take their shape from the constraints. All other atoms are points with their
        constraints. Virtual sites follow their atoms. Massless particles that are not virtual sites are frozen: they
        do not move, and constraints between them are ignored.

        >>> named = RigidBodies.from_system(system, topology, [[0, 1, 2, 3, 4, 5]], positions)
        >>> integrator = SIERIntegrator(4*femtoseconds, bodies=named)

        Molecules of one kind whose lengths or positions differ slightly, as they do in a PDB file, share the average
        geometry.

        Args:
            system: the System.
            topology: the topology, for residue names in messages.
            rigid: lists of particle indices, as returned by `select_bodies`, of rigid bodies in addition to those
                defined by constraints.
            positions: (N, 3), nm or a Quantity, with the shapes of the bodies in `rigid`.

        Raises:
            RigidityError: constraint lengths contradict each other, a constraint joins a body to another particle, a
                body contains a massless particle that is not a virtual site, required positions are missing, or the
                periodic boundary cuts a body that takes its shape from the positions.
            ValueError: `rigid` names nonexistent particles, or a particle twice; it has an empty list; or positions
                have the wrong shape.
            TypeError: `system` is not an openmm.System, or `rigid` contains anything but lists of particle indices.
        """
        n = checked_system(system).getNumParticles()
        coordinates = None if positions is None else checked_positions(positions, n)
        return BodyPlan(system, topology, rigid).bodies(coordinates)


class BodyPlan:
    """Rigid bodies of a System before positions are known.

    See `RigidBodies.from_system` for arguments, rules and errors.

    Attributes:
        kinds: the kinds of body.
    """

    def __init__(self, system: openmm.System, topology: openmm.app.Topology | None = None, rigid: Rigid = None):
        n = system.getNumParticles()
        self._labels = None if topology is None else _residue_labels(topology, n)
        self._n = n
        self._describe = RigidBodies([], n, self._labels).describe_atoms
        self._masses = tables.masses(system)
        self._links = Links(system)
        lengths = self._links.constraints.by_pair()
        named = self._checked(rigid, system)
        self.kinds = geometries.kinds(self._clusters(named, lengths), self._masses.tolist(), self._describe)
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
        species: list[Species] = []
        for kind in self.kinds:
            if kind.needs_positions:
                self._refuse_unusable(kind, positions)
            if kind.model is None:
                species += geometries.from_positions(kind, positions, self._describe)
            elif kind.needs_positions:
                species += geometries.by_handedness(kind.model, positions)
            else:
                species.append(kind.model)
        return self._links.link(RigidBodies(species, self._n, self._labels))

    # --- which particles ---

    def _checked(self, rigid: Rigid, system: openmm.System) -> list[Cluster]:
        """Return named bodies without virtual sites, and without bodies that are frozen entirely."""
        clusters: list[Cluster] = []
        for number, particles in enumerate(checked_clusters([] if rigid is None else rigid)):
            if not particles:
                raise ValueError(f"each body must have particles, but the list of body {number} is empty")
            if outside := [i for i in particles if not 0 <= i < self._n]:
                raise ValueError(f"bodies name particle {outside[0]}, but the System has only {self._n} particles")
            cluster = tuple(i for i in particles if not system.isVirtualSite(i))
            without = [i for i in cluster if not self._masses[i]]
            if len(without) == len(cluster):
                continue
            if without:
                raise RigidityError(
                    f"{self._describe(cluster)}: atom {without[0]} has no mass and is not a virtual site. Give it a "
                    "mass, or leave it out of the body; or freeze all atoms of the body"
                )
            clusters.append(cluster)
        particle, times = next(iter(Counter(chain(*clusters)).most_common(1)), (0, 0))
        if times > 1:
            raise ValueError(f"bodies name particle {particle} twice")
        return clusters

    def _clusters(self, named: list[Cluster], lengths: Lengths) -> Iterator[tuple[Cluster, Lengths]]:
        """Yield all bodies, with the constraints inside them.

        Raises:
            RigidityError: a constraint joins a body to another particle.
        """
        owner = {i: cluster for cluster in named for i in cluster}
        inside: dict[Cluster, Lengths] = {cluster: {} for cluster in named}
        loose: Lengths = {}
        for (a, b), length in lengths.items():
            if owner.get(a) != owner.get(b):
                raise joins_a_body(a, b)
            (inside[owner[a]] if a in owner else loose)[a, b] = length
        yield from inside.items()
        free = self._masses > 0
        free[list(owner)] = False
        for cluster, rigid in _constrained_clusters(loose, self._links):
            if rigid:
                free[list(cluster)] = False
                yield cluster, {pair: lengths[pair] for pair in combinations(cluster, 2)}
        for atom in np.flatnonzero(free).tolist():
            yield (atom,), {}

    def _refuse_unusable(self, kind: Kind, positions: np.ndarray) -> None:
        """Refuse positions that give no shape."""
        for cluster in kind.clusters:
            if not np.isfinite(positions[cluster]).all():
                raise RigidityError(f"the positions of {self._describe(cluster)} are not finite")
        if self._wholeness is not None:
            self._wholeness.refuse_cut(positions, kind.clusters, self._describe)


def bodies_of(system: openmm.System, bodies: dynamics.BodySet | None) -> dynamics.BodySet:
    """Return the bodies of a System for the argument `bodies` of an integrator; None finds them in the constraints.

    Raises:
        ValueError: the bodies belong to a System with another number of particles or other masses.
        RigidityError: see `RigidBodies.from_system` and `linked`.
    """
    return BodyPlan(system).bodies() if bodies is None else linked(system, bodies)


def _residue_labels(topology: openmm.app.Topology, n_particles: int) -> list[str]:
    labels = [f"{atom.residue.name} {atom.residue.id}" for atom in topology.atoms()]
    if len(labels) != n_particles:
        raise ValueError(f"the topology has {len(labels)} atoms, but the System has {n_particles} particles")
    return labels


# --- constraints ------------------------------------------------------------------------------------------------------


def _constrained_clusters(lengths: Lengths, links: Links) -> Iterator[tuple[Cluster, bool]]:
    """Return clusters joined by constraints, each with whether it is a whole molecule with every distance constrained.

    A rigid group in a larger molecule does not count: fast forces move only points, so its atoms keep constraints.
    """
    pairs = np.array(list(lengths), dtype=np.int64).reshape(-1, 2)
    members, first = np.unique(pairs), joined(links.n_particles, pairs)
    names, sizes = np.unique(first[members], return_counts=True)
    ordered = members[np.argsort(first[members], kind="stable")]
    clusters = [tuple(cluster.tolist()) for cluster in np.split(ordered, np.cumsum(sizes)[:-1])][: len(names)]
    counts = np.bincount(np.searchsorted(names, first[pairs[:, 0]]), minlength=len(names))
    complete = counts == sizes * (sizes - 1) // 2
    return zip(clusters, (complete & ~links.leave(clusters)).tolist(), strict=True)
