"""Operations that every engine must implement."""

import weakref
from abc import ABC, abstractmethod
from collections.abc import Collection
from typing import Any, ClassVar

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet, BodyState
from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.tally import Tally
from openmm_sier.engines.actions import Actions
from openmm_sier.engines.records import Changes, Clock, RollbackState
from openmm_sier.engines.snapshot import precision_of
from openmm_sier.stability.step_check import StepCheck
from openmm_sier.system.temperature import Temperatures


class Verbs(ABC):
    """The verbs that each engine has in its own way. Attributes may be properties of an engine.

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
        """Keep the arguments, see `make_engine`. Engines refuse here whatever they cannot do."""
        # The Context owns its integrator, and that its engine: strong references back would keep all of them alive.
        self._context = weakref.proxy(context)
        self._integrator = weakref.proxy(context.getIntegrator())
        self.precision = precision_of(context)
        self.method = method
        self.tally = tally
        self.changes = Changes.ATOMS

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
            signals: pending signals; stepping stops after the current step when this becomes non-empty. Trajectories
                pass none, since they always run to their end.
            wants_energy: whether the potential energy of the end will be needed. An engine may compute it with the
                last force.

        Returns:
            The number of steps that were made.

        Raises:
            TrajectoryError: a force or a position is not finite, or constraints cannot be satisfied.
        """

    @abstractmethod
    def publish(self) -> None:
        """Write the last completed step to the Context."""

    @abstractmethod
    def recover(self) -> None:
        """Write the last completed step to the Context after an error, as far as the engine still has it."""

    def store(self) -> None:  # noqa: B027
        """Write the phase point to the variables that checkpoints, States and XML carry, if the Context lacks some."""

    @abstractmethod
    def select_groups(self) -> None:
        """Take over other integration force groups."""

    # --- the phase point ---

    @abstractmethod
    def save(self) -> RollbackState:
        """Return all that `restore` and `transaction` bring back."""

    @abstractmethod
    def restore(self, saved: RollbackState, reverse: bool = False) -> None:
        """Bring back a state, with reversed momenta if `reverse`; counts of the ensemble stay."""

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
    def draw_momenta(self, kT: float, kept: float) -> None:
        """Refresh the momenta partially, which uses one draw; the energy is counted as heat.

        Args:
            kT: thermal energy, kJ/mol.
            kept: the fraction of the old momenta that is kept, from 0 to below 1.
        """

    @abstractmethod
    def scale(self, factor: float) -> None:
        """Multiply the edges of the box and the centres of mass of all molecules; the clock stays."""

    # --- questions of users ---

    @property
    @abstractmethod
    def bodies(self) -> BodySet:
        """Return the rigid and point bodies of the System."""

    @property
    def momentum_lag(self) -> float:
        """Return `Scheme.momentum_lag`."""
        return self.method.scheme.momentum_lag

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

    def heat(self) -> float:
        """Return the energy from baths and moves, and not from forces, kJ/mol; NaN where it is not counted."""
        return self.tally.heat

    # --- actions of users in the Context ---

    @property
    @abstractmethod
    def actions(self) -> Actions:
        """Return the actions that users ask of OpenMM in the Context."""
