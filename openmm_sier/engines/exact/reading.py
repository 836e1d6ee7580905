"""The phase point of bodies from the atoms of a Context, whoever put them there."""

from enum import Enum, auto

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet, BodyState, NotFiniteError, RigidityError
from openmm_sier.dynamics.constraints import ConstraintError
from openmm_sier.engines.exact.forces import BodyForces
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.system import checks
from openmm_sier.system.cut_molecules import IF_CUT

#: Points further than this from their constraints, in nm, are refused, since they are not the molecule that was meant.
FARTHEST = 0.05


class AtomChange(Enum):
    """Differences of the atoms of a Context from those that the engine wrote last.

    Attributes:
        NONE: they are the same.
        VELOCITIES: other velocities were set.
        POSITIONS: other positions were set, perhaps other velocities too.
    """

    NONE = auto()
    VELOCITIES = auto()
    POSITIONS = auto()


def agreeing(bodies: BodySet, state: BodyState, now: Snapshot, change: AtomChange) -> BodyState | None:
    """Return a phase point if it reproduces the atoms to the last bit; None if they are elsewhere.

    The stored one does so after a checkpoint or a State with integrator parameters was loaded. If velocities were set
    after that, the stored centres and attitudes are still used.

    Args:
        bodies: the bodies.
        state: their phase point as it was stored or published.
        now: what the Context holds.
        change: of its atoms.
    """
    if not np.array_equal(bodies.place(state.q, state.A, now.positions.copy()), now.positions):
        return None
    if np.array_equal(bodies.move(state, now.velocities.copy()), now.velocities):
        return state
    return with_velocities(bodies, state, now) if change is AtomChange.POSITIONS else None


def with_velocities(bodies: BodySet, state: BodyState, now: Snapshot) -> BodyState:
    """Return a state with the momenta that the velocities of the atoms carry.

    Raises:
        openmm.OpenMMException: velocities of a body are not finite.
    """
    try:
        p, L = bodies.momenta(now.velocities, state.A)
    except NotFiniteError as error:
        raise openmm.OpenMMException(
            f"The velocities of {bodies.describe(error.body)} in the Context are not finite"
        ) from None
    return BodyState(state.q, bodies.constraints.project(state.q, p), state.A, L, state.cache)


class AtomReader:
    """Reader of the phase point of bodies from atoms, which warns once of bodies that are moved onto their constraints.

    Attributes:
        bodies: the bodies.
    """

    def __init__(self, bodies: BodySet, forces: BodyForces, keeps_numbers: bool) -> None:
        """
        Args:
            bodies: the bodies.
            forces: know the atoms that were written last.
            keeps_numbers: whether positions and velocities that are set come back as they are, bit for bit.
        """
        self.bodies = bodies
        self._forces = forces
        self._keeps_numbers = keeps_numbers
        self._has_warned_of_misfit = False

    def change(self, now: Snapshot, last: BodyState | None, is_set: bool) -> AtomChange:
        """Return how the atoms of the Context differ from those of the last phase point.

        Args:
            now: what the Context holds.
            last: the last phase point; None without one.
            is_set: whether positions or velocities were set since then.
        """
        if last is None:
            return AtomChange.POSITIONS
        if not is_set:
            return AtomChange.NONE
        # A minimizer leaves the atoms where it placed other bodies than those of the phase point.
        is_placed = self._forces.is_at(last.q, last.A)
        if not (is_placed and self._has(now.positions, self._forces.positions)):
            return AtomChange.POSITIONS
        if not self._has(now.velocities, self._forces.velocities):
            return AtomChange.VELOCITIES
        return AtomChange.NONE

    def _has(self, vectors: np.ndarray, written: np.ndarray) -> bool:
        """Return whether vectors of the Context are, bit for bit, those that were written to it last."""
        return self._keeps_numbers and np.array_equal(vectors, written)

    def point(
        self,
        now: Snapshot,
        stored: BodyState | None,
        last: BodyState | None,
        change: AtomChange,
        fits_stored: bool,
    ) -> BodyState:
        """Return the phase point of atoms: a stored one that agrees with them, the last one, or a fit.

        Args:
            now: what the Context holds.
            stored: phase point that was stored for its atoms; None without one.
            last: the last phase point; None without one.
            change: of the atoms, which is not `NONE`.
            fits_stored: whether bodies keep the attitudes of `stored` where these fit to rounding. GPU platforms, which
                bring molecules of a State into the box, round positions. Attitudes of linear bodies cannot be seen from
                the atoms, and noise is drawn along their axes.

        Raises:
            RigidityError: the positions do not form the bodies, or are far off the constraints between them.
        """
        agreed = None if stored is None else agreeing(self.bodies, stored, now, change)
        if agreed is not None:
            return agreed
        if last is None or change is AtomChange.POSITIONS:
            q, A = self.fit(now, stored if fits_stored else None)
            last = BodyState(q, np.zeros_like(q), A, np.zeros_like(q))
        return with_velocities(self.bodies, last, now)

    def fit(self, now: Snapshot, previous: BodyState | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return centres, (3, n), and attitudes, (3, 3, n), of bodies at the positions of a snapshot.

        Args:
            now: what the Context holds.
            previous: where they were; attitudes of bodies that have only been shifted stay as they are.

        Raises:
            RigidityError: the positions do not form the bodies, or are far off the constraints between them.
        """
        bodies = self.bodies
        q, A, misfit = bodies.fit_with_misfit(now.positions, previous)
        if len(bodies.constraints.pairs):
            q, moved = _onto_constraints(bodies, q)
            misfit = np.maximum(misfit, moved)
        if not self._has_warned_of_misfit:
            self._has_warned_of_misfit = checks.warn_about_misfit(bodies, misfit)
        return q, A


def _onto_constraints(bodies: BodySet, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points on their constraints, and the distance by which each was moved.

    Raises:
        RigidityError: a point is too far from its constraints.
    """
    constraints = bodies.constraints
    try:
        satisfied = constraints.satisfied(q)
        constraints.rank(satisfied)
    except ConstraintError as error:
        raise RigidityError(f"the positions do not satisfy the constraints: {error}. {IF_CUT}") from None
    moved = np.linalg.norm(satisfied - q, axis=0)
    if not moved.max() <= FARTHEST:
        worst = int(np.where(np.isfinite(moved), moved, np.inf).argmax())
        raise RigidityError(
            f"{bodies.describe(worst)} is {moved[worst]:.4f} nm from where its constraints put it, and at most "
            f"{FARTHEST} nm can be corrected. {IF_CUT}. Otherwise context.applyConstraints(1e-6) may help"
        )
    return satisfied, moved
