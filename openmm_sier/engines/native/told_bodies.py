"""Tell users of the rigid bodies, where only atoms move."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet, BodyState, RigidityError
from openmm_sier.dynamics.species import Species
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.system import tables
from openmm_sier.system.arguments import Bodies
from openmm_sier.system.find_bodies import BodyPlan, known_or_planned
from openmm_sier.system.temperature import (
    Temperatures,
    degrees_of_freedom,
    temperature,
    temperatures,
    thermal_energies,
)


class ToldBodies:
    """Hold the bodies that constraints form or users named; where constraints form none, the atoms still move."""

    def __init__(self, system: openmm.System, given: Bodies, points: BodySet):
        """
        Args:
            system: openmm.System.
            given: bodies as users give them.
            points: the massive atoms, each a body of its own.
        """
        self._points, self._constraints = points, len(tables.constraints(system).pairs)
        #: Degrees of freedom, by whether the total momentum is conserved. Each trial asks for them twice.
        self._freedoms: dict[bool, float] = {}
        self._found: BodySet | BodyPlan | RigidityError
        try:
            self._found = known_or_planned(system, given)
        except RigidityError as error:
            self._found = error

    @property
    def species(self) -> tuple[Species, ...]:
        """Return the kinds of body; none where constraints form none."""
        return () if isinstance(self._found, RigidityError) else tuple(self._found.species)

    def bodies(self, positions: Callable[[], np.ndarray]) -> BodySet:
        """Return the bodies.

        Args:
            positions: gives those of all particles, (N, 3), nm, if named bodies are to get the geometry of these.

        Raises:
            RigidityError: the System has constraints that do not form rigid bodies.
        """
        if isinstance(self._found, RigidityError):
            raise self._found
        if isinstance(self._found, BodyPlan):
            self._found = self._found.bodies(positions())
        return self._found

    def state(self, now: Snapshot) -> BodyState:
        """Return the phase point of the bodies.

        Raises:
            RigidityError: the positions do not form the bodies.
        """
        bodies = self.bodies(lambda: now.positions)
        q, A = bodies.fit(now.positions)
        p, L = bodies.momenta(now.velocities, A)
        return BodyState(q, p, A, L)

    def temperatures(
        self, now: Snapshot, point: Callable[[], BodyState], thermal: np.ndarray | None, conserved: bool
    ) -> Temperatures:
        """Return temperatures in K, see `system.temperature`; without rigid bodies only the total is known.

        Args:
            now: what the Context holds.
            point: gives the phase point of the atoms.
            thermal: velocities of all particles just after a bath in the middle of the last step, nm/ps, which tell the
                temperature of flexible molecules; None if there was no bath.
            conserved: whether the total momentum is conserved.
        """
        if isinstance(self._found, RigidityError):
            return Temperatures(self._total_temperature(point(), thermal, conserved), math.nan, math.nan)
        bodies, state = self.bodies(lambda: now.positions), self.state(now)
        if thermal is not None:
            p, _ = bodies.momenta(thermal, state.A)
            # The bath leaves noise along the constraints.
            p = bodies.constraints.project(state.q, p)
            state = replace(state, p=np.where(bodies.flexible, p, state.p))
        return temperatures(bodies, state, conserved)

    def _total_temperature(self, point: BodyState, thermal: np.ndarray | None, conserved: bool) -> float:
        points = self._points
        if thermal is not None:
            owned = points.owners >= 0
            velocities = np.empty((3, points.n))
            velocities[:, points.owners[owned]] = thermal[owned].T
            point = replace(point, p=points.masses * velocities)
        return temperature(sum(thermal_energies(points, point, conserved)), self._freedoms_of_atoms(conserved))

    def _freedoms_of_atoms(self, conserved: bool) -> float:
        return self._points.dof - self._constraints - (3 if conserved else 0)

    def degrees_of_freedom(self, positions: Callable[[], np.ndarray], conserved: bool) -> float:
        """Return the number of degrees of freedom that share the heat, see `system.temperature`.

        Args:
            positions: see `bodies`.
            conserved: whether the total momentum is conserved.
        """
        if conserved not in self._freedoms:
            self._freedoms[conserved] = self._count_freedoms(positions, conserved)
        return self._freedoms[conserved]

    def _count_freedoms(self, positions: Callable[[], np.ndarray], conserved: bool) -> float:
        if isinstance(self._found, RigidityError):
            return self._freedoms_of_atoms(conserved)
        return sum(degrees_of_freedom(self.bodies(positions), conserved))
