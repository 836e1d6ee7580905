"""Writer of bodies to a Context as atoms, and reader of forces and energies."""

import weakref

import numpy as np
import openmm

from openmm_sier.dynamics import kernels
from openmm_sier.dynamics.bodies import BodySet, BodyState, NotFiniteError, Pair, PlaceCache
from openmm_sier.dynamics.constraints import ConstraintError
from openmm_sier.engines.records import TrajectoryError
from openmm_sier.engines.snapshot import Snapshot, potential_of
from openmm_sier.system import tables


class BodyForces:
    """Forces, torques and energies of bodies, which a Context computes at the positions of their atoms.

    What is not finite raises `TrajectoryError`.

    Attributes:
        bodies: on which they act.
        positions, velocities: of the atoms as they were last written, (N, 3), nm and nm/ps; those of atoms in no body
            are stored here.
        evaluations: number of force evaluations so far.
        step: number of the step that is being made, for messages.
    """

    _placed: tuple[np.ndarray | None, np.ndarray | None]

    def __init__(self, context: openmm.Context, bodies: BodySet):
        # The Context owns its integrator and so all this: a strong reference back would keep both alive.
        self._context = weakref.proxy(context)
        self.bodies = bodies
        system = context.getSystem()
        n = system.getNumParticles()
        self._has_virtual_sites = tables.virtual_sites(system).size > 0
        sites = bodies.sites
        self._sites = sites.tables
        self._weighted_sites = sites.sets, sites.bodies, sites.places, sites.ones, sites.atoms
        self.positions = np.zeros((n, 3))
        self.velocities = np.zeros((n, 3))
        #: Forces on the atoms, as OpenMM gave them last.
        self._vectors = np.zeros((n, 3))
        self.forget_place()
        self._groups = 0
        self._groups_in_kicks = 0
        self.evaluations = 0
        self.step = 0

    def select(self, groups: int, fast_groups: int) -> None:
        """Take the force groups that move the bodies, and the fast ones among them, each as a bit mask."""
        self._groups = groups
        self._groups_in_kicks = groups & ~fast_groups

    # --- atoms ---

    def place(self, q: np.ndarray, A: np.ndarray) -> None:
        """Set the positions of the Context to those of bodies at (q, A), unless they are there already.

        Where a position is not finite the Context keeps its positions.
        """
        if self._placed[0] is q and self._placed[1] is A:
            return
        if kernels.atoms.place(self.bodies.n, q, A, *self._sites, self.positions):
            raise self._not_finite("position of", q, A)
        openmm.Context.setPositions(self._context, self.positions)
        if self._has_virtual_sites:
            self._context.computeVirtualSites()
        self._placed = q, A

    def is_at(self, q: np.ndarray, A: np.ndarray) -> bool:
        """Return whether the Context has the positions of bodies at (q, A)."""
        return self._placed[0] is q and self._placed[1] is A

    def take_positions(self, now: Snapshot) -> None:
        """Take over positions that were changed in the Context."""
        self.positions[:] = now.positions
        self.forget_place()

    def forget_place(self) -> None:
        """Make the next `place` write positions to the Context, whatever is there."""
        self._placed = None, None

    # --- forces ---

    def compute(self, q: np.ndarray, A: np.ndarray, groups: int | None = None, cache: PlaceCache | None = None) -> Pair:
        """Return forces and torques on bodies at (q, A), each (3, n).

        Args:
            q, A: centres and attitudes.
            groups: bit mask of force groups; None for those of kicks, which are all but the fast ones.
            cache: gets the energy too, for a tenth of what it costs alone; None for forces only.
        """
        acting = self._groups_in_kicks if groups is None else groups
        self.evaluations += 1
        self.place(q, A)
        state = openmm.Context.getState(self._context, forces=True, energy=cache is not None, groups=acting)
        if cache is not None:
            cache.energy = potential_of(state) + self._energy_of(self._groups & ~acting)
        # Like getForces(asNumpy=True), but without its overhead for names and units.
        state._getVectorAsNumpy(openmm.State.Forces, self._vectors)
        F, tau = np.empty(q.shape), np.empty(q.shape)
        if kernels.atoms.collect(self.bodies.n, self._vectors, A, *self._weighted_sites, F, tau):
            raise self._not_finite("force on", F, tau)
        if self.bodies.bearings is not None:
            self.bodies.bearings.remove(F, tau, A)
        return F, tau

    def with_energy(self, state: BodyState) -> BodyState:
        """Return a state whose energy is in its cache, with the slow forces, which were computed at once."""
        cache = state.cache
        if cache.forces is None:
            cache.forces = self.compute(state.q, state.A, cache=cache)
        return state

    def energy(self, state: BodyState) -> float:
        """Return the potential energy at a state, kJ/mol, of all groups that move the bodies."""
        cache = state.cache
        if cache.energy is None:
            self.place(state.q, state.A)
            # In the parts of which `compute` makes the sum: a restart, which has no forces yet, has the same bits.
            slow = self._groups_in_kicks
            cache.energy = self._energy_of(slow) + self._energy_of(self._groups & ~slow)
        return cache.energy

    def _energy_of(self, groups: int) -> float:
        """Return the potential energy of some groups where the Context is, kJ/mol; 0 of none."""
        if not groups:
            return 0.0
        return potential_of(openmm.Context.getState(self._context, energy=True, groups=groups))

    def _not_finite(self, quantity: str, *vectors: np.ndarray) -> TrajectoryError:
        """Return the error of a step in which vectors of bodies are not finite."""
        rows = np.concatenate([array.reshape(-1, self.bodies.n) for array in vectors])
        return step_error(NotFiniteError(quantity, rows, self.bodies), self.step)


def step_error(error: NotFiniteError | ConstraintError, step: int) -> TrajectoryError:
    """Return the error of a step, by its number, with numbers that are not finite or constraints that fail."""
    left = "The Context is left at the last completed step."
    if isinstance(error, NotFiniteError):
        return TrajectoryError(
            f"The {error.what} is not finite in step {step}. Is the step size too long, or do atoms overlap? {left}"
        )
    return TrajectoryError(
        f"Step {step} failed: {error}. Is the step size too long, or a force too stiff for it? {left}"
    )
