"""Rigid bodies: masses, moments and sites, and conversions between atoms and bodies.

Lengths are in nm, times in ps, masses in dalton, energies in kJ/mol, so that no conversion factors appear.
Arrays of bodies are component-first: a vector for each of n bodies has shape (3, n), an attitude matrix (3, 3, n).
Arrays of atoms have OpenMM's shape (N, 3).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np

from openmm_sier.dynamics import kernels
from openmm_sier.dynamics.constraints import Constraints
from openmm_sier.dynamics.constraints.graph import joined
from openmm_sier.dynamics.index_ranges import MAX_LISTED, as_ranges, distinct
from openmm_sier.dynamics.sites import Sites
from openmm_sier.dynamics.species import RigidityError as RigidityError
from openmm_sier.dynamics.species import Species, sites_of
from openmm_sier.dynamics.vectors import body_frame

#: Two arrays of bodies, for translation and rotation: centres and attitudes, momenta and angular momenta, forces and
#: torques, or inverse masses, (n,), and inverse moments, (3, n).
Pair = tuple[np.ndarray, np.ndarray]

#: Maximum number of residues of a body named in a message; of more, only the first and the last are named.
MOST_RESIDUES = 3


class NotFiniteError(ValueError):
    """Error for vectors of bodies that are not finite.

    Attributes:
        body: index of the first body with such a vector.
        what: name of the vector and the body.
    """

    def __init__(self, quantity: str, vectors: np.ndarray, bodies: "BodySet") -> None:
        """
        Args:
            quantity: name of the vector with a preposition, such as "force on".
            vectors: vectors of the bodies, (k, n).
            bodies: the bodies.
        """
        self.body = int(np.isfinite(vectors).all(axis=0).argmin())
        self.what = f"{quantity} {bodies.describe(self.body)}"
        super().__init__(f"the {self.what} is not finite")


class PlaceCache:
    """Results for one potential at the centres and attitudes of a state, once they have been computed.

    Attributes:
        forces: forces and torques of the kicks, each (3, n), kJ/mol/nm and kJ/mol.
        energy: potential energy, kJ/mol.
        members: state of the bodies that fast forces move, with a cache of its own for these forces.
    """

    forces: Pair | None = None
    energy: float | None = None
    members: "BodyState | None" = None


@dataclass(frozen=True, eq=False, init=False)
class BodyState:
    """Phase point of n rigid bodies, as returned by `integrator.getBodyState()`. It never changes in place.

    Attributes:
        q: centres of mass, (3, n), nm.
        p: momenta, (3, n), dalton nm/ps.
        A: attitude matrices, (3, 3, n); rows are the principal axes in the lab frame.
        L: angular momenta about the centres, in the lab frame, (3, n), dalton nm^2/ps.
        cache: of the place (q, A). States that differ in momenta share it; `dataclasses.replace` gives a new one.
    """

    q: np.ndarray
    p: np.ndarray
    A: np.ndarray
    L: np.ndarray
    cache: PlaceCache = field(init=False, repr=False)

    def __init__(
        self, q: np.ndarray, p: np.ndarray, A: np.ndarray, L: np.ndarray, cache: PlaceCache | None = None
    ) -> None:
        # Several of these are made in a step, and the generated constructor of a frozen class takes twice as long.
        attributes = self.__dict__
        attributes["q"] = q
        attributes["p"] = p
        attributes["A"] = A
        attributes["L"] = L
        attributes["cache"] = PlaceCache() if cache is None else cache


def molecule_of_atoms(molecules: Sequence[Sequence[int]], n_particles: int) -> np.ndarray:
    """Return the molecule index of each particle, (N,).

    Args:
        molecules: particle indices of each molecule, as returned by `Context.getMolecules()`.
        n_particles: number of particles of the system.
    """
    numbers = np.zeros(n_particles, dtype=int)
    for number, atoms in enumerate(molecules):
        numbers[list(atoms)] = number
    return numbers


class BodySet:
    """Rigid and point bodies of a system, and the constraints between them.

    Bodies are numbered species by species. Particles without a body (virtual sites, fixed massless particles) are
    ignored.

    Attributes:
        species: the kinds of body.
        columns: slice of the bodies of each species.
        masses: (n,), dalton.
        moments: principal moments, (3, n), dalton nm^2.
        molecules: molecule index of each body, (n,).
        moved: largest distance by which an atom was moved to give bodies of a kind one geometry, nm.
        sites: the atoms, with their positions in the bodies.
    """

    def __init__(
        self,
        species: Sequence[Species],
        n_particles: int,
        labels: Sequence[str] | None = None,
        links: tuple = ((), ()),
        molecules: np.ndarray | None = None,
        moved: float = 0.0,
    ):
        """
        Args:
            species: kinds of body; no particle may be in two bodies.
            n_particles: number of particles of the system.
            labels: residue name of each particle, for messages.
            links: pairs of point bodies at fixed distances, (c, 2), and the distances, (c,), nm.
            molecules: molecule index of each body, (n,). With None, linked bodies form a molecule, and any other body
                is a molecule.
            moved: largest distance in nm by which an atom was moved to give bodies of a kind one geometry.

        Raises:
            ValueError: a particle is in two bodies or out of range, a mass is not positive, or a link is not between
                two points.
        """
        self.species = tuple(species)
        self.n_particles = n_particles
        self.labels = labels
        self.moved = moved
        counts = [s.atoms.shape[0] for s in self.species]
        starts = np.cumsum([0, *counts])
        self.n = int(starts[-1])
        self.columns = tuple(slice(int(a), int(b)) for a, b in pairwise(starts))
        self._check()
        self.masses = np.repeat([s.mass for s in self.species], counts)
        self.moments = np.repeat(np.reshape([s.moments for s in self.species], (-1, 3)).T, counts, axis=1)
        sites, fractions = sites_of(self.species, self.columns)
        self.sites = sites
        self._fractions = fractions
        self.links = np.array(links[0], dtype=np.int64).reshape(-1, 2), np.array(links[1], dtype=float)
        linked = distinct(self.links[0])
        if linked.size and (extended := linked[self.moments[:, linked].any(axis=0)]).size:
            raise ValueError(
                f"{self.describe(extended[0])} is linked to another body, but links join only single atoms"
            )
        self.molecules = joined(self.n, self.constraints.pairs) if molecules is None else np.asarray(molecules)

    def __repr__(self) -> str:
        """Return a summary of bodies by numbers of atoms, and of constraints: `print(integrator.bodies)`."""
        kinds: dict[int, list[int]] = {}
        for s in self.species:
            kinds.setdefault(s.atoms.shape[1], []).append(s.atoms.shape[0])
        points, constraints = sum(kinds.pop(1, [])), len(self.links[1])
        words = [
            f"{sum(counts)} rigid of {size} atoms" + (f" ({len(counts)} kinds)" if len(counts) > 1 else "")
            for size, counts in sorted(kinds.items())
        ]
        if points:
            words.append(f"{points} point{'s' if points > 1 else ''}")
        if constraints:
            words.append(f"{constraints} constraint{'s' if constraints > 1 else ''} between points")
        # Rounding moves atoms by less.
        changes = f"; atoms moved by up to {self.moved:.1g} nm" if self.moved > 1e-8 else ""
        return f"<{type(self).__name__}: {', '.join(words) or 'none'}{changes}>"

    @cached_property
    def constraints(self) -> Constraints:
        """Constraints between point bodies.

        Raises:
            ConstraintError: the constraints contradict each other.
        """
        return Constraints(*self.links, self.masses, self.describe)

    @cached_property
    def dof(self) -> int:
        """Number of degrees of freedom of all bodies."""
        return sum(s.dof * s.atoms.shape[0] for s in self.species) - self.constraints.rank()

    @cached_property
    def flexible(self) -> np.ndarray:
        """Whether each body shares its molecule with other bodies, (n,), so that the molecule is flexible."""
        _, place, counts = np.unique(self.molecules, return_inverse=True, return_counts=True)
        return (counts > 1)[place]

    @cached_property
    def owners(self) -> np.ndarray:
        """Body index of each particle, (N,); -1 without a body."""
        owners = np.full(self.n_particles, -1)
        for species, columns in zip(self.species, self.columns, strict=True):
            owners[species.atoms] = np.arange(columns.start, columns.stop)[:, None]
        return owners

    def _check(self) -> None:
        used = np.concatenate([s.atoms.ravel() for s in self.species]) if self.species else np.zeros(0, int)
        outside = used[(used < 0) | (used >= self.n_particles)]
        if outside.size:
            raise ValueError(f"bodies name particle {outside[0]}, but the system has {self.n_particles} particles")
        twice = np.flatnonzero(np.bincount(used, minlength=self.n_particles) > 1)
        if twice.size:
            raise ValueError(f"particle {twice[0]} is in more than one body")
        for s in self.species:
            if not (s.masses > 0).all():
                raise ValueError(
                    f"{self.describe_atoms(s.atoms[0])} has an atom of mass {s.masses.min()}: masses must be positive"
                )

    def restricted(self, bodies: np.ndarray) -> "BodySet":
        """Return a subset of the bodies with the constraints between them. Atoms keep their indices.

        Args:
            bodies: ascending indices, (m,), which become 0 .. m-1.

        Raises:
            ConstraintError: a constraint joins a body of the subset to another body.
        """
        indices = np.asarray(bodies, dtype=np.int64)
        kinds = []
        for species, columns in zip(self.species, self.columns, strict=True):
            rows = indices[(indices >= columns.start) & (indices < columns.stop)] - columns.start
            if rows.size:
                kinds.append(species.of_atoms(species.atoms[rows]))
        between = self.constraints.restricted(indices)
        links = between.pairs, between.lengths
        return BodySet(kinds, self.n_particles, self.labels, links, self.molecules[indices])

    def atoms_of(self, body: int) -> np.ndarray:
        """Return the particle indices of a body."""
        for s, columns in zip(self.species, self.columns, strict=True):
            if columns.start <= body < columns.stop:
                return s.atoms[body - columns.start]
        raise IndexError(f"there is no body {body}: there are {self.n}, numbered from 0")

    def describe(self, body: int) -> str:
        """Return the name of a body for messages: residue, if known, and atoms."""
        return self.describe_atoms(self.atoms_of(body))

    def describe_atoms(self, atoms: Sequence[int] | np.ndarray) -> str:
        """Return the name of atoms for messages: residues, if known, and indices, as ranges in large bodies."""
        is_few = len(atoms) <= MAX_LISTED
        numbers = ", ".join(str(int(i)) for i in atoms) if is_few else as_ranges(atoms)
        names = f"atoms {numbers}" if len(atoms) > 1 else f"atom {numbers}"
        if self.labels is None:
            return names if len(atoms) == 1 else f"the body of {names}"
        residues = list(dict.fromkeys(self.labels[i] for i in atoms))
        if len(residues) > MOST_RESIDUES:
            return f"residues {residues[0]} to {residues[-1]} ({names})"
        return f"residue {' and '.join(residues)} ({names})"

    # --- from atoms to bodies ---

    def fit(self, positions: np.ndarray, previous: BodyState | None = None) -> Pair:
        """Return centres and attitudes of bodies from atom positions.

        Args:
            positions: (N, 3), nm.
            previous: a state whose attitudes are kept, bit for bit, if they reproduce the positions to rounding. So a
                barostat that moves bodies rigidly does not change attitudes.

        Returns:
            (q, A), shapes (3, n) and (3, 3, n).

        Raises:
            RigidityError: an atom is further than `Species.tolerance` from its site, or a position is not finite.
        """
        return self.fit_with_misfit(positions, previous)[:2]

    def fit_with_misfit(
        self, positions: np.ndarray, previous: BodyState | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Like `fit`, but also return the largest distance of an atom of each body from its site: (q, A, misfit)."""
        q, A = np.empty((3, self.n)), np.empty((3, 3, self.n))
        misfit = np.zeros(self.n)
        for s, columns in zip(self.species, self.columns, strict=True):
            x = positions[s.atoms]
            centre = np.einsum("k,mkx->mx", s.masses / s.mass, x)
            q[:, columns] = centre.T
            if not np.isfinite(centre).all():
                body = columns.start + int(np.flatnonzero(~np.isfinite(centre).all(axis=1))[0])
                raise RigidityError(f"the positions of {self.describe(body)} are not finite")
            arms = x - centre[:, None, :]
            A[:, :, columns], misfit[columns] = s.fit(arms, None if previous is None else previous.A[:, :, columns])
        self._refuse_torn(misfit)
        return q, A, misfit

    def _refuse_torn(self, misfit: np.ndarray) -> None:
        tolerances = np.repeat([s.tolerance for s in self.species], [len(s.atoms) for s in self.species])
        torn = misfit > tolerances
        if not torn.any():
            return
        worst = int(np.where(torn, misfit, 0.0).argmax())
        extended = self.moments.any(axis=0)
        unit = "Are the positions in nanometres? Those in angstroms need their unit. " if torn[extended].all() else ""
        raise RigidityError(
            f"{self.describe(worst)} does not fit its rigid shape: an atom is {misfit[worst]:.4f} nm off, and only "
            f"{tolerances[worst]:.4g} nm or less is corrected ({np.count_nonzero(torn)} of {self.n} bodies fail). "
            f"{unit}(1) If the periodic boundary cuts it, call make_whole(system, positions, bodies=bodies). (2) If "
            "constraints keep it rigid, call context.applyConstraints(1e-6). (3) If you named it in `bodies`, minimize "
            "in a Context with this integrator, not with another one; or start from the positions that gave it its "
            "shape"
        )

    def momenta(self, velocities: np.ndarray, A: np.ndarray) -> Pair:
        """Return momenta and angular momenta of bodies from atom velocities, the rigid part of the motion.

        Args:
            velocities: (N, 3), nm/ps.
            A: attitudes, (3, 3, n).

        Returns:
            (p, L), each of shape (3, n).

        Raises:
            NotFiniteError: one of them is not finite.
        """
        velocity, moment = self._sum_over_sites("velocity of", self.sites, velocities, A, self._fractions)
        return self.masses * velocity, self.masses * moment

    def forces_and_torques(self, forces: np.ndarray, A: np.ndarray, sites: Sites | None = None) -> Pair:
        """Return the net force and torque about the centre of mass (van Zon and Schofield 2007, Eq. 4 (forcestorques)).

        Args:
            forces: forces on the particles, (N, 3), kJ/mol/nm. Forces on virtual sites must already be passed on to
                massive particles, as OpenMM does.
            A: attitudes, (3, 3, n).
            sites: atoms with nonzero forces; None for all.

        Returns:
            (F, tau), each of shape (3, n), in kJ/mol/nm and kJ/mol.

        Raises:
            NotFiniteError: one of them is not finite.
        """
        chosen = self.sites if sites is None else sites
        return self._sum_over_sites("force on", chosen, forces, A, chosen.ones)

    def _sum_over_sites(
        self, quantity: str, sites: Sites, vectors: np.ndarray, A: np.ndarray, weights: np.ndarray
    ) -> Pair:
        total, moment = np.empty((3, self.n)), np.empty((3, self.n))
        tables = sites.sets, sites.places, weights, sites.atoms
        if kernels.atoms.collect(self.n, vectors, A, *tables, total, moment):
            raise NotFiniteError(quantity, np.concatenate([total, moment]), self)
        return total, moment

    # --- from bodies to atoms ---

    def place(self, q: np.ndarray, A: np.ndarray, positions: np.ndarray, sites: Sites | None = None) -> np.ndarray:
        """Write the atoms of bodies at (q, A) into `positions`, shape (N, 3), without changing other particles.

        Args:
            q: centres, (3, n).
            A: attitudes, (3, 3, n).
            positions: (N, 3), nm, which change.
            sites: atoms to be written; None for all.

        Raises:
            NotFiniteError: a position is not finite. All positions have been written then.
        """
        chosen = self.sites if sites is None else sites
        if kernels.atoms.place(self.n, q, A, chosen.sets, chosen.places, chosen.atoms, positions):
            raise NotFiniteError("position of", np.concatenate([q, A.reshape(9, -1)]), self)
        return positions

    def move(self, state: BodyState, velocities: np.ndarray) -> np.ndarray:
        """Write the atom velocities of a state into `velocities`, (N, 3), without changing other particles."""
        moving, tables = (state.p, state.A, state.L), (self.sites.sets, self.sites.places, self.sites.atoms)
        kernels.atoms.move(self.n, *moving, self.inverse_masses, self.inverse_moments, *tables, velocities)
        return velocities

    @cached_property
    def inverse_masses(self) -> np.ndarray:
        """Inverse masses, (n,), 1/dalton."""
        return 1 / self.masses

    @cached_property
    def inverse_moments(self) -> np.ndarray:
        """Inverse moments, (3, n), 1/(dalton nm^2); zero where the moment is zero."""
        return np.divide(1.0, self.moments, out=np.zeros_like(self.moments), where=self.moments > 0)

    @cached_property
    def point_particles(self) -> np.ndarray:
        """Whether each particle is a point body, (N,)."""
        is_point = np.zeros(self.n_particles, dtype=bool)
        for species in self.species:
            if species.atoms.shape[1] == 1:
                is_point[species.atoms] = True
        return is_point

    # --- observables ---

    def kinetic_energies(self, state: BodyState) -> tuple[float, float]:
        """Return the translational and rotational kinetic energy, kJ/mol."""
        translation = 0.5 * float(((state.p**2).sum(axis=0) / self.masses).sum())
        rotation = 0.5 * float((body_frame(state.A, state.L) ** 2 * self.inverse_moments).sum())
        return translation, rotation

    @cached_property
    def mass(self) -> float:
        """Total mass of all bodies, dalton."""
        return float(self.masses.sum())

    def centre_velocity(self, p: np.ndarray) -> np.ndarray:
        """Return the velocity of the total centre of mass, (3,), nm/ps, for momenta (3, n); zero without bodies."""
        return p.sum(axis=1) / self.mass if self.n else np.zeros(3)

    def shifted(self, state: BodyState, velocity: np.ndarray) -> BodyState:
        """Return the state with a velocity, (3,), nm/ps, added to all bodies."""
        p = state.p + self.masses * velocity[:, None]
        return BodyState(state.q, p, state.A, state.L, state.cache)

    def stopped(self, state: BodyState) -> tuple[BodyState, float]:
        """Return the state without the motion of the total centre of mass, and its energy, kJ/mol."""
        velocity = self.centre_velocity(state.p)
        return self.shifted(state, -velocity), -self.energy_of_shift(velocity, -velocity)

    def energy_of_shift(self, centre: np.ndarray, velocity: np.ndarray) -> float:
        """Return the energy gain when a velocity is added to all bodies, kJ/mol.

        Args:
            centre: previous velocity of the centre of mass, (3,), nm/ps.
            velocity: added velocity, (3,), nm/ps.
        """
        return self.mass * float((centre + 0.5 * velocity) @ velocity)

    def total_momenta(self, state: BodyState) -> Pair:
        """Return the total momentum and total angular momentum about the origin, each (3,)."""
        return state.p.sum(axis=1), (np.cross(state.q.T, state.p.T).T + state.L).sum(axis=1)
