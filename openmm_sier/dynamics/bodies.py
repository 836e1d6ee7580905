"""Rigid bodies: masses, moments and sites, and conversions between atoms and bodies.

Lengths are in nm, times in ps, masses in dalton, energies in kJ/mol, so that no conversion factors appear.
Arrays of bodies are component-first: a vector for each of n bodies has shape (3, n), an attitude matrix (3, 3, n).
Arrays of atoms have OpenMM's shape (N, 3).
"""

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from openmm_sier.dynamics import kernels
from openmm_sier.dynamics.body_state import BodyState as BodyState
from openmm_sier.dynamics.body_state import Pair as Pair
from openmm_sier.dynamics.body_state import PlaceCache as PlaceCache
from openmm_sier.dynamics.constraints import Constraints
from openmm_sier.dynamics.constraints.graph import joined
from openmm_sier.dynamics.index_ranges import MAX_LISTED, as_ranges, distinct
from openmm_sier.dynamics.indices import as_slice
from openmm_sier.dynamics.inertia import Inertia
from openmm_sier.dynamics.sites import Sites
from openmm_sier.dynamics.species import RigidityError as RigidityError
from openmm_sier.dynamics.species import Species, sites_of

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


class BodySet(Inertia):
    """Rigid and point bodies of a system, and the constraints between them.

    Particles without a body (virtual sites, fixed massless particles) are ignored.

    Attributes:
        species: the kinds of body.
        numbers: indices of the bodies of each species, (m,) for its m bodies.
        columns: the same as slices where they are evenly spaced.
        masses: (n,), dalton.
        moments: principal moments, (3, n), dalton nm^2.
        translates: whether each body moves along x, y and z, (3, n).
        turns: whether each body turns about its principal axes, (3, n).
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
        numbers: Sequence[np.ndarray] | None = None,
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
            numbers: indices of the bodies of each species; None numbers them species by species.

        Raises:
            ValueError: a particle is in two bodies or out of range, a mass is not positive, or a link is not between
                two points.
        """
        self.species = tuple(species)
        self.n_particles = n_particles
        self.labels = labels
        self.moved = moved
        counts = [s.atoms.shape[0] for s in self.species]
        self.n = sum(counts)
        order = np.arange(self.n) if numbers is None else np.concatenate([np.empty(0, np.int64), *numbers])
        self._check(order)
        self.numbers = tuple(np.split(order, np.cumsum(counts)[:-1])) if counts else ()
        self.columns = tuple(map(as_slice, self.numbers))
        kinds = self._rows[0]
        masses = np.array([s.mass for s in self.species], dtype=float)[kinds]
        moments = np.reshape([s.moments for s in self.species], (-1, 3))[kinds].T
        translates = np.array([s.motion.translations for s in self.species], dtype=bool).reshape(-1, 3)[kinds].T
        turns = np.array([s.turns for s in self.species], dtype=bool).reshape(-1, 3)[kinds].T
        super().__init__(masses, moments, translates, turns)
        sites, fractions = sites_of(self.species, self.numbers)
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
        """Return a summary of bodies by types or numbers of atoms, and of constraints: `print(integrator.bodies)`."""
        words = [f"{len(s.atoms)} {s.name} of {s.atoms.shape[1]} atoms" for s in self.species if s.name]
        kinds: dict[int, list[int]] = {}
        for s in self.species:
            if not s.name:
                kinds.setdefault(s.atoms.shape[1], []).append(s.atoms.shape[0])
        points, constraints = sum(kinds.pop(1, [])), len(self.links[1])
        words += [
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
    def has_other_moments(self) -> bool:
        """Whether the moments of some bodies are not those of the masses of their atoms."""
        return any(s.has_other_moments for s in self.species)

    @cached_property
    def flexible(self) -> np.ndarray:
        """Whether each body shares its molecule with other bodies, (n,), so that the molecule is flexible."""
        _, place, counts = np.unique(self.molecules, return_inverse=True, return_counts=True)
        return (counts > 1)[place]

    @cached_property
    def _rows(self) -> np.ndarray:
        """Species of each body, and its row there, (2, n)."""
        rows = np.empty((2, self.n), dtype=np.int64)
        for kind, numbers in enumerate(self.numbers):
            rows[:, numbers] = np.full(len(numbers), kind), np.arange(len(numbers))
        return rows

    @cached_property
    def owners(self) -> np.ndarray:
        """Body index of each particle, (N,); -1 without a body."""
        owners = np.full(self.n_particles, -1)
        for species, numbers in zip(self.species, self.numbers, strict=True):
            owners[species.atoms] = numbers[:, None]
        return owners

    def _check(self, order: np.ndarray) -> None:
        if not np.array_equal(np.sort(order), np.arange(self.n)):
            raise ValueError(f"the numbers of {self.n} bodies must be 0 to {self.n - 1}, each once, got {order}")
        used = np.concatenate([s.atoms.ravel() for s in self.species]) if self.species else np.zeros(0, int)
        outside = used[(used < 0) | (used >= self.n_particles)]
        if outside.size:
            raise ValueError(f"bodies name particle {outside[0]}, but the system has {self.n_particles} particles")
        twice = np.flatnonzero(np.bincount(used, minlength=self.n_particles) > 1)
        if twice.size:
            raise ValueError(f"particle {twice[0]} is in more than one body")

    def restricted(self, bodies: np.ndarray) -> "BodySet":
        """Return a subset of the bodies with the constraints between them. Atoms keep their indices.

        Args:
            bodies: ascending indices, (m,), which become 0 .. m-1.

        Raises:
            ConstraintError: a constraint joins a body of the subset to another body.
        """
        indices = np.asarray(bodies, dtype=np.int64)
        places = np.full(self.n, -1)
        places[indices] = np.arange(len(indices))
        kinds, numbers = [], []
        for species, columns in zip(self.species, self.columns, strict=True):
            rows = np.flatnonzero(places[columns] >= 0)
            if rows.size:
                kinds.append(species.of_atoms(species.atoms[rows]))
                numbers.append(places[columns][rows])
        between = self.constraints.restricted(indices)
        links = between.pairs, between.lengths
        return BodySet(kinds, self.n_particles, self.labels, links, self.molecules[indices], numbers=numbers)

    def atoms_of(self, body: int) -> np.ndarray:
        """Return the particle indices of a body."""
        if 0 <= body < self.n:
            kind, row = self._rows[:, body]
            return self.species[kind].atoms[row]
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
        for s, numbers, columns in zip(self.species, self.numbers, self.columns, strict=True):
            x = positions[s.atoms]
            centre = np.einsum("k,mkx->mx", s.masses / s.mass, x)
            q[:, columns] = centre.T
            if not np.isfinite(centre).all():
                row = np.isfinite(centre).all(axis=1).argmin()
                raise RigidityError(f"the positions of {self.describe(int(numbers[row]))} are not finite")
            arms = x - centre[:, None, :]
            A[:, :, columns], misfit[columns] = s.fit(arms, None if previous is None else previous.A[:, :, columns])
        self._refuse_torn(misfit)
        return q, A, misfit

    def _refuse_torn(self, misfit: np.ndarray) -> None:
        tolerances = np.empty(self.n)
        for s, columns in zip(self.species, self.columns, strict=True):
            tolerances[columns] = s.tolerance
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
        p, L = self.masses * velocity, self.masses * moment
        for s, columns in zip(self.species, self.columns, strict=True):
            if s.has_other_moments:
                relative = velocities[s.atoms] - velocity[:, columns].T[:, None]
                L[:, columns] = s.angular_momenta(relative, A[:, :, columns])
        if self.bearings is not None:
            self.bearings.remove(p, L, A)
        return p, L

    def forces_and_torques(self, forces: np.ndarray, A: np.ndarray, sites: Sites | None = None) -> Pair:
        """Return the net force and torque about the centre of mass (van Zon and Schofield 2007, Eq. 4 (forcestorques)).

        Bearings take up those along which a body does not move.

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
        F, tau = self._sum_over_sites("force on", chosen, forces, A, chosen.ones)
        if self.bearings is not None:
            self.bearings.remove(F, tau, A)
        return F, tau

    def _sum_over_sites(
        self, quantity: str, sites: Sites, vectors: np.ndarray, A: np.ndarray, weights: np.ndarray
    ) -> Pair:
        total, moment = np.empty((3, self.n)), np.empty((3, self.n))
        tables = sites.sets, sites.bodies, sites.places, weights, sites.atoms
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
        if kernels.atoms.place(self.n, q, A, *chosen.tables, positions):
            raise NotFiniteError("position of", np.concatenate([q, A.reshape(9, -1)]), self)
        return positions

    def move(self, state: BodyState, velocities: np.ndarray) -> np.ndarray:
        """Write the atom velocities of a state into `velocities`, (N, 3), without changing other particles."""
        moving, inverses = (state.p, state.A, state.L), (self.inverse_masses, self.inverse_moments)
        kernels.atoms.move(self.n, *moving, *inverses, *self.sites.tables, velocities)
        return velocities

    @cached_property
    def point_particles(self) -> np.ndarray:
        """Whether each particle is a point body, (N,)."""
        is_point = np.zeros(self.n_particles, dtype=bool)
        for species in self.species:
            if species.atoms.shape[1] == 1:
                is_point[species.atoms] = True
        return is_point

    # --- observables ---

    def orientations(self, state: BodyState) -> np.ndarray:
        """Return quaternions (w, x, y, z) of the bodies, (n, 4), with w >= 0.

        They turn the frame of a body into the lab frame: that of its `BodyType`, or its principal axes without one.
        """
        # Imported late: it takes longer than a step.
        from scipy.spatial.transform import Rotation

        turns = state.A.transpose(2, 1, 0).copy()
        for s, columns in zip(self.species, self.columns, strict=True):
            turns[columns] = turns[columns] @ s.axes
        return Rotation.from_matrix(turns).as_quat(canonical=True)[:, [3, 0, 1, 2]]
