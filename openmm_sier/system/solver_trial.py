"""Find constraints that OpenMM's own solvers cannot satisfy.

OpenMM has two. SETTLE moves isolated triangles of constraints with two equal lengths, and takes it that the two atoms
beside the corner between them have the same mass. All others are solved together by iterations with one matrix, CCMA
(Eastman and Pande, J. Chem. Theory Comput. 6, 434 (2010)), which is made once and inverted. It is singular where
constraints follow from others, and far from the true one where it lacks angles: those between two constraints whose
outer atoms neither a third constraint nor a HarmonicAngleForce joins. Then iterations diverge.

Where that happens no rule tells but OpenMM itself, so that doubtful constraints are tried there, on a copy of the atoms
that they join. Trees of constraints, such as HBonds and the chains of AllBonds, are never redundant and are not tried.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.constraints.graph import joined
from openmm_sier.system import tables
from openmm_sier.system.geometries import EMBEDDING_TOLERANCE, RESOLUTION, embed

#: Atoms are displaced by a normal deviate of this size, nm, which solvers have to undo. It is the distance by which a
#: step of some fs leaves the constraints of hydrogens.
DISPLACEMENT = 1e-3

#: Relative tolerance that solvers are asked for, and errors in nm, and nm/ps for velocities of 1 nm/ps, up to which
#: constraints count as satisfied: iterations that converge have made the displacement a thousand times smaller.
TOLERANCE, SATISFIED = 1e-7, 1e-6

#: Lengths that differ by less than this, nm, make no other kind of cluster.
SAME_LENGTH = 1e-3

#: Positions whose distances are off by more than this, nm, are not those of the constraints, and tell nothing.
NOT_THERE = 0.01

#: How many atoms of a cluster a message names.
NAMED = 8

#: What to do about constraints on a line, for messages.
LINE_REMEDY = (
    "Give the mass to the two outer atoms and make the others virtual sites; or remove these constraints and name the "
    "atoms in `bodies`"
)

#: Larger clusters of fewer constraints than a rigid body has are chains with rings, and are not tried.
LARGEST = 100


class Unsolved(NamedTuple):
    """Constraints that OpenMM cannot satisfy.

    Attributes:
        atoms: that they join.
        why: a clause about these atoms.
        is_line: whether the atoms lie on a line, which the exact engine refuses too.
    """

    atoms: tuple[int, ...]
    why: str
    is_line: bool = False

    def __str__(self) -> str:
        """Return the constraints and why, for messages."""
        shown = ", ".join(map(str, self.atoms[:NAMED])) + (", …" if len(self.atoms) > NAMED else "")
        return f"the constraints of atoms {shown} ({self.why})"


class Cluster(NamedTuple):
    """Atoms that constraints join in rings.

    Attributes:
        atoms: particle indices, (k,), ascending.
        masses: (k,), dalton.
        pairs: numbers of atoms of the cluster, the smaller first, (c, 2), in the System's order.
        lengths: (c,), nm.
    """

    atoms: np.ndarray
    masses: np.ndarray
    pairs: np.ndarray
    lengths: np.ndarray

    def places(self) -> np.ndarray | None:
        """Return positions (k, 3) that the constraints define, up to a reflection; None where they leave them open."""
        k = len(self.atoms)
        if len(self.pairs) < k * (k - 1) // 2:
            return None
        distances = np.zeros((k, k))
        distances[tuple(self.pairs.T)] = self.lengths
        found, excess = embed(k, distances[np.triu_indices(k, 1)])
        return found if excess <= EMBEDDING_TOLERANCE else None

    def errors(self, places: np.ndarray) -> np.ndarray:
        """Return errors of the distances of places (k, 3) from the lengths, (c,), nm."""
        first, second = self.pairs.T
        return np.abs(np.linalg.norm(places[second] - places[first], axis=1) - self.lengths)


class SolverTrial:
    """Find constraints of a System that OpenMM's solvers cannot satisfy."""

    def __init__(self, system: openmm.System):
        """
        Args:
            system: openmm.System. A trial holds for it as it is now.

        Raises:
            RigidityError: see `tables.constraints`.
        """
        self._system = system
        self._found: Unsolved | None = None
        self._open: list[Cluster] = []
        groups = list(_clusters(system))
        for group in groups:
            self._found = self._found or _mixed_triangle(*group)
        for cluster in (cluster for group in groups for cluster in _kinds(*group)):
            places = cluster.places()
            if self._found is None:
                self._found = _surplus(cluster) or (None if places is None else self._tried(cluster, places))
            if places is None and len(cluster.atoms) <= LARGEST:
                self._open.append(cluster)

    def unsolved(self, positions: Callable[[], np.ndarray] | None = None) -> Unsolved | None:
        """Return the first constraints that OpenMM cannot satisfy; None if there are none.

        Args:
            positions: gives (N, 3), nm, by which clusters are tried whose geometry constraints leave open; None leaves
                them out. Clusters that positions show cut or not set yet are left for the next time.
        """
        if positions is None or self._found is not None or not self._open:
            return self._found
        now, waiting = positions(), []
        for cluster in self._open:
            places = now[cluster.atoms]
            if not cluster.errors(places).max() <= NOT_THERE:
                waiting.append(cluster)
            elif self._found is None:
                self._found = self._tried(cluster, places)
        self._open = waiting
        return self._found

    def _tried(self, cluster: Cluster, places: np.ndarray) -> Unsolved | None:
        if is_line(cluster.masses, places):
            return Unsolved(_atoms(cluster), "they lie on a line", is_line=True)
        if _is_solved(self._system, cluster, places):
            return None
        return Unsolved(_atoms(cluster), f"its iterations for these {len(cluster.lengths)} constraints diverge")


def is_line(masses: np.ndarray, places: np.ndarray) -> bool:
    """Tell whether atoms at places (k, 3) are within `RESOLUTION` of the axis of the smallest moment of inertia."""
    arms = places - masses @ places / masses.sum()
    _, axes = np.linalg.eigh(np.einsum("k,kx,ky->xy", masses, arms, arms))
    return bool(np.linalg.norm(arms @ axes[:, :2], axis=1).max() <= RESOLUTION)


def _atoms(cluster: Cluster) -> tuple[int, ...]:
    return tuple(cluster.atoms.tolist())


def _clusters(system: openmm.System) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Return clusters in which constraints form rings, those of as many atoms and constraints together.

    Yields:
        For m clusters the fields of `Cluster` as arrays (m, k), (m, k), (m, c, 2) and (m, c).
    """
    masses, (pairs, lengths) = tables.masses(system), tables.constraints(system)
    component = joined(len(masses), pairs)
    members = np.unique(pairs)
    sizes = np.bincount(component[members], minlength=len(masses))
    counts = np.bincount(component[pairs[:, 0]], minlength=len(masses))
    members = members[np.argsort(component[members], kind="stable")]
    order = np.argsort(component[pairs[:, 0]], kind="stable")
    pairs, lengths = pairs[order], lengths[order]
    rings = np.flatnonzero((counts >= sizes) & (sizes > 0))
    for k, c in np.unique(np.stack([sizes[rings], counts[rings]], axis=1), axis=0).tolist():
        chosen = (sizes == k) & (counts == c)
        atoms = members[chosen[component[members]]].reshape(-1, k)
        mine = chosen[component[pairs[:, 0]]]
        number = np.zeros(len(masses), dtype=np.int64)
        number[atoms] = np.arange(k)
        yield atoms, masses[atoms], number[pairs[mine]].reshape(-1, c, 2), lengths[mine].reshape(-1, c)


def _kinds(atoms: np.ndarray, masses: np.ndarray, pairs: np.ndarray, lengths: np.ndarray) -> Iterator[Cluster]:
    """Return one cluster of each kind."""
    rows = np.concatenate([masses, pairs.reshape(len(pairs), -1), np.round(lengths / SAME_LENGTH)], axis=1)
    _, first = np.unique(rows, axis=0, return_index=True)
    for i in np.sort(first).tolist():
        yield Cluster(atoms[i], masses[i], pairs[i], lengths[i])


def _mixed_triangle(atoms: np.ndarray, masses: np.ndarray, pairs: np.ndarray, lengths: np.ndarray) -> Unsolved | None:
    """Return the first triangle that OpenMM gives to SETTLE although two atoms that should weigh the same do not."""
    if atoms.shape[1] != 3 or lengths.shape[1] != 3:
        return None
    opposite = np.empty(lengths.shape, dtype=np.float32)
    # The two atoms of a pair add up to 3 less the number of the third. OpenMM compares lengths in single precision.
    np.put_along_axis(opposite, 3 - pairs.sum(axis=2), lengths.astype(np.float32), axis=1)
    taken = np.zeros(len(atoms), dtype=bool)
    for corner, one, other in ((0, 1, 2), (1, 0, 2), (2, 0, 1)):
        isosceles = ~taken & (opposite[:, one] == opposite[:, other])
        taken |= isosceles
        mixed = np.flatnonzero(isosceles & (masses[:, one] != masses[:, other]))
        if mixed.size:
            row, weights = atoms[mixed[0]], masses[mixed[0]]
            return Unsolved(
                tuple(row.tolist()),
                f"atoms {row[one]} and {row[other]} are equally far from atom {row[corner]} but differ in mass "
                f"({weights[one]:g} and {weights[other]:g} dalton), and OpenMM takes the masses for equal",
            )
    return None


def _surplus(cluster: Cluster) -> Unsolved | None:
    """Return a cluster of more constraints than any geometry of it needs."""
    given, enough = len(cluster.lengths), 3 * len(cluster.atoms) - 6
    if given <= enough:
        return None
    return Unsolved(_atoms(cluster), f"{given} constraints join them, and {enough} are enough")


def _is_solved(system: openmm.System, cluster: Cluster, places: np.ndarray) -> bool:
    """Tell whether OpenMM brings atoms near their places (k, 3), and their velocities, onto the constraints."""
    context = _alone(system, cluster)
    random = np.random.default_rng(0)
    context.setPositions(places + DISPLACEMENT * random.standard_normal(places.shape))
    context.applyConstraints(TOLERANCE)
    x = context.getState(positions=True).getPositions(asNumpy=True).value_in_unit(unit.nanometer)
    if not cluster.errors(x).max() <= SATISFIED:
        return False
    context.setPositions(places)
    context.setVelocities(random.standard_normal(places.shape))
    context.applyVelocityConstraints(TOLERANCE)
    state = context.getState(velocities=True)
    velocities = state.getVelocities(asNumpy=True).value_in_unit(unit.nanometer / unit.picosecond)
    first, second = cluster.pairs.T
    along = ((places[second] - places[first]) * (velocities[second] - velocities[first])).sum(axis=1) / cluster.lengths
    return bool(np.abs(along).max() <= SATISFIED)


def _alone(system: openmm.System, cluster: Cluster) -> openmm.Context:
    """Return a Context of a cluster alone, with the angles from which OpenMM makes its matrix."""
    number = {int(atom): i for i, atom in enumerate(cluster.atoms)}
    copy, angles = openmm.System(), openmm.HarmonicAngleForce()
    for mass in cluster.masses.tolist():
        copy.addParticle(mass)
    for (i, j), length in zip(cluster.pairs.tolist(), cluster.lengths.tolist(), strict=True):
        copy.addConstraint(i, j, length)
    for force in system.getForces():
        if not isinstance(force, openmm.HarmonicAngleForce):
            continue
        for term in range(force.getNumAngles()):
            *atoms, angle, strength = force.getAngleParameters(term)
            if all(atom in number for atom in atoms):
                angles.addAngle(*(number[atom] for atom in atoms), angle, strength)
    copy.addForce(angles)
    reference = openmm.Platform.getPlatformByName("Reference")
    return openmm.Context(copy, openmm.VerletIntegrator(0.001), reference)
