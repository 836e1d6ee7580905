"""Agreement of the bodies with their Context, whose atoms anybody may move between two steps."""

import weakref
from dataclasses import replace

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodyState, NotFiniteError, RigidBodies, RigidityError
from openmm_sier.dynamics.constraints import ConstraintError
from openmm_sier.dynamics.flow import Flow
from openmm_sier.engines import own_methods
from openmm_sier.engines.exact import packing
from openmm_sier.engines.exact.moving_bodies import MovingBodies
from openmm_sier.engines.protocol import Clock
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.engines.variables import DRAWS, HEAT, STATE_VARIABLES
from openmm_sier.system import checks
from openmm_sier.system.cut_molecules import IF_CUT, cut_molecules

#: Points further than this from their constraints, in nm, are refused, since they are not the molecule that was meant.
FARTHEST = 0.05


class Agreement:
    """Writes phase points of bodies to a Context, and takes over what others have changed there since."""

    def __init__(self, context: openmm.Context, moving: MovingBodies):
        self._context, self._moving = weakref.proxy(context), moving
        # The Context as it was when both agreed: one that differs from it was changed from outside.
        self._agreed: Snapshot | None = None
        self._published: tuple[BodyState, Clock] | None = None
        self._told_of_misfit = False

    @property
    def _bodies(self) -> RigidBodies:
        return self._moving.movers.bodies

    def publish(self, state: BodyState, clock: Clock) -> None:
        """Write a phase point and the clock to the Context and to the variables that travel in checkpoints."""
        moving, context = self._moving, self._context
        bodies, forces, integrator = self._bodies, moving.forces, context.getIntegrator()
        if (state, clock) == self._published and forces.is_at(state.q, state.A):
            return
        forces.place(state.q, state.A)
        own_methods.set_velocities(context, bodies.move(state, forces.velocities))
        for name, values in zip(STATE_VARIABLES, packing.pack(bodies, state), strict=True):
            integrator.setPerDofVariableByName(name, values)
        integrator.setGlobalVariableByName(HEAT, state.heat)
        integrator.setGlobalVariableByName(DRAWS, state.draws)
        context.setTime(clock.time)
        context.setStepCount(clock.steps)
        self._agreed, self._published = Snapshot(context), (state, clock)

    def doubt(self) -> None:
        """After an error: let the next `publish` write everything, whatever the Context has."""
        self._published = None
        self._moving.forget_forces()
        self._moving.forces.forget_place()

    def adopt(self, now: Snapshot, known: BodyState | None, flow: Flow) -> tuple[BodyState, Clock]:
        """The phase point and the clock of a Context in which anything may have been changed from outside.

        What is found depends on nothing but what the Context holds, so that a restart from a checkpoint is
        bit-identical.

        Args:
            now: what the Context holds.
            known: the phase point that was found or published last; None the first time.
            flow: what is followed.

        Raises:
            RigidityError: the positions do not form the bodies. Nothing has been changed then.
        """
        moving, before, integrator = self._moving, self._agreed, self._context.getIntegrator()
        if known is None and not now.positions.any():
            # No positions were set, or all particles are at the origin. OpenMM raises an error in the first case only.
            own_methods.get_state(self._context, energy=True, groups=0)
        moved = known is None or not now.same_positions(before)
        if moved:
            moving.start_anew()
            moving.settle_by(now.positions)
        state = known
        if state is None or moved or not now.same_velocities(before):
            state = self._found(now, known, moved)
        self._take(now, moved)
        if state is not known:
            moving.forces.velocities[:] = now.velocities
        moving.forces.select(integrator.getIntegrationForceGroups(), flow.fast_groups)
        heat, draws = map(integrator.getGlobalVariableByName, (HEAT, DRAWS))
        if (heat, draws) != (state.heat, state.draws):
            state = replace(state, heat=heat, draws=int(draws))
        return state, Clock(now.time, now.steps)

    def updated(self, state: BodyState) -> BodyState:
        """The phase point after Forces of OpenMM changed the Context that was published.

        Raises:
            RigidityError: the positions do not form the bodies.
        """
        now, before = Snapshot(self._context), self._agreed
        moved = not now.same_positions(before)
        q, A = self.fit(now, state) if moved else (state.q, state.A)
        found = replace(state, q=q, p=self._bodies.constraints.project(q, state.p), A=A)
        if not (now.same_velocities(before) and np.array_equal(A, state.A)):
            found = self._with_velocities(found, now)
        self._take(now, moved)
        return found

    def _take(self, now: Snapshot, moved: bool) -> None:
        """Take over positions, box and parameters of a Context where they differ."""
        if moved:
            self._moving.forces.take_positions(now)
        if not now.same_environment(self._agreed):
            self._moving.forget_forces()
        self._agreed = now

    # --- the phase point that a Context holds ---

    def _found(self, now: Snapshot, known: BodyState | None, moved: bool) -> BodyState:
        """The phase point of bodies that moved, or whose velocities were changed."""
        variable = self._context.getIntegrator().getPerDofVariableByName
        # One after the other: OpenMM gives lists of objects, which take much memory.
        values = np.stack([np.array(variable(name)) for name in STATE_VARIABLES])
        if (recalled := self._recalled(values, now, moved)) is not None:
            return recalled
        if known is None or moved:
            q, A = self.fit(now)
            known = BodyState(q, np.zeros_like(q), A, np.zeros_like(q))
        return self._with_velocities(known, now)

    def _recalled(self, values: np.ndarray, now: Snapshot, moved: bool) -> BodyState | None:
        """A stored state, if it reproduces the atoms to the last bit.

        It does so after a checkpoint or a State with integrator parameters was loaded. If velocities were set after
        that, the stored centres and attitudes are still used.

        Args:
            values: of the variables that hold it, see `packing`.
            now: what the Context holds.
            moved: whether its positions differ from those before.

        Returns:
            The state; None if the atoms are elsewhere.
        """
        bodies = self._bodies
        if not values.any() or not np.isfinite(values).all():
            return None
        state = packing.unpack(bodies, values)
        if not np.array_equal(bodies.place(state.q, state.A, now.positions.copy()), now.positions):
            return None
        if np.array_equal(bodies.move(state, now.velocities.copy()), now.velocities):
            return state
        return self._with_velocities(state, now) if moved else None

    def fit(self, now: Snapshot, previous: BodyState | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Bodies at the positions of a snapshot, (q, A); warns once of those that are moved onto their constraints.

        Raises:
            RigidityError: the positions do not form the bodies, or are far off the constraints between them.
        """
        try:
            return self._fitted(now, previous)
        except RigidityError as error:
            cut = cut_molecules(self._context.getSystem(), now.positions, now.box)
            raise (RigidityError(cut) if cut else error) from None

    def _fitted(self, now: Snapshot, previous: BodyState | None) -> tuple[np.ndarray, np.ndarray]:
        q, A, misfit = self._bodies.fit_with_misfit(now.positions, previous)
        if len(self._bodies.constraints.pairs):
            q, moved = self._onto_constraints(q)
            misfit = np.maximum(misfit, moved)
        if not self._told_of_misfit:
            self._told_of_misfit = checks.tell_of_misfit(self._bodies, misfit)
        return q, A

    def _onto_constraints(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points on their constraints, and the distance by which each was moved."""
        constraints = self._bodies.constraints
        try:
            satisfied = constraints.satisfied(q)
            constraints.rank(satisfied)
        except ConstraintError as error:
            raise RigidityError(f"the positions do not satisfy the constraints: {error}. {IF_CUT}") from None
        moved = np.linalg.norm(satisfied - q, axis=0)
        if not moved.max() <= FARTHEST:
            worst = int(np.where(np.isfinite(moved), moved, np.inf).argmax())
            raise RigidityError(
                f"{self._bodies.describe(worst)} is {moved[worst]:.4f} nm from where its constraints want it, at most "
                f"{FARTHEST} nm can be mended. {IF_CUT}. Otherwise context.applyConstraints(1e-6) may mend it"
            )
        return satisfied, moved

    def _with_velocities(self, state: BodyState, now: Snapshot) -> BodyState:
        """A state with the momenta that the atoms' velocities carry."""
        try:
            p, L = self._bodies.momenta(now.velocities, state.A)
        except NotFiniteError as error:
            raise openmm.OpenMMException(
                f"The velocities of {self._bodies.describe(error.body)} in the Context are not finite"
            ) from None
        return replace(state, p=self._bodies.constraints.project(state.q, p), L=L)
