"""Engines, which move the bodies of one Context. Ensembles act between the steps that an engine makes."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.barostat import MoleculeCentres
from openmm_sier.dynamics.bodies import BodyState, Pair
from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.tally import Tally
from openmm_sier.engines import neighbour_list
from openmm_sier.engines.records import Changes
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.engines.trials import Outcome, Trial, make_trial
from openmm_sier.engines.verbs import Verbs
from openmm_sier.system.cut_molecules import Bonds, refuse_cut_molecules
from openmm_sier.system.inner_forces import with_inner_forces
from openmm_sier.system.solver_test import SolverTest
from openmm_sier.system.temperature import MomentumConservation


class Engine(Verbs):
    """The motion of the bodies of one Context.

    The methods here are built from the verbs. No engine replaces them, but for `make_trial` if it is one native step.
    """

    #: Returns the kinetic energy of the Context, kJ/mol, which the device sums; None where it does not.
    sum_on_device: Callable[[], float] | None = None

    def __init__(self, context: openmm.Context, method: IntegrationMethod, tally: Tally):
        super().__init__(context, method, tally)
        #: Bonds that keep molecules together; None in a System without a box, and after a change of bonds.
        self._bonds: Bonds | None = None
        self._remembers_list = neighbour_list.is_remembered(context)
        system = context.getSystem()
        #: Force groups, by the addresses of Forces in their order. A Context keeps those with which it was made.
        self._force_groups = {int(force.this): force.getForceGroup() for force in system.getForces()}
        if system.usesPeriodicBoundaryConditions():
            self._bonds = Bonds.of_system(system)

    # --- steps ---

    def begin(self, method: IntegrationMethod) -> None:
        """Take over all changes before steps of a method, and check its step.

        Raises:
            openmm.OpenMMException: the method cannot be followed. The Context is at its start, with constraints
                satisfied.
        """
        self.method = method
        self.synchronize()
        self.step_check(method, self._groups, self._context)
        self.changes = Changes.NONE

    def record(self, changes: Changes) -> None:
        """Record changes, which the next step takes over. What was read of other bonds is forgotten at once."""
        self.changes |= changes
        if Changes.BONDS in changes:
            self._bonds = None
            self.step_check.forget_vibrations()

    def forget_list(self) -> None:
        """Let forces no longer depend on where atoms were, see `neighbour_list`."""
        if self._remembers_list:
            neighbour_list.forget(self._context)

    def forget_history(self) -> bool:
        """Let forces depend on nothing that a checkpoint lacks, if one was made or loaded since the last step.

        Returns:
            Whether a force that is known may have other last bits than one of now.
        """
        if Changes.HISTORY not in self.changes:
            return False
        self.forget_list()
        return self._remembers_list

    def changes_by(self, force: openmm.Force) -> Changes:
        """Return what is changed by other parameters of a Force of the System."""
        changes = Changes.FORCES
        if self.method.fast_groups >> self._force_groups.get(int(force.this), 0) & 1:
            changes |= Changes.FAST
        bonded = openmm.HarmonicBondForce, openmm.HarmonicAngleForce
        if any(isinstance(part.force, bonded) for part in with_inner_forces(force)):
            changes |= Changes.BONDS
        return changes

    def make_trial(self, trial: Trial) -> Outcome:
        """Draw momenta, follow the trajectory and take one of its ends, or the start with reversed momenta.

        It takes two draws of random numbers, or one where nothing moves. Heat and number of evaluations go on; the
        clock is left to the caller.

        Raises:
            openmm.OpenMMException: the energy of the start is not finite, or OpenMM failed for another reason than a
                trajectory that cannot be followed. The Context is left at the last sample.
        """
        return make_trial(self, trial)

    # --- the phase point ---

    @contextmanager
    def transaction(self, keeps_completed: bool = False) -> Iterator[None]:
        """Undo all effects of the block if it raises an error; later steps depend on none of them.

        Args:
            keeps_completed: whether a step that was completed before the error is kept. OpenMM counts the heat of
                native steps where it cannot be undone.
        """
        before = self.save()
        try:
            yield
        except BaseException:
            if not (keeps_completed and self.clock.steps > before.clock.steps):
                self.changes |= Changes.HISTORY
                self.restore(before)
                self.tally.counts = before.counts
            raise

    # --- moves of ensembles ---

    def shift_velocities(self, velocity: np.ndarray) -> None:
        """Add a velocity, (3,), nm/ps, to all that moves, and its energy to the heat."""
        self.tally.heat += self.moving.energy_of_shift(self.centre_velocity(), velocity)
        self.transform_velocities(1.0, velocity)

    def stop_centre(self) -> None:
        """Stop the centre of mass where a CMMotionRemover does so; its energy leaves the heat."""
        if self.removes_momentum:
            self.shift_velocities(-self.centre_velocity())

    def scale_velocities(self, factor: float, centre: np.ndarray) -> None:
        """Multiply all velocities by a factor, relative to a velocity, (3,), nm/ps, that stays as it is.

        The energy gain is heat.
        """
        before = self.kinetic_energy()
        self.transform_velocities(factor, (1 - factor) * centre)
        self.tally.heat += self.kinetic_energy() - before

    @cached_property
    def molecule_centres(self) -> MoleculeCentres:
        """Centres of mass of the molecules, each of which moves as a whole with the volume."""
        return MoleculeCentres(self.moving, self._context.getMolecules())

    def volume(self) -> float:
        """Return the volume of the box, nm^3."""
        return openmm.Context.getState(self._context).getPeriodicBoxVolume().value_in_unit(unit.nanometer**3)

    # --- questions of users ---

    def at_whole_step(self, state: BodyState) -> BodyState:
        """Return the phase point of a whole step, with momenta that do not lag; it costs a force if they do."""
        if not self.momentum_lag:
            return state
        bodies, groups, fast = self.bodies, self._groups, self.method.fast_groups
        p, L = state.p, state.L
        for step, acting in ((self.method.step, groups & ~fast), (self.inner_step(self.method), groups & fast)):
            if acting:
                F, tau = self._body_forces(state, acting)
                p, L = p + self.momentum_lag * step * F, L + self.momentum_lag * step * tau
        return replace(state, p=bodies.constraints.project(state.q, p), L=L)

    def body_forces(self) -> Pair:
        """Return forces and torques on the bodies at the last completed step, each (3, n), kJ/mol/nm and kJ/mol."""
        return self._body_forces(self.state(), self._groups)

    def _body_forces(self, state: BodyState, groups: int) -> Pair:
        """Return forces and torques of some groups, a bit mask, on the bodies of a state where the Context is."""
        forces = openmm.Context.getState(self._context, forces=True, groups=groups).getForces(asNumpy=True)
        return self.bodies.forces_and_torques(forces.value_in_unit(forces.unit), state.A)

    def inner_step(self, method: IntegrationMethod) -> float:
        """Return the longest step of a method within drifts, ps."""
        return self.step_check.inner_step(method, self._groups)

    @cached_property
    def _momentum(self) -> MomentumConservation:
        return MomentumConservation(self._context.getSystem(), self.moving)

    @property
    def removes_momentum(self) -> bool:
        """Return whether the System has a CMMotionRemover."""
        return self._momentum.removed

    def conserves_momentum(self, has_friction: bool) -> bool:
        """Return whether the total momentum is conserved, see `MomentumConservation`.

        Args:
            has_friction: of the ensemble, see `Ensemble.has_friction`.
        """
        return self._momentum.holds(self._groups, has_friction)

    # --- actions of users in the Context ---

    @cached_property
    def solver_test(self) -> SolverTest:
        """The constraints of the System that OpenMM's solvers cannot satisfy."""
        return SolverTest(self._context.getSystem())

    def refuse_cut_molecules(self, now: Snapshot) -> None:
        """Refuse positions at which the periodic boundary cuts a molecule.

        Raises:
            RigidityError: it cuts one that constraints or bonds would pull together.
        """
        system = self._context.getSystem()
        if self._bonds is None and system.usesPeriodicBoundaryConditions():
            self._bonds = Bonds.of_system(system)
        refuse_cut_molecules(system, now.positions, now.box, self._bonds)
