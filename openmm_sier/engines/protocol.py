"""What an engine does: it moves the bodies of one Context for an ensemble, which decides what happens between flows."""

from __future__ import annotations

import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.barostat import MoleculeCentres
from openmm_sier.dynamics.bodies import BodyState, RigidBodies
from openmm_sier.dynamics.operators import Rotation
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.thermostat import Thermostat
from openmm_sier.engines.temperature import MomentumConservation, Temperatures, degrees_of_freedom, temperatures
from openmm_sier.system import checks
from openmm_sier.system.vibrations import Vibrations


class TrajectoryError(openmm.OpenMMException):
    """A trajectory cannot be followed: a force or position is not finite, or constraints cannot be satisfied."""


@dataclass(frozen=True)
class Flow:
    """What an engine follows: a splitting scheme with all that its operators need.

    Attributes:
        scheme: the scheme.
        step: its step, ps.
        rotation: free-rotation map.
        substeps: number of steps into which a drift is divided; None leaves it to the engine.
        fast_groups: bit mask of the force groups that act within drifts.
        bath: executes the scheme's bath; None for a scheme without one.
        constant_energy: whether the energy is to be conserved, so that a step at which it walks is worth a word.
        updates_context: whether Forces that change velocities, positions or the box act before each step.
    """

    scheme: Scheme
    step: float
    rotation: Rotation = exact
    substeps: int | None = None
    fast_groups: int = 0
    bath: Thermostat | None = None
    constant_energy: bool = False
    updates_context: bool = True


class Clock(NamedTuple):
    """Time in ps, and number of steps of the integrator."""

    time: float
    steps: int


class Engine(ABC):
    """Binding of an integrator to a Context.

    Between `begin` and `publish` an engine may keep the bodies' state to itself; after `publish` the Context has it.

    Attributes:
        name: "exact" or "native", as users ask for it.
        repeats_noise: whether the noise of baths goes on from a State as it does from a checkpoint.
        evaluations: number of force evaluations so far.
        clock: time and step count; ensembles set it where a step of the integrator is not one of the scheme.
        draws: number of draws of random numbers so far.
    """

    name: ClassVar[str]
    repeats_noise: ClassVar[bool]
    evaluations: int
    clock: Clock
    draws: int

    _vibrations: Vibrations

    def __init__(self, integrator: openmm.CustomIntegrator, context: openmm.Context, flow: Flow):
        """
        Args:
            integrator: openmm.CustomIntegrator.
            context: openmm.Context.
            flow: what will be followed.
        """
        # The Context owns its integrator, and that its engine: a strong reference back would keep all of them alive.
        self._integrator_ref, self._context_ref = weakref.ref(integrator), weakref.ref(context)
        self._flow = flow
        self._checked: tuple[Any, ...] = ()

    @property
    def _context(self) -> openmm.Context:
        if (context := self._context_ref()) is None:
            raise openmm.OpenMMException("The Context of this integrator no longer exists")
        return context

    @property
    def _integrator(self) -> openmm.CustomIntegrator:
        if (integrator := self._integrator_ref()) is None:
            raise openmm.OpenMMException("The integrator of this Context no longer exists")
        return integrator

    @property
    @abstractmethod
    def bodies(self) -> RigidBodies:
        """The rigid and point bodies of the System."""

    @property
    def callers(self) -> tuple[Any, ...]:
        """What asks OpenMM for forces in a step, for those in the kicks and then for fast ones; see `ForceClock`."""
        return ()

    @property
    def _movers(self) -> RigidBodies:
        """What moves, by the numbers of which the engine knows it."""
        return self.bodies

    def _check_step(self) -> None:
        """Refuse steps that are too long for bonds and librations."""
        flow, groups = self._flow, self._integrator.getIntegrationForceGroups()
        checked = flow.scheme, flow.step, flow.substeps, flow.fast_groups, groups, self._vibrations
        if checked != self._checked:
            self._vibrations.check(flow.scheme, flow.step, groups & ~flow.fast_groups)
            inner, fast = self._inner_step(), groups & flow.fast_groups
            self._vibrations.check_nested(flow.scheme, flow.scheme.within_drifts, inner, flow.step, fast)
            if flow.constant_energy:
                self._vibrations.tell_of_walk(flow.scheme, flow.step, groups & ~flow.fast_groups)
            self._checked = checked

    @abstractmethod
    def _inner_step(self) -> float:
        """The longest step within drifts, ps."""

    # --- one call of the integrator's step ---

    @abstractmethod
    def begin(self, flow: Flow) -> None:
        """Take over what was changed in the Context from outside, and check that the flow can be followed."""

    @abstractmethod
    def follow(self, steps: int) -> None:
        """Advance by steps of the scheme, and the clock with them.

        Raises:
            TrajectoryError: a force or a position is not finite, or constraints cannot be satisfied.
        """

    @abstractmethod
    def publish(self) -> None:
        """Write the last completed step to the Context."""

    @abstractmethod
    def recover(self) -> None:
        """After an error: write the last completed step to the Context as far as the engine still has it."""

    # --- what ensembles need between flows ---

    @abstractmethod
    def potential_energy(self) -> float:
        """Potential energy of the forces that move the bodies, kJ/mol."""

    @abstractmethod
    def kinetic_energy(self) -> float:
        """Kinetic energy, kJ/mol."""

    @abstractmethod
    def positions(self) -> np.ndarray:
        """Positions of all particles, (N, 3), nm."""

    @abstractmethod
    def draw_momenta(self, bath: Thermostat, time: float) -> None:
        """Let a bath act for a time in ps; it takes a draw and its heat is counted."""

    @abstractmethod
    def remember(self) -> Any:
        """Everything that `go_back` restores: positions, momenta, box, clock, heat and draws."""

    @abstractmethod
    def go_back(self, memory: Any, reverse: bool = False) -> None:
        """Restore what was remembered; `reverse` reverses all momenta."""

    @property
    def mass(self) -> float:
        """Mass of all that moves, dalton."""
        return self._movers.mass

    @abstractmethod
    def centre_velocity(self) -> np.ndarray:
        """Velocity of the centre of mass, (3,), nm/ps."""

    @abstractmethod
    def shift_velocities(self, velocity: np.ndarray) -> None:
        """Add a velocity, (3,), nm/ps, to all bodies, and its energy to the heat."""

    @abstractmethod
    def scale_velocities(self, factor: float) -> None:
        """Multiply all velocities by a factor, and add the energy that they gain to the heat."""

    def prepare_for_volume_moves(self) -> None:
        """Check that the volume can be changed.

        Raises:
            openmm.OpenMMException: it cannot.
        """
        checks.refuse_constant_pressure(self._context.getSystem(), self._movers)

    def _forget_movers(self) -> None:
        """Find out anew next time what depends on the numbers of what moves."""
        for name in ("_centres", "_momentum"):
            self.__dict__.pop(name, None)

    @cached_property
    def _centres(self) -> MoleculeCentres:
        return MoleculeCentres(self._movers, self._context.getMolecules())

    @property
    def molecules(self) -> int:
        """Number of molecules, each of which moves as a whole with the volume."""
        return self._centres.count

    def volume(self) -> float:
        """Volume of the box, nm^3."""
        return self._context.getState().getPeriodicBoxVolume().value_in_unit(unit.nanometer**3)

    @abstractmethod
    def scale(self, factor: float) -> None:
        """Multiply the edges of the box and the centres of mass of all molecules; the clock stays."""

    @abstractmethod
    def heat(self) -> float:
        """Energy that was given to the bodies by baths and moves, and not by forces, kJ/mol."""

    @abstractmethod
    def add_heat(self, energy: float) -> None:
        """Count energy as heat, kJ/mol."""

    # --- what users ask ---

    @abstractmethod
    def state(self) -> BodyState:
        """The bodies' phase point, brought up to date with the Context."""

    @property
    def momentum_lag(self) -> float:
        """See `Scheme.momentum_lag`."""
        return self._flow.scheme.momentum_lag

    def at_whole_step(self, state: BodyState) -> BodyState:
        """The phase point of a whole step, with momenta that do not lag; it costs a force evaluation if they do."""
        if not self.momentum_lag:
            return state
        bodies, groups, fast = self.bodies, self._integrator.getIntegrationForceGroups(), self._flow.fast_groups
        p, L = state.p, state.L
        for step, acting in ((self._flow.step, groups & ~fast), (self._inner_step(), groups & fast)):
            if acting:
                forces = self._context.getState(forces=True, groups=acting).getForces(asNumpy=True)
                F, tau = bodies.forces_and_torques(forces.value_in_unit(forces.unit), state.A)
                p, L = p + self.momentum_lag * step * F, L + self.momentum_lag * step * tau
        return replace(state, p=bodies.constraints.project(state.q, p), L=L)

    def temperatures(self) -> Temperatures:
        """Temperatures in K, see `engines.temperature`."""
        return temperatures(self.bodies, self.state(), self.conserves_momentum())

    @cached_property
    def _momentum(self) -> MomentumConservation:
        return MomentumConservation.of_system(self._context.getSystem(), self._movers)

    @property
    def removes_momentum(self) -> bool:
        """Whether the System has a CMMotionRemover."""
        return self._momentum.removed

    def conserves_momentum(self) -> bool:
        """Whether the total momentum is conserved, see `MomentumConservation`."""
        return self._momentum.holds(self._integrator)

    def degrees_of_freedom(self) -> float:
        """Number of degrees of freedom that share the heat, see `engines.temperature`."""
        return sum(degrees_of_freedom(self.bodies, self.conserves_momentum()))

    @abstractmethod
    def minimize(self, by_openmm: Callable[[], None], tolerance: Any, iterations: int, reporter: Any) -> None:
        """Minimize the energy and keep bodies rigid; see `openmm.LocalEnergyMinimizer` for the arguments.

        Args:
            by_openmm: does it with OpenMM's minimizer, which keeps nothing but constraints.
        """

    # --- news from outside ---

    def atoms_moved(self) -> None:  # noqa: B027 - an engine may find it out by itself
        """Somebody set positions or velocities."""

    @abstractmethod
    def forces_changed(self) -> None:
        """Somebody changed the potential."""

    @abstractmethod
    def groups_changed(self) -> None:
        """Somebody changed the integration force groups."""

    @abstractmethod
    def start_anew(self) -> None:
        """Make the next step depend on nothing but what the Context holds, so that a restart repeats it bit for bit."""
