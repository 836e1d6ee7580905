"""The rigid bodies that users ask about, where only atoms move."""

from dataclasses import replace

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet, BodyState, RigidityError
from openmm_sier.dynamics.species import Species
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.system.find_bodies import bodies_of
from openmm_sier.system.links import links_of
from openmm_sier.system.temperature import Temperatures, number_of_freedoms, temperatures


class ReportedBodies:
    """The bodies that constraints form or users named. Where constraints form none, the atoms still move."""

    def __init__(self, system: openmm.System, bodies: BodySet | None, points: BodySet):
        """
        Args:
            system: openmm.System.
            bodies: the rigid bodies; None: those that the constraints form.
            points: the massive atoms, each a body of its own.
        """
        self._error: RigidityError | None = None
        #: Degrees of freedom, by whether the total momentum is conserved. Each trial asks for them twice.
        self._freedoms: dict[bool, float] = {}
        try:
            self._bodies = bodies_of(system, bodies)
        except RigidityError as error:
            self._error = error
            self._bodies = links_of(system).link(points)

    @property
    def species(self) -> tuple[Species, ...]:
        """Return the kinds of body; none where constraints form none."""
        return tuple(self._bodies.species) if self._error is None else ()

    @property
    def bodies(self) -> BodySet:
        """Return the bodies.

        Raises:
            RigidityError: the System has constraints that do not form rigid bodies.
        """
        if self._error is not None:
            raise self._error
        return self._bodies

    def state(self, now: Snapshot) -> BodyState:
        """Return the phase point of the bodies.

        Raises:
            RigidityError: the positions do not form the bodies, or there are none.
        """
        return _state(self.bodies, now)

    def temperatures(self, now: Snapshot, thermal: np.ndarray | None, conserved: bool) -> Temperatures:
        """Return temperatures in K, see `system.temperature`; without rigid bodies those of points.

        Args:
            now: the contents of the Context.
            thermal: velocities of all particles just after a bath in the middle of the last step, nm/ps, from which the
                temperature of flexible molecules is computed; None if there was no bath.
            conserved: whether the total momentum is conserved.
        """
        bodies = self._bodies
        state = _state(bodies, now)
        if thermal is not None:
            p, _ = bodies.momenta(thermal, state.A)
            # The bath leaves noise along the constraints.
            p = bodies.constraints.project(state.q, p)
            state = replace(state, p=np.where(bodies.flexible, p, state.p))
        return temperatures(bodies, state, conserved)

    def degrees_of_freedom(self, conserved: bool) -> float:
        """Return the number of degrees of freedom that share the heat, see `system.temperature`."""
        if conserved not in self._freedoms:
            self._freedoms[conserved] = number_of_freedoms(self._bodies, conserved)
        return self._freedoms[conserved]


def _state(bodies: BodySet, now: Snapshot) -> BodyState:
    """Return the phase point of bodies at the atoms of a snapshot, without momenta along constraints between them."""
    q, A = bodies.fit(now.positions)
    p, L = bodies.momenta(now.velocities, A)
    return BodyState(q, bodies.constraints.project(q, p), A, L)
