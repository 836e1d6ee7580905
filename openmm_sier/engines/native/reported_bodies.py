"""The rigid bodies that users ask about, where only atoms move."""

import math
from dataclasses import replace

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet, BodyState, RigidityError
from openmm_sier.dynamics.species import Species
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.system.find_bodies import bodies_of
from openmm_sier.system.links import links_of
from openmm_sier.system.temperature import (
    Temperatures,
    number_of_freedoms,
    temperature,
    temperatures,
    thermal_energies,
)


class ReportedBodies:
    """The bodies that constraints form or users named. Where constraints form none, the atoms still move."""

    def __init__(self, system: openmm.System, bodies: BodySet | None, points: BodySet):
        """
        Args:
            system: openmm.System.
            bodies: the rigid bodies; None: those that the constraints form.
            points: the massive atoms, each a body of its own.
        """
        self._points = points
        #: Degrees of freedom, by whether the total momentum is conserved. Each trial asks for them twice.
        self._freedoms: dict[bool, float] = {}
        self._bodies: BodySet | RigidityError
        try:
            self._bodies = bodies_of(system, bodies)
        except RigidityError as error:
            self._bodies = error
            self._points = links_of(system).link(points)

    @property
    def species(self) -> tuple[Species, ...]:
        """Return the kinds of body; none where constraints form none."""
        return () if isinstance(self._bodies, RigidityError) else tuple(self._bodies.species)

    @property
    def bodies(self) -> BodySet:
        """Return the bodies.

        Raises:
            RigidityError: the System has constraints that do not form rigid bodies.
        """
        if isinstance(self._bodies, RigidityError):
            raise self._bodies
        return self._bodies

    def state(self, now: Snapshot) -> BodyState:
        """Return the phase point of the bodies.

        Raises:
            RigidityError: the positions do not form the bodies.
        """
        q, A = self.bodies.fit(now.positions)
        p, L = self.bodies.momenta(now.velocities, A)
        return BodyState(q, p, A, L)

    def temperatures(self, now: Snapshot, thermal: np.ndarray | None, conserved: bool) -> Temperatures:
        """Return temperatures in K, see `system.temperature`; without rigid bodies only the total is known.

        Args:
            now: the contents of the Context.
            thermal: velocities of all particles just after a bath in the middle of the last step, nm/ps, from which the
                temperature of flexible molecules is computed; None if there was no bath.
            conserved: whether the total momentum is conserved.
        """
        if isinstance(self._bodies, RigidityError):
            total = self._total_temperature(now.velocities if thermal is None else thermal, conserved)
            return Temperatures(total, math.nan, math.nan)
        bodies, state = self._bodies, self.state(now)
        if thermal is not None:
            p, _ = bodies.momenta(thermal, state.A)
            # The bath leaves noise along the constraints.
            p = bodies.constraints.project(state.q, p)
            state = replace(state, p=np.where(bodies.flexible, p, state.p))
        return temperatures(bodies, state, conserved)

    def _total_temperature(self, velocities: np.ndarray, conserved: bool) -> float:
        """Return the temperature of velocities of all particles, (N, 3), nm/ps."""
        points = self._points
        owned = points.owners >= 0
        p = np.empty((3, points.n))
        p[:, points.owners[owned]] = velocities[owned].T
        A = np.broadcast_to(np.eye(3)[:, :, None], (3, 3, points.n))
        point = BodyState(np.zeros_like(p), points.masses * p, A, np.zeros_like(p))
        energy = sum(thermal_energies(points, point, conserved))
        return temperature(energy, self.degrees_of_freedom(conserved))

    def degrees_of_freedom(self, conserved: bool) -> float:
        """Return the number of degrees of freedom that share the heat, see `system.temperature`."""
        if conserved not in self._freedoms:
            bodies = self._points if isinstance(self._bodies, RigidityError) else self._bodies
            self._freedoms[conserved] = number_of_freedoms(bodies, conserved)
        return self._freedoms[conserved]
