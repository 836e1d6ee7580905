"""What an engine does: it moves the bodies of one Context for an ensemble, which decides what happens between flows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodyState, RigidBodies
from openmm_sier.dynamics.operators import Rotation
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck
from openmm_sier.engines.temperature import Temperatures


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
        updates_context: whether Forces that change velocities, positions or the box act before each step.
    """

    scheme: Scheme
    step: float
    rotation: Rotation = exact
    substeps: int | None = None
    fast_groups: int = 0
    bath: OrnsteinUhlenbeck | None = None
    updates_context: bool = True


class Clock(NamedTuple):
    """Time in ps, and number of steps of the integrator."""

    time: float
    steps: int


class Engine(Protocol):
    """Binding of an integrator to a Context.

    Between `begin` and `publish` an engine may keep the bodies' state to itself; after `publish` the Context has it.

    Attributes:
        name: "exact" or "native", as users ask for it.
        repeats_noise: whether the noise of baths goes on from a State as it does from a checkpoint.
        evaluations: number of force evaluations so far.
        clock: time and step count; ensembles set it where a step of the integrator is not one of the scheme.
        draws: number of draws of random numbers so far.
    """

    name: str
    repeats_noise: bool
    clock: Clock
    draws: int

    @property
    def evaluations(self) -> int: ...

    @property
    def bodies(self) -> RigidBodies:
        """The rigid and point bodies of the System."""

    # --- one call of the integrator's step ---

    def begin(self, flow: Flow) -> None:
        """Take over what was changed in the Context from outside, and check that the flow can be followed."""

    def follow(self, steps: int) -> None:
        """Advance by steps of the scheme, and the clock with them.

        Raises:
            TrajectoryError: a force or a position is not finite, or constraints cannot be satisfied.
        """

    def publish(self) -> None:
        """Write the last completed step to the Context."""

    def recover(self) -> None:
        """After an error: write the last completed step to the Context as far as the engine still has it."""

    # --- what ensembles need between flows ---

    def potential_energy(self) -> float:
        """Potential energy of the forces that move the bodies, kJ/mol."""

    def kinetic_energy(self) -> float:
        """Kinetic energy, kJ/mol."""

    def positions(self) -> np.ndarray:
        """Positions of all particles, (N, 3), nm."""

    def draw_momenta(self, bath: OrnsteinUhlenbeck, time: float) -> None:
        """Let a bath act for a time in ps; it takes a draw and its heat is counted."""

    def remember(self) -> Any:
        """Everything that `go_back` restores: positions, momenta, box, clock, heat and draws."""

    def go_back(self, memory: Any, reverse: bool = False) -> None:
        """Restore what was remembered; `reverse` reverses all momenta."""

    @property
    def mass(self) -> float:
        """Mass of all that moves, dalton."""

    @property
    def removes_momentum(self) -> bool:
        """Whether the System has a CMMotionRemover."""

    def centre_velocity(self) -> np.ndarray:
        """Velocity of the centre of mass, (3,), nm/ps."""

    def shift_velocities(self, velocity: np.ndarray) -> None:
        """Add a velocity, (3,), nm/ps, to all bodies, and its energy to the heat."""

    def prepare_for_volume_moves(self) -> None:
        """Check that the volume can be changed.

        Raises:
            openmm.OpenMMException: it cannot.
        """

    @property
    def molecules(self) -> int:
        """Number of molecules, each of which moves as a whole with the volume."""

    def volume(self) -> float:
        """Volume of the box, nm^3."""

    def scale(self, factor: float) -> None:
        """Multiply the edges of the box and the centres of mass of all molecules; the clock stays."""

    def heat(self) -> float:
        """Energy that was given to the bodies by baths and moves, and not by forces, kJ/mol."""

    def add_heat(self, energy: float) -> None:
        """Count energy as heat, kJ/mol."""

    # --- what users ask ---

    def state(self) -> BodyState:
        """The bodies' phase point, brought up to date with the Context."""

    def temperatures(self) -> Temperatures:
        """Temperatures in K, see `engines.temperature`."""

    def conserves_momentum(self) -> bool:
        """Whether the total momentum is conserved, see `MomentumConservation`."""

    def minimize(self, by_openmm: Callable[[], None], tolerance: Any, iterations: int, reporter: Any) -> None:
        """Minimize the energy and keep bodies rigid; see `openmm.LocalEnergyMinimizer` for the arguments.

        Args:
            by_openmm: does it with OpenMM's minimizer, which keeps nothing but constraints.
        """

    # --- news from outside ---

    def atoms_moved(self) -> None:
        """Somebody set positions or velocities."""

    def forces_changed(self) -> None:
        """Somebody changed the potential."""

    def groups_changed(self) -> None:
        """Somebody changed the integration force groups."""

    def start_anew(self) -> None:
        """Make the next step depend on nothing but what the Context holds, so that a restart repeats it bit for bit."""
