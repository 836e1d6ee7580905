"""What an engine does: it moves the bodies of one Context for an ensemble, which decides what happens between flows."""

import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.barostat import MoleculeCentres
from openmm_sier.dynamics.bodies import BodyState, RigidBodies
from openmm_sier.dynamics.flow import Flow
from openmm_sier.dynamics.thermostat import Thermostat
from openmm_sier.engines import own_methods
from openmm_sier.engines.beginnings import refuse_hopeless_start
from openmm_sier.engines.snapshot import Snapshot, box_of
from openmm_sier.system import checks
from openmm_sier.system.cut_molecules import refuse_cut_molecules
from openmm_sier.system.solver_trial import SolverTrial
from openmm_sier.system.temperature import MomentumConservation, Temperatures, degrees_of_freedom


class TrajectoryError(openmm.OpenMMException):
    """A trajectory cannot be followed: a force or position is not finite, or constraints cannot be satisfied."""


class Clock(NamedTuple):
    """Time in ps, and number of steps of the integrator."""

    time: float
    steps: int


class Movers:
    """What an engine moves.

    Attributes:
        bodies: by whose numbers the engine knows what moves: rigid and point bodies, or the massive atoms alone.
    """

    def __init__(self, bodies: RigidBodies, molecules: Callable[[], Sequence[Sequence[int]]]):
        """
        Args:
            bodies: see above.
            molecules: gives the particle indices of each molecule when they are needed.
        """
        self.bodies, self._molecules = bodies, molecules

    @cached_property
    def centres(self) -> MoleculeCentres:
        """Centres of mass of the molecules, each of which moves as a whole with the volume."""
        return MoleculeCentres(self.bodies, self._molecules())


class Engine(ABC):
    """Binding of an integrator to a Context.

    An engine gives its phase point as a `BodyState` and takes one. Within `following` it may keep it to itself; after
    that the Context has it.

    Attributes:
        name: "exact" or "native", as users ask for it.
        repeats_noise: whether the noise of baths goes on from a State as it does from a checkpoint.
        movers: what the phase point is of.
        evaluations: number of force evaluations so far.
        clock: time and step count; ensembles set it where a step of the integrator is not one of the scheme.
    """

    name: ClassVar[str]
    repeats_noise: ClassVar[bool]
    movers: Movers
    evaluations: int
    clock: Clock

    def __init__(self, context: openmm.Context, flow: Flow):
        """
        Args:
            context: openmm.Context, which has the integrator.
            flow: what will be followed.
        """
        # The Context owns its integrator, and that its engine: a strong reference back would keep all of them alive.
        self._context_ref = weakref.ref(context)
        self._flow = flow

    @property
    def _context(self) -> openmm.Context:
        if (context := self._context_ref()) is None:
            raise openmm.OpenMMException("The Context of this integrator no longer exists")
        return context

    @property
    def _integrator(self) -> openmm.CustomIntegrator:
        return self._context.getIntegrator()

    @property
    def bodies(self) -> RigidBodies:
        """The rigid and point bodies of the System."""
        return self.movers.bodies

    # --- one call of the integrator's step ---

    @contextmanager
    def following(self, flow: Flow) -> Iterator[None]:
        """Take over what was changed in the Context from outside, and follow a flow within the block.

        However the block ends, the Context is left at the last completed step.

        Raises:
            openmm.OpenMMException: the flow cannot be followed. Nothing has been changed then.
        """
        self._begin(flow)
        with self._recovering():
            yield
            self._publish()

    @contextmanager
    def _recovering(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self._recover()
            raise

    @abstractmethod
    def _begin(self, flow: Flow) -> None:
        """Take over what was changed in the Context from outside, and check that the flow can be followed."""

    @abstractmethod
    def follow(self, steps: int, wants_energy: bool = False) -> None:
        """Advance by steps of the scheme, and the clock with them.

        Args:
            steps: number of steps.
            wants_energy: whether the potential energy of their end will be asked for. An engine may compute it with
                the last force then.

        Raises:
            TrajectoryError: a force or a position is not finite, or constraints cannot be satisfied.
        """

    @abstractmethod
    def _publish(self) -> None:
        """Write the last completed step to the Context."""

    def _recover(self) -> None:
        """After an error: write the last completed step to the Context as far as the engine still has it."""
        self._publish()

    @abstractmethod
    def check_step(self, flow: Flow) -> None:
        """Refuse a flow whose step is too long, by what is known before there are positions.

        Every step is checked when it is made; this tells it earlier.

        Raises:
            openmm.OpenMMException: the step is too long.
        """

    # --- the phase point ---

    @property
    @abstractmethod
    def point(self) -> BodyState:
        """The phase point of `movers` at the last completed step, with the heat and the draws counted so far."""

    @abstractmethod
    def change(self, operation: Callable[[BodyState], BodyState]) -> None:
        """Replace the phase point by what an operation makes of it; arrays that both share stay as they are."""

    @property
    def draws(self) -> int:
        """Number of draws of random numbers so far."""
        return self.point.draws

    @draws.setter
    def draws(self, number: int) -> None:
        self.change(lambda point: replace(point, draws=number))

    def kinetic_energy(self) -> float:
        """Kinetic energy, kJ/mol."""
        return sum(self.movers.bodies.kinetic_energies(self.point))

    def centre_velocity(self) -> np.ndarray:
        """Velocity of the centre of mass, (3,), nm/ps."""
        return self.movers.bodies.centre_velocity(self.point.p)

    def shift_velocities(self, velocity: np.ndarray) -> None:
        """Add a velocity, (3,), nm/ps, to all that moves, and its energy to the heat."""
        self.change(lambda point: self.movers.bodies.shifted(point, velocity))

    def scale_velocities(self, factor: float) -> None:
        """Multiply all velocities by a factor, and add the energy that they gain to the heat."""
        gained = (factor**2 - 1) * self.kinetic_energy()
        self.change(lambda point: replace(point, p=factor * point.p, L=factor * point.L, heat=point.heat + gained))

    def scale(self, factor: float) -> None:
        """Multiply the edges of the box and the centres of mass of all molecules; the clock stays."""
        self._set_box([factor * edge for edge in self._box()])
        self.change(lambda point: replace(point, q=point.q + (factor - 1) * self.movers.centres(point.q)))

    def add_heat(self, energy: float) -> None:
        """Count energy as heat, kJ/mol."""
        self.change(lambda point: replace(point, heat=point.heat + energy))

    # --- what else ensembles need between flows ---

    @abstractmethod
    def potential_energy(self) -> float:
        """Potential energy of the forces that move the bodies, kJ/mol."""

    @abstractmethod
    def positions(self) -> np.ndarray:
        """Return the positions of all particles, (N, 3), nm."""

    @abstractmethod
    def draw_momenta(self, bath: Thermostat, time: float) -> None:
        """Let a bath act for a time in ps; it takes a draw and its heat is counted."""

    @abstractmethod
    def remember(self) -> Any:
        """Everything that `go_back` restores: positions, momenta, box, clock, heat and draws."""

    @abstractmethod
    def go_back(self, memory: Any, reverse: bool = False) -> None:
        """Restore what was remembered; `reverse` reverses all momenta."""

    def undo(self, memory: Any) -> None:
        """After an error: restore what was remembered. What follows depends on nothing that was tried since."""
        self.start_anew()
        self.go_back(memory)

    def prepare_for_volume_moves(self) -> None:
        """Check that the volume can be changed.

        Raises:
            openmm.OpenMMException: it cannot.
        """
        checks.refuse_constant_pressure(self._context.getSystem(), self.movers.bodies)

    def volume(self) -> float:
        """Volume of the box, nm^3."""
        return own_methods.get_state(self._context).getPeriodicBoxVolume().value_in_unit(unit.nanometer**3)

    def _box(self) -> Any:
        """Periodic box vectors, nm."""
        return box_of(own_methods.get_state(self._context))

    def _set_box(self, box: Any) -> None:
        own_methods.set_box(self._context, *box)

    # --- what users ask ---

    def heat(self) -> float:
        """Energy that was given to the bodies by baths and moves, and not by forces, kJ/mol."""
        return self.state().heat

    @abstractmethod
    def state(self) -> BodyState:
        """The bodies' phase point, brought up to date with the Context."""

    @property
    def momentum_lag(self) -> float:
        """See `Scheme.momentum_lag`."""
        return self._flow.scheme.momentum_lag

    @abstractmethod
    def inner_step(self, flow: Flow) -> float:
        """The longest step of a flow within drifts, ps."""

    def at_whole_step(self, state: BodyState) -> BodyState:
        """The phase point of a whole step, with momenta that do not lag; it costs a force evaluation if they do."""
        if not self.momentum_lag:
            return state
        bodies, groups, fast = self.bodies, self._integrator.getIntegrationForceGroups(), self._flow.fast_groups
        p, L = state.p, state.L
        for step, acting in ((self._flow.step, groups & ~fast), (self.inner_step(self._flow), groups & fast)):
            if acting:
                forces = own_methods.get_state(self._context, forces=True, groups=acting).getForces(asNumpy=True)
                F, tau = bodies.forces_and_torques(forces.value_in_unit(forces.unit), state.A)
                p, L = p + self.momentum_lag * step * F, L + self.momentum_lag * step * tau
        return replace(state, p=bodies.constraints.project(state.q, p), L=L)

    @abstractmethod
    def temperatures(self, conserved: bool) -> Temperatures:
        """Return temperatures in K, see `system.temperature`; `conserved` is what `conserves_momentum` tells."""

    @cached_property
    def _momentum(self) -> MomentumConservation:
        return MomentumConservation(self._context.getSystem(), self.movers.bodies)

    @property
    def removes_momentum(self) -> bool:
        """Whether the System has a CMMotionRemover."""
        return self._momentum.removed

    def conserves_momentum(self, has_friction: bool) -> bool:
        """Tell whether the total momentum is conserved, see `MomentumConservation`.

        Args:
            has_friction: of the ensemble, see `Ensemble.has_friction`.
        """
        return self._momentum.holds(self._integrator.getIntegrationForceGroups(), has_friction)

    def degrees_of_freedom(self, conserved: bool) -> float:
        """Return the number of degrees of freedom that share the heat, see `system.temperature`.

        Args:
            conserved: what `conserves_momentum` tells.
        """
        return sum(degrees_of_freedom(self.bodies, conserved))

    # --- what OpenMM does in the Context, and cannot do for all constraints ---

    @cached_property
    def _trial(self) -> SolverTrial:
        return SolverTrial(self._context.getSystem())

    def _let_openmm_solve(self, by_openmm: Callable[[], None]) -> None:
        """Let OpenMM do something for which it solves constraints."""
        by_openmm()

    def draw_velocities(self, by_openmm: Callable[[], None], temperature: Any, seed: int | None) -> None:
        """Draw velocities of all atoms; see `Context.setVelocitiesToTemperature`, which `by_openmm` calls."""
        self._let_openmm_solve(by_openmm)

    def satisfy_positions(self, by_openmm: Callable[[], None]) -> None:
        """Move atoms onto the constraints; see `Context.applyConstraints`, which `by_openmm` calls."""
        self._let_openmm_solve(by_openmm)

    def satisfy_velocities(self, by_openmm: Callable[[], None]) -> None:
        """Take away velocities along constraints; see `Context.applyVelocityConstraints`, which `by_openmm` calls."""
        self._let_openmm_solve(by_openmm)

    def minimize(self, by_openmm: Callable[[], None], tolerance: Any, iterations: int, reporter: Any) -> None:
        """Minimize the energy and keep bodies rigid; see `openmm.LocalEnergyMinimizer` for the arguments.

        Args:
            by_openmm: does it with OpenMM's minimizer, which keeps nothing but constraints.

        Raises:
            RigidityError: the periodic boundary cuts a molecule, which constraints would pull together.
            openmm.OpenMMException: it cannot begin where the atoms are.
        """
        self._refuse_cut_molecules()
        refuse_hopeless_start(self._context)
        self._let_openmm_solve(by_openmm)

    def _refuse_cut_molecules(self) -> None:
        now = Snapshot(self._context)
        refuse_cut_molecules(self._context.getSystem(), now.positions, now.box)

    # --- news from outside ---

    def atoms_moved(self) -> None:  # noqa: B027 - nothing to do where it is found out
        """Somebody set positions or velocities; an engine may find it out by itself."""

    def box_changed(self) -> None:  # noqa: B027 - nothing to do where it is found out
        """Somebody set the box; an engine may find it out by itself."""

    @abstractmethod
    def forces_changed(self) -> None:
        """Somebody changed the potential."""

    def groups_changed(self) -> None:
        """Somebody changed the integration force groups."""
        self.forces_changed()

    @abstractmethod
    def start_anew(self) -> None:
        """Make the next step depend on nothing but what the Context holds, so that a restart repeats it bit for bit."""
