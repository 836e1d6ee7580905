"""Define engines, which move the bodies of one Context; ensembles decide what happens between flows."""

import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.barostat import MoleculeCentres
from openmm_sier.dynamics.bodies import BodySet, BodyState
from openmm_sier.dynamics.constrained import bath_operator
from openmm_sier.dynamics.flow import Flow
from openmm_sier.dynamics.ledger import Ledger, Mark
from openmm_sier.dynamics.thermostat import Thermostat
from openmm_sier.engines.actions import Actions
from openmm_sier.engines.program import Program
from openmm_sier.engines.snapshot import Snapshot, box_of
from openmm_sier.engines.trials import Outcome, Trial
from openmm_sier.stability.step_check import StepCheck
from openmm_sier.system import checks
from openmm_sier.system.arguments import Bodies
from openmm_sier.system.cut_molecules import Bonds, refuse_cut_molecules
from openmm_sier.system.solver_trial import SolverTrial
from openmm_sier.system.temperature import MomentumConservation, Temperatures, degrees_of_freedom, temperatures


class TrajectoryError(openmm.OpenMMException):
    """A trajectory cannot be followed: a force or position is not finite, or constraints cannot be satisfied."""


class Clock(NamedTuple):
    """Time in ps, and number of steps of the integrator."""

    time: float
    steps: int


class Memory(NamedTuple):
    """Hold what an engine goes back to: phase point, clock, box and mark of the ledger; `more` is the engine's own."""

    point: Any
    clock: Clock
    box: Any
    mark: Mark
    more: Any = None


class Task(NamedTuple):
    """Hold what an engine is made for.

    Attributes:
        context: openmm.Context, which has the integrator.
        flow: what will be followed.
        ledger: of the integrator.
        bodies: the rigid bodies as users give them, see `find_bodies.known_or_planned`.
        program: what OpenMM executes, which is written for the flow.
    """

    context: openmm.Context
    flow: Flow
    ledger: Ledger
    bodies: Bodies
    program: Program


class Engine(ABC):
    """Move the bodies of one Context.

    A new engine takes over a Context, follows a flow, publishes what came of it, and gives and takes a phase point:
    those are its abstract methods. What else is here follows from them, and an engine that can do it better has its
    own.

    Attributes:
        name: by which users ask for it.
        repeats_noise: whether the noise of baths goes on from a State as it does from a checkpoint.
        makes_trials: whether `make_trial` makes whole trials of hybrid Monte Carlo.
        flow: what is followed.
        ledger: heat, random numbers and counts.
        is_current: whether nobody has changed anything since the last step, so that `begin` need not be called.
        moving: the bodies whose phase point the engine has: rigid and point bodies, or the massive atoms alone. Each
            engine sets it.
        evaluations: number of force evaluations so far.
        clock: time and step count; ensembles set it where a step of the integrator is not one of the scheme.
    """

    name: ClassVar[str]
    repeats_noise: ClassVar[bool] = False
    makes_trials: ClassVar[bool] = False
    moving: BodySet
    is_current: bool = False
    evaluations: int = 0
    clock: Clock = Clock(0.0, 0)

    def __init__(self, task: Task):
        """Keep the Context, the flow and the ledger. Engines add the rest, and refuse what they cannot do."""
        # The Context owns its integrator, and that its engine: a strong reference back would keep all of them alive.
        self._context_ref = weakref.ref(task.context)
        self.flow = task.flow
        self.ledger = task.ledger
        #: Of the System; None before they are needed, and after its Forces have changed.
        self._bonds: Bonds | None = None

    @property
    def _context(self) -> openmm.Context:
        if (context := self._context_ref()) is None:
            raise openmm.OpenMMException("The Context of this integrator no longer exists")
        return context

    @property
    def _integrator(self) -> openmm.CustomIntegrator:
        return self._context.getIntegrator()

    @property
    def _groups(self) -> int:
        """Return the integration force groups, a bit mask."""
        return self._integrator.getIntegrationForceGroups()

    @property
    def bodies(self) -> BodySet:
        """Return the rigid and point bodies of the System."""
        return self.moving

    def refuse_cut_molecules(self, now: Snapshot) -> None:
        """Refuse positions at which the periodic boundary cuts a molecule.

        Raises:
            RigidityError: it cuts one that constraints or bonds would pull together.
        """
        system = self._context.getSystem()
        if self._bonds is None:
            self._bonds = Bonds.of_system(system)
        refuse_cut_molecules(system, now.positions, now.box, self._bonds)

    # --- what an engine must do ---

    @abstractmethod
    def take_over(self) -> None:
        """Take over what was changed in the Context from outside. Nothing has been changed if this raises an error."""

    @abstractmethod
    def follow(self, steps: int, wants_energy: bool = False) -> None:
        """Advance by steps of the flow's scheme, and the clock with them.

        Args:
            steps: number of steps.
            wants_energy: whether the potential energy of their end will be asked for. An engine may compute it with
                the last force then.

        Raises:
            TrajectoryError: a force or a position is not finite, or constraints cannot be satisfied.
        """

    def make_trial(self, trial: Trial) -> Outcome:
        """Draw momenta, follow the trajectory and take one of its ends, or the start with reversed momenta.

        Heat and number of evaluations go on; clock and random numbers are left to the caller.

        Raises:
            openmm.OpenMMException: OpenMM failed for another reason than a trajectory that cannot be followed. The
                start is restored, with the momenta that were drawn.
        """
        raise NotImplementedError

    @abstractmethod
    def publish(self) -> None:
        """Write the last completed step to the Context."""

    @property
    @abstractmethod
    def point(self) -> BodyState:
        """Return the phase point of `moving` at the last completed step."""

    @abstractmethod
    def change(self, operation: Callable[[BodyState], BodyState]) -> None:
        """Replace the phase point by what an operation makes of it; arrays that both share stay as they are."""

    @abstractmethod
    def potential_energy(self) -> float:
        """Return the potential energy of the forces that move the bodies, kJ/mol."""

    @abstractmethod
    def state(self) -> BodyState:
        """Return the phase point of `bodies`, brought up to date with the Context."""

    # --- one call of the integrator's step ---

    def begin(self, flow: Flow) -> None:
        """Take over what was changed in the Context from outside, before steps of a flow.

        Raises:
            openmm.OpenMMException: the flow cannot be followed. Nothing has been changed then.
        """
        self.flow = flow
        self.take_over()
        self.check_step(flow, self._groups, self._context)
        self.is_current = True

    def recover(self) -> None:
        """Write the last completed step to the Context after an error, as far as the engine still has it."""
        self.publish()

    # --- what ensembles do between flows ---

    def kinetic_energy(self) -> float:
        """Return the kinetic energy, kJ/mol."""
        return sum(self.moving.kinetic_energies(self.point))

    def centre_velocity(self) -> np.ndarray:
        """Return the velocity of the centre of mass, (3,), nm/ps."""
        return self.moving.centre_velocity(self.point.p)

    def shift_velocities(self, velocity: np.ndarray) -> None:
        """Add a velocity, (3,), nm/ps, to all that moves, and its energy to the heat."""
        self.ledger.heat += self.moving.energy_of_shift(self.centre_velocity(), velocity)
        self.change(lambda point: self.moving.shifted(point, velocity))

    def scale_velocities(self, factor: float, centre: np.ndarray) -> None:
        """Multiply all velocities by a factor, relative to a velocity, (3,), nm/ps, that stays as it is.

        The energy that they gain is heat.
        """
        before = self.kinetic_energy()
        self._scale_velocities(factor, (1 - factor) * centre)
        self.ledger.heat += self.kinetic_energy() - before

    def _scale_velocities(self, factor: float, shift: np.ndarray) -> None:
        """Multiply all velocities by a factor and add a velocity, (3,), nm/ps."""
        self.change(lambda point: self.moving.shifted(replace(point, p=factor * point.p, L=factor * point.L), shift))

    def draw_momenta(self, bath: Thermostat, time: float) -> None:
        """Let a bath act for a time in ps; it takes a draw, and its heat is counted."""
        operator = bath_operator(bath, self.moving, self.ledger)
        self.change(lambda point: operator(point, time))

    def positions(self) -> np.ndarray:
        """Return the positions of all atoms of bodies, (N, 3), nm; zero for other particles."""
        point = self.point
        return self.moving.place(point.q, point.A, np.zeros((self.moving.n_particles, 3)))

    @cached_property
    def molecule_centres(self) -> MoleculeCentres:
        """Return centres of mass of the molecules, each of which moves as a whole with the volume."""
        return MoleculeCentres(self.moving, self._context.getMolecules())

    def scale(self, factor: float) -> None:
        """Multiply the edges of the box and the centres of mass of all molecules; the clock stays."""
        self._set_box([factor * edge for edge in self._box()])
        self.change(lambda point: replace(point, q=point.q + (factor - 1) * self.molecule_centres(point.q)))

    def volume(self) -> float:
        """Return the volume of the box, nm^3."""
        return openmm.Context.getState(self._context).getPeriodicBoxVolume().value_in_unit(unit.nanometer**3)

    def prepare_for_volume_moves(self) -> None:
        """Check that the volume can be changed.

        Raises:
            openmm.OpenMMException: it cannot.
        """
        checks.refuse_constant_pressure(self._context.getSystem(), self.moving)

    def _box(self) -> Any:
        """Return the periodic box vectors, nm."""
        return box_of(openmm.Context.getState(self._context))

    def _set_box(self, box: Any) -> None:
        openmm.Context.setPeriodicBoxVectors(self._context, *box)

    # --- there and back ---

    def remember(self) -> Memory:
        """Return everything that `go_back` restores."""
        return Memory(self.point, self.clock, self._box(), self.ledger.mark())

    def go_back(self, memory: Memory, reverse: bool = False) -> None:
        """Restore what was remembered; `reverse` reverses all momenta."""
        if memory.box != self._box():
            self._set_box(memory.box)
        point = memory.point
        self.change(lambda _: replace(point, p=-point.p, L=-point.L) if reverse else point)
        self.clock = memory.clock
        self.ledger.go_back(memory.mark)

    @contextmanager
    def transaction(self, keeps_completed: bool = False) -> Iterator[None]:
        """Undo all that the block did and counted if it raises an error; later steps depend on nothing of it.

        Args:
            keeps_completed: whether a step that was completed before the error is kept. OpenMM counts the heat of
                native steps where it cannot be undone.
        """
        before, counts = self.remember(), dict(self.ledger.counts)
        try:
            yield
        except BaseException:
            if not (keeps_completed and self.clock.steps > before.clock.steps):
                self.start_anew()
                self.go_back(before)
                self.ledger.counts = counts
            raise

    # --- what users ask ---

    def heat(self) -> float:
        """Return the energy that was given to the bodies by baths and moves, and not by forces, kJ/mol."""
        return self.ledger.heat

    @property
    def momentum_lag(self) -> float:
        """See `Scheme.momentum_lag`."""
        return self.flow.scheme.momentum_lag

    def at_whole_step(self, state: BodyState) -> BodyState:
        """Return the phase point of a whole step, with momenta that do not lag; it costs a force if they do."""
        if not self.momentum_lag:
            return state
        bodies, groups, fast = self.bodies, self._groups, self.flow.fast_groups
        p, L = state.p, state.L
        for step, acting in ((self.flow.step, groups & ~fast), (self.inner_step(self.flow), groups & fast)):
            if acting:
                forces = openmm.Context.getState(self._context, forces=True, groups=acting).getForces(asNumpy=True)
                F, tau = bodies.forces_and_torques(forces.value_in_unit(forces.unit), state.A)
                p, L = p + self.momentum_lag * step * F, L + self.momentum_lag * step * tau
        return replace(state, p=bodies.constraints.project(state.q, p), L=L)

    @cached_property
    def check_step(self) -> StepCheck:
        """Refuse steps that are too long for what moves."""
        return StepCheck(self._context.getSystem(), self.moving)

    def inner_step(self, flow: Flow) -> float:
        """Return the longest step of a flow within drifts, ps."""
        return self.check_step.inner_step(flow, self._groups)

    def temperatures(self, conserved: bool) -> Temperatures:
        """Return temperatures in K, see `system.temperature`; `conserved` is what `conserves_momentum` tells."""
        return temperatures(self.bodies, self.state(), conserved)

    @cached_property
    def _momentum(self) -> MomentumConservation:
        return MomentumConservation(self._context.getSystem(), self.moving)

    @property
    def removes_momentum(self) -> bool:
        """Tell whether the System has a CMMotionRemover."""
        return self._momentum.removed

    def conserves_momentum(self, has_friction: bool) -> bool:
        """Tell whether the total momentum is conserved, see `MomentumConservation`.

        Args:
            has_friction: of the ensemble, see `Ensemble.has_friction`.
        """
        return self._momentum.holds(self._groups, has_friction)

    def degrees_of_freedom(self, conserved: bool) -> float:
        """Return the number of degrees of freedom that share the heat, see `system.temperature`.

        Args:
            conserved: what `conserves_momentum` tells.
        """
        return sum(degrees_of_freedom(self.bodies, conserved))

    def refuse_long_step(self, flow: Flow) -> None:
        """Refuse a flow whose step is too long, by what is known before there are positions.

        Every step is checked when it is made; this tells it earlier.

        Raises:
            openmm.OpenMMException: the step is too long.
        """
        self.check_step(flow, self._groups)

    @cached_property
    def trial(self) -> SolverTrial:
        """Find the constraints of the System that OpenMM's solvers cannot satisfy."""
        return SolverTrial(self._context.getSystem())

    @cached_property
    def actions(self) -> Actions:
        """Return the actions that users ask of OpenMM in the Context."""
        return Actions(self._context, self.trial)

    # --- changes by users, and what a restart needs ---

    def atoms_moved(self) -> None:
        """Take note that positions or velocities were set."""
        self.is_current = False

    def box_changed(self) -> None:
        """Take note that the box was set."""
        self.is_current = False

    def forces_changed(self) -> None:
        """Take note that the potential was changed."""
        self.is_current = False
        self._bonds = None

    def store(self) -> None:  # noqa: B027
        """Write what checkpoints, States and XML carry to the variables of the integrator."""

    def variables_loaded(self) -> None:  # noqa: B027
        """Take note that a checkpoint or State has brought the variables of the integrator with it."""

    def groups_changed(self) -> None:
        """Take note that the integration force groups were changed."""
        self.forces_changed()

    def start_anew(self) -> None:  # noqa: B027
        """Make the next step depend on nothing but what the Context holds, so that a restart repeats it bit for bit."""
