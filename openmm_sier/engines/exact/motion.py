"""Make the operators that move the bodies of one Context, with constraints, and fast forces in the drifts."""

from typing import Any

import numpy as np
import openmm

from openmm_sier.dynamics import constrained, operators
from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.operators import Forces, Rotation, always
from openmm_sier.dynamics.plan import Bath, Inner, Operation, Plan, plan_step
from openmm_sier.dynamics.tally import Tally
from openmm_sier.engines.exact.fast_force_context import FastForceContext, WorkingForces, working_forces
from openmm_sier.system import tables

#: Number of atoms below which the threads of the CPU platform cost more than they save. With one thread Reference is
#: faster than CPU for bonded forces at any size (78 and 176 us for 90 atoms of a peptide, 0.73 and 1.01 ms for 816).
FEW_ATOMS = 200


class MotionOperators:
    """Operators of one Context's bodies.

    Attributes:
        fast_context: the fast forces, of the bodies that they act on; None where there are none.
    """

    def __init__(
        self,
        context: openmm.Context,
        bodies: BodySet,
        forces: Forces,
        rotation: Rotation,
        fast: list[int],
        tally: Tally,
    ):
        """
        Args:
            context: openmm.Context.
            bodies: its bodies.
            forces: forces on them in the kicks.
            rotation: free-rotation map.
            fast: indices of the Forces that act within drifts, in the System.
            tally: counts what a bath does.

        Raises:
            FastForceError: a fast force is not a bonded force, or has a term on a particle that is in no body.
        """
        self._bodies = bodies
        self._tally = tally
        groups = _flexible_points(bodies)
        working = _working_forces(context.getSystem(), bodies, fast)
        touched = _touched(bodies, working)
        self._table = _table(bodies, forces, rotation, groups)
        self.fast_context: FastForceContext | None = None
        if working.forces:
            platform = _platform_of_fast_forces(context, len(working.particles))
            self.fast_context = FastForceContext(working, bodies.restricted(touched), *platform)
            self.follow(context)
            within = _table(self.fast_context.bodies, self.fast_context, rotation, groups[touched])
            others = bodies.constraints.without(touched)
            drifts = constrained.constrained_drifts(operators.drift(bodies, rotation), others)
            self._table[Inner] = constrained.inner_drifts(drifts, touched, within)

    def plan(self, method: IntegrationMethod, inner_step: float, updates: bool) -> Plan:
        """Return the plan of a method, with inner steps of up to a length in ps."""
        has_inner_steps = self.fast_context is not None and inner_step > 0
        longest_fraction = inner_step / method.step if has_inner_steps else None
        has_constraints = len(self._bodies.constraints.pairs) > 0
        return plan_step(method.scheme, longest_fraction, None, updates, projects=has_constraints)

    def table(self, method: IntegrationMethod) -> dict[type[Operation], Any]:
        """Return the table of the operations of a method."""
        if method.bath is None:
            return self._table
        return {**self._table, Bath: always(constrained.bath_operator(method.bath, self._bodies, self._tally))}

    def follow(self, context: openmm.Context) -> None:
        """Take over parameters and box of the Context for the fast forces."""
        if self.fast_context is not None:
            self.fast_context.follow(context)


def _table(bodies: BodySet, forces: Forces, rotation: Rotation, groups: np.ndarray) -> dict[type[Operation], Any]:
    """Return the table of some bodies; `groups` are those of `DisplacedForces`."""
    if (groups >= 0).any():
        return constrained.constrained_operators(bodies, forces, bodies.constraints, rotation, groups)
    return operators.body_operators(bodies, forces, rotation)


def _platform_of_fast_forces(context: openmm.Context, atoms: int) -> tuple[openmm.Platform, dict[str, str]]:
    """Return the platform for the bonded forces of some atoms: that of the Context, or Reference if that is faster."""
    platform = context.getPlatform()
    kept = set(platform.getPropertyNames()) & {"Threads", "DeterministicForces", "Precision", "DeviceIndex"}
    properties = {name: platform.getPropertyValue(context, name) for name in kept}
    if platform.getName() == "CPU" and (properties["Threads"] == "1" or atoms < FEW_ATOMS):
        return openmm.Platform.getPlatformByName("Reference"), {}
    return platform, properties


def _working_forces(system: openmm.System, bodies: BodySet, fast: list[int]) -> WorkingForces:
    """Return copies of the Forces with some indices that move bodies.

    Forces that cannot be fast are refused even where there is nothing to move.
    """
    owner, moving = bodies.owners.copy(), bodies.owners >= 0
    # Terms between frozen atoms do no work, like those inside one body.
    owner[tables.frozen_without(system, owner)] = bodies.n
    return working_forces([system.getForce(i) for i in fast], owner, moving)


def _touched(bodies: BodySet, working: WorkingForces) -> np.ndarray:
    """Return the bodies on which forces act, and those that are constrained to one of them, ascending, (m,)."""
    touched = np.zeros(bodies.n, dtype=bool)
    touched[bodies.owners[working.particles]] = True
    groups = bodies.constraints.groups
    return np.flatnonzero(touched | (np.isin(groups, groups[touched]) & (groups >= 0)))


def _flexible_points(bodies: BodySet) -> np.ndarray:
    """Return the number of the molecule of each point body in a molecule that is not rigid, (n,); -1 for others."""
    points = bodies.flexible & ~bodies.moments.any(axis=0)
    groups = np.full(bodies.n, -1)
    groups[points] = np.unique(bodies.molecules[points], return_inverse=True)[1]
    return groups
