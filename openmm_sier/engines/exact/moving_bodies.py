"""The bodies of one Context from the plan on, the forces on them, and what moves them."""

import weakref

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import RigidBodies
from openmm_sier.dynamics.flow import Flow
from openmm_sier.dynamics.operators import CachedForces
from openmm_sier.engines import neighbour_list
from openmm_sier.engines.exact import packing
from openmm_sier.engines.exact.forces import BodyForces
from openmm_sier.engines.exact.motion import Motion, inner_step
from openmm_sier.engines.protocol import Movers
from openmm_sier.engines.variables import SITES
from openmm_sier.stability.step_check import StepCheck
from openmm_sier.system import checks
from openmm_sier.system.find_bodies import BodyPlan


class MovingBodies:
    """Bodies that are settled when their geometry is known: at once, or at the first positions, for named bodies.

    Attributes:
        is_settled: whether there are bodies yet, and so the attributes that follow, which are made of them.
        movers: the bodies.
        check_step: refuses steps that are too long for them.
        motion: their operators.
        forces: forces and torques on them, and energies, computed by the Context.
        moves_volume: whether an ensemble changes the volume.
    """

    is_settled = False
    movers: Movers
    check_step: StepCheck
    motion: Motion
    moves_volume = False

    def __init__(self, context: openmm.Context, found: RigidBodies | BodyPlan, flow: Flow):
        """
        Args:
            context: openmm.Context.
            found: what `find_bodies.known_or_planned` gave.
            flow: what will be followed.

        Raises:
            openmm.OpenMMException: the System is refused.
        """
        # The Context owns its integrator and so all this: a strong reference back would keep both alive.
        self._context = weakref.proxy(context)
        self.forces = BodyForces(context)
        self._in_kicks = CachedForces(self.forces.in_kicks)
        self._rotation, self._fast_groups = flow.rotation, flow.fast_groups
        self._remembers_list, self._starts_anew = neighbour_list.is_remembered(context), False
        self._plan = found if isinstance(found, BodyPlan) else None
        if not isinstance(found, BodyPlan):
            self._settle(found)

    # --- their life ---

    def settle_by(self, positions: np.ndarray) -> None:
        """Settle planned bodies with the geometry that the Context carries or, the first time, that of positions.

        Raises:
            RigidityError, openmm.OpenMMException: the positions do not form the bodies, or what they form is refused.
        """
        if self._plan is None:
            return
        integrator = self._context.getIntegrator()
        sites = np.array(integrator.getPerDofVariableByName(SITES))
        if not (self.is_settled and np.array_equal(packing.sites(self.movers.bodies), sites)):
            self._settle(self._plan.bodies(positions, sites))
            integrator.setPerDofVariableByName(SITES, packing.sites(self.movers.bodies))

    def _settle(self, bodies: RigidBodies) -> None:
        context = self._context
        system = context.getSystem()
        checks.refuse_constrained_lines(system, bodies)
        self.check_step = StepCheck(system, bodies, inner_step)
        checks.refuse_deforming_barostats(system, context.getMolecules(), bodies)
        if self.moves_volume:
            checks.refuse_constant_pressure(system, bodies)
        self.motion = self._new_motion(bodies)
        self.forces.bodies = bodies
        self.movers, self.is_settled = Movers(bodies, lambda: context.getMolecules()), True

    def _new_motion(self, bodies: RigidBodies) -> Motion:
        fast = self._context.getIntegrator().getIntegrationForceGroups() & self._fast_groups
        return Motion(self._context, bodies, self._in_kicks, self._rotation, fast)

    # --- forces that are out of date ---

    def forces_changed(self) -> None:
        """The potential was changed."""
        if self.is_settled:
            self.motion = self._new_motion(self.movers.bodies)
            self.forget_forces()

    def forget_forces(self) -> None:
        """Compute forces anew next time: positions, box or parameters were changed."""
        self._in_kicks.invalidate()
        self.forces.forget_energies()
        self.motion.follow(self._context)

    def start_anew(self) -> None:
        """Make the next forces depend on nothing but the Context's state, see `neighbour_list`."""
        self._starts_anew = self._remembers_list

    def forget_past(self) -> None:
        """Do what `start_anew` asked for, if it did."""
        if self._starts_anew:
            neighbour_list.forget(self._context)
            self.forget_forces()
            self._starts_anew = False
