"""What ensembles and users ask of the exact engine at a completed step, by its phase point."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodyState
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.constrained import bath_operator
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck
from openmm_sier.engines.exact.forces import BodyForces
from openmm_sier.engines.exact.motion import MotionOperators
from openmm_sier.engines.exact.updates import SystemUpdates
from openmm_sier.engines.protocol import Engine
from openmm_sier.engines.records import RollbackState
from openmm_sier.engines.snapshot import Environment, Snapshot, box_of
from openmm_sier.engines.variables import HIDDEN_KINETIC
from openmm_sier.system.temperature import Temperatures, number_of_freedoms, temperatures


class PointVerbs(Engine):
    """The verbs of an engine that holds the phase point of bodies.

    Attributes:
        forces: forces and torques on the bodies, and energies, computed by the Context.
        motion: the operators that move the bodies.
        updates: Forces of the System that act between steps, such as barostats.
        point: the phase point of the last completed step; there is none before the first `synchronize`.
    """

    forces: BodyForces
    motion: MotionOperators
    updates: SystemUpdates
    point: BodyState
    #: Box and parameters for which forces were computed.
    _environment: Environment | None = None
    #: Masses of all particles, (N,), Da.
    _masses: np.ndarray
    #: Whether there is a phase point.
    _has_point = False
    #: The end of the last step, and the phase point just after the bath within it.
    _last: tuple[BodyState, BodyState] | None = None

    # --- the phase point ---

    def save(self) -> RollbackState:
        # OpenMM's barostats also move atoms of no body.
        atoms = self.forces.positions.copy() if self.updates.acts else None
        tally = self.tally
        return RollbackState(self.point, self.clock, self._box(), tally.mark(), dict(tally.counts), atoms)

    def restore(self, saved: RollbackState, reverse: bool = False) -> None:
        if saved.more is not None:
            self.forces.positions[:] = saved.more
            self.forces.forget_place()
        if saved.box != self._box():
            self._set_box(saved.box)
        point = saved.point
        self.point = BodyState(point.q, -point.p, point.A, -point.L, point.cache) if reverse else point
        self.clock = saved.clock
        self.tally.restore(saved.mark)

    def _box(self) -> Any:
        """Return the periodic box vectors, nm."""
        return box_of(openmm.Context.getState(self._context))

    def _set_box(self, box: Any) -> None:
        openmm.Context.setPeriodicBoxVectors(self._context, *box)
        if self._environment is not None:
            self._environment = self._environment._replace(box=self._box())
        self.motion.follow(self._context)

    def _take_environment(self, now: Snapshot) -> None:
        """Take over box and parameters of a Context where they differ."""
        if now.environment != self._environment:
            self._forget_forces()
            self._environment = now.environment

    def _forget_forces(self) -> None:
        """Compute forces again next time: positions, box or parameters were changed."""
        if self._has_point:
            self.point = replace(self.point)
        self.motion.follow(self._context)

    # --- moves of ensembles ---

    def positions(self) -> np.ndarray:
        """Return the positions of all atoms of bodies, (N, 3), nm; zero for other particles."""
        point = self.point
        return self.moving.place(point.q, point.A, np.zeros((self.moving.n_particles, 3)))

    def potential_energy(self) -> float:
        if self.changes:
            self.synchronize()
        return self.forces.energy(self.point)

    def kinetic_energy(self) -> float:
        return sum(self.moving.kinetic_energies(self.point))

    def centre_velocity(self) -> np.ndarray:
        return self.moving.centre_velocity(self.point.p)

    def transform_velocities(self, factor: float, shift: np.ndarray) -> None:
        point = self.point
        scaled = BodyState(point.q, factor * point.p, point.A, factor * point.L, point.cache)
        self.point = self.moving.shifted(scaled, shift)

    def draw_momenta(self, kT: float, kept: float) -> None:
        friction = -math.log(kept) if kept else math.inf
        bath = OrnsteinUhlenbeck(kT / GAS_CONSTANT, friction, friction)
        self.point = bath_operator(bath, self.moving, self.tally)(self.point, 1.0)

    def scale(self, factor: float) -> None:
        self._set_box([factor * edge for edge in self._box()])
        point = self.point
        self.point = replace(point, q=point.q + (factor - 1) * self.molecule_centres(point.q))

    # --- questions of users ---

    def state(self) -> BodyState:
        if self.changes:
            self.synchronize()
        return self.point

    def temperatures(self, conserved: bool) -> Temperatures:
        state = self.state()
        if self._last is not None and self._last[0].p is state.p:
            state = self._last[1]
        return temperatures(self.moving, state, conserved)

    def degrees_of_freedom(self, conserved: bool) -> float:
        return number_of_freedoms(self.moving, conserved)

    def _report_hidden_kinetic_energy(self) -> None:
        """Write the kinetic energy that OpenMM does not find in velocities of atoms, see `HIDDEN_KINETIC`."""
        of_atoms = 0.5 * float(np.einsum("i,ix,ix->", self._masses, self.forces.velocities, self.forces.velocities))
        hidden = self.kinetic_energy() - of_atoms
        share = hidden / (3 * np.count_nonzero(self._masses))
        self._integrator.setPerDofVariableByName(HIDDEN_KINETIC, np.full((len(self._masses), 3), share))
