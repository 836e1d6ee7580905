"""Engines, which move the bodies of one Context. Ensembles act between the steps that an engine makes."""

import weakref
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import replace
from enum import Flag, auto
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.barostat import MoleculeCentres
from openmm_sier.dynamics.bodies import BodySet, BodyState
from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.tally import Mark, Tally
from openmm_sier.engines.actions import Actions
from openmm_sier.engines.snapshot import Snapshot, precision_of
from openmm_sier.engines.trials import Outcome, Trial
from openmm_sier.stability.step_check import StepCheck
from openmm_sier.system import checks
from openmm_sier.system.cut_molecules import Bonds, refuse_cut_molecules
from openmm_sier.system.inner_forces import with_inner_forces
from openmm_sier.system.solver_test import SolverTest
from openmm_sier.system.temperature import MomentumConservation, Temperatures


class TrajectoryError(openmm.OpenMMException):
    """A trajectory cannot be followed: a force or position is not finite, or constraints cannot be satisfied."""


class Clock(NamedTuple):
    """Time in ps, and number of steps of the integrator."""

    time: float
    steps: int


class RollbackState(NamedTuple):
    """The state that `Engine.restore` brings back.

    Attributes:
        point: phase point, in the form of the engine.
        clock: time and number of steps.
        box: periodic box vectors, nm.
        mark: of the tally.
        counts: of the ensemble, by name, which `Engine.transaction` brings back.
        more: further data of the engine.
    """

    point: Any
    clock: Clock
    box: Any
    mark: Mark
    counts: dict[str, float]
    more: Any = None


class Changes(Flag):
    """Kinds of change since the last step.

    Attributes:
        ATOMS: positions or velocities were set.
        BOX: the box was set.
        FORCES: the potential was changed.
        FAST: forces that act within drifts were changed, or which ones do.
        BONDS: bonds that keep molecules together were changed.
        VARIABLES: a checkpoint or State has brought the variables of the integrator.
        HISTORY: the next step must depend only on the contents of the Context, as after a restart.
        SETTINGS: settings, parameters or the clock were changed, or a step failed.
    """

    NONE = 0
    ATOMS = auto()
    BOX = auto()
    FORCES = auto()
    FAST = auto()
    BONDS = auto()
    VARIABLES = auto()
    HISTORY = auto()
    SETTINGS = auto()


class Engine(ABC):
    """The motion of the bodies of one Context.

    Abstract methods are those of each engine. The others are built from them, and no engine replaces them. Attributes
    may be properties of an engine.

    Attributes:
        name: by which users ask for the engine.
        repeats_noise: whether the noise of baths continues from a State as it does from a checkpoint.
        makes_trials: whether a trial of hybrid Monte Carlo is one step of OpenMM.
        precision: of the platform, see `precision_of`.
        method: the scheme that is executed, with its step.
        tally: heat, random numbers and counts.
        changes: changes since the last step. While there are none, steps read nothing from the Context.
        moving: the bodies of the phase point: rigid and point bodies, or the massive atoms alone.
        step_check: the check of the length of steps.
        evaluations: number of force evaluations so far.
        clock: time and step count; ensembles set it where a step of the integrator is not one of the scheme.
    """

    name: ClassVar[str]
    repeats_noise: ClassVar[bool] = False
    makes_trials: ClassVar[bool] = False
    moving: BodySet
    step_check: StepCheck
    evaluations: int = 0
    clock: Clock = Clock(0.0, 0)

    def __init__(self, context: openmm.Context, method: IntegrationMethod, tally: Tally):
        """Keep the Context, the method and the tally. Engines refuse, here, whatever they cannot do.

        Args:
            context: openmm.Context, which has the integrator.
            method: the scheme that will be executed.
            tally: of the integrator.
        """
        # The Context owns its integrator, and that its engine: strong references back would keep all of them alive.
        self._context = weakref.proxy(context)
        self._integrator = weakref.proxy(context.getIntegrator())
        self.precision = precision_of(context)
        self.method = method
        self.tally = tally
        self.changes = Changes.ATOMS
        #: Bonds that keep molecules together; None in a System without a box, and after a change of bonds.
        self._bonds: Bonds | None = None
        system = context.getSystem()
        #: Force groups, by the addresses of Forces in their order. A Context keeps those with which it was made.
        self._force_groups = {int(force.this): force.getForceGroup() for force in system.getForces()}
        if system.usesPeriodicBoundaryConditions():
            self._bonds = Bonds.of_system(system)

    @property
    def _groups(self) -> int:
        """Return the integration force groups, a bit mask."""
        return self._integrator.getIntegrationForceGroups()

    @abstractmethod
    def accept(self, method: IntegrationMethod, groups: int | None = None) -> None:
        """Refuse what the engine cannot follow, when it is made and before settings are changed.

        Args:
            method: the scheme that would be executed.
            groups: other integration force groups, a bit mask; None leaves them as they are.

        Raises:
            openmm.OpenMMException: the message says what that is, and the remedy. Nothing has been changed.
        """

    # --- steps ---

    @abstractmethod
    def synchronize(self) -> None:
        """Take over all changes from the Context. Nothing has been changed if this raises an error."""

    @abstractmethod
    def propagate(self, steps: int, signals: Collection[Any] = (), wants_energy: bool = False) -> int:
        """Advance by steps of the method's scheme, and the clock with them.

        Args:
            steps: number of steps.
            signals: those that wait. Once there are any no further step is made; a trajectory, which is followed to
                its end, has none.
            wants_energy: whether the potential energy of the end will be needed. An engine may compute it with the
                last force.

        Returns:
            The number of steps that were made.

        Raises:
            TrajectoryError: a force or a position is not finite, or constraints cannot be satisfied.
        """

    @abstractmethod
    def make_trial(self, trial: Trial) -> Outcome:
        """Draw momenta, follow the trajectory and take one of its ends, or the start with reversed momenta.

        It takes two draws of random numbers, or one where nothing moves. Heat and number of evaluations go on; the
        clock is left to the caller.

        Raises:
            openmm.OpenMMException: the energy of the start is not finite, or OpenMM failed for another reason than a
                trajectory that cannot be followed. The Context is left at the last sample.
        """

    @abstractmethod
    def publish(self) -> None:
        """Write the last completed step to the Context."""

    @abstractmethod
    def recover(self) -> None:
        """Write the last completed step to the Context after an error, as far as the engine still has it."""

    @abstractmethod
    def store(self) -> None:
        """Write the phase point to the variables that checkpoints, States and XML carry."""

    @abstractmethod
    def select_groups(self) -> None:
        """Take over other integration force groups."""

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

    def changes_by(self, force: openmm.Force) -> Changes:
        """Return what is changed by other parameters of a Force of the System."""
        changes = Changes.FORCES
        if self.method.fast_groups >> self._force_groups.get(int(force.this), 0) & 1:
            changes |= Changes.FAST
        if any(isinstance(part.force, openmm.HarmonicBondForce) for part in with_inner_forces(force)):
            changes |= Changes.BONDS
        return changes

    # --- the phase point ---

    @abstractmethod
    def save(self) -> RollbackState:
        """Return all that `restore` and `transaction` bring back."""

    @abstractmethod
    def restore(self, saved: RollbackState, reverse: bool = False) -> None:
        """Bring back a state, with reversed momenta if `reverse`; counts of the ensemble stay."""

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

    @abstractmethod
    def positions(self) -> np.ndarray:
        """Return the positions of all atoms of bodies, (N, 3), nm."""

    @abstractmethod
    def potential_energy(self) -> float:
        """Return the potential energy of the forces that move the bodies, up to date with the Context, kJ/mol."""

    @abstractmethod
    def kinetic_energy(self) -> float:
        """Return the kinetic energy, kJ/mol."""

    @abstractmethod
    def centre_velocity(self) -> np.ndarray:
        """Return the velocity of the centre of mass, (3,), nm/ps."""

    @abstractmethod
    def transform_velocities(self, factor: float, shift: np.ndarray) -> None:
        """Multiply all velocities by a factor and add a velocity, (3,), nm/ps. The heat is left to the caller."""

    @abstractmethod
    def draw_momenta(self, thermal: float, share: float) -> None:
        """Draw momenta, of which the old ones stay a share. It takes a draw, and the energy is counted as heat.

        Args:
            thermal: thermal energy kT, kJ/mol.
            share: the factor on the old momenta, from 0 to below 1.
        """

    @abstractmethod
    def scale(self, factor: float) -> None:
        """Multiply the edges of the box and the centres of mass of all molecules; the clock stays."""

    def shift_velocities(self, velocity: np.ndarray) -> None:
        """Add a velocity, (3,), nm/ps, to all that moves, and its energy to the heat."""
        self.tally.heat += self.moving.energy_of_shift(self.centre_velocity(), velocity)
        self.transform_velocities(1.0, velocity)

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

    def refuse_volume_moves(self) -> None:
        """Refuse moves of the volume that the System does not allow.

        Raises:
            openmm.OpenMMException: it does not allow them.
        """
        checks.refuse_constant_pressure(self._context.getSystem(), self.moving)

    # --- questions of users ---

    @property
    @abstractmethod
    def bodies(self) -> BodySet:
        """Return the rigid and point bodies of the System."""

    @property
    @abstractmethod
    def momentum_lag(self) -> float:
        """See `Scheme.momentum_lag`."""

    @abstractmethod
    def state(self) -> BodyState:
        """Return the phase point of `bodies`, up to date with the Context."""

    @abstractmethod
    def temperatures(self, conserved: bool) -> Temperatures:
        """Return temperatures in K, see `system.temperature`; `conserved` is the result of `conserves_momentum`.

        They are those just after the bath if it was in the middle of the last step. There momenta have the distribution
        of the bath, whatever the step; later, kicks and inner steps make those of fast bonds too hot or too cold.
        """

    @abstractmethod
    def degrees_of_freedom(self, conserved: bool) -> float:
        """Return the number of degrees of freedom that share the heat; `conserved` as in `temperatures`."""

    @abstractmethod
    def heat(self) -> float:
        """Return the energy from baths and moves, and not from forces, kJ/mol; NaN where it is not counted."""

    def at_whole_step(self, state: BodyState) -> BodyState:
        """Return the phase point of a whole step, with momenta that do not lag; it costs a force if they do."""
        if not self.momentum_lag:
            return state
        bodies, groups, fast = self.bodies, self._groups, self.method.fast_groups
        p, L = state.p, state.L
        for step, acting in ((self.method.step, groups & ~fast), (self.inner_step(self.method), groups & fast)):
            if acting:
                forces = openmm.Context.getState(self._context, forces=True, groups=acting).getForces(asNumpy=True)
                F, tau = bodies.forces_and_torques(forces.value_in_unit(forces.unit), state.A)
                p, L = p + self.momentum_lag * step * F, L + self.momentum_lag * step * tau
        return replace(state, p=bodies.constraints.project(state.q, p), L=L)

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

    @property
    @abstractmethod
    def actions(self) -> Actions:
        """Return the actions that users ask of OpenMM in the Context."""

    @cached_property
    def solver_test(self) -> SolverTest:
        """The constraints of the System that OpenMM's solvers cannot satisfy."""
        return SolverTest(self._context.getSystem())

    def refuse_cut_molecules(self, now: Snapshot) -> None:
        """Refuse positions at which the periodic boundary cuts a molecule.

        Raises:
            RigidityError: it cuts one that constraints or bonds would pull together.
        """
        if Changes.BONDS in self.changes:
            self._bonds = None
        system = self._context.getSystem()
        if self._bonds is None and system.usesPeriodicBoundaryConditions():
            self._bonds = Bonds.of_system(system)
        refuse_cut_molecules(system, now.positions, now.box, self._bonds)
