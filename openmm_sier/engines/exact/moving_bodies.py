"""The bodies of one Context, the forces on them, and what moves them."""

import weakref
from functools import cached_property

import openmm

from openmm_sier.dynamics.barostat import MoleculeCentres
from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.flow import Flow
from openmm_sier.dynamics.ledger import Ledger
from openmm_sier.dynamics.operators import CachedForces
from openmm_sier.engines.exact.forces import BodyForces
from openmm_sier.engines.exact.minimization import constraints_hold
from openmm_sier.engines.exact.motion import Motion, inner_step
from openmm_sier.engines.exact.packing import Packing
from openmm_sier.stability.step_check import StepCheck
from openmm_sier.system import checks


class MovingBodies:
    """Bodies of known geometry, and what is made for them.

    Attributes:
        bodies: the bodies.
        forces: forces and torques on them, and energies, computed by the Context.
        motion: their operators.
        check_step: refuses steps that are too long for them.
        packing: their phase point as variables of the integrator.
    """

    def __init__(self, context: openmm.Context, bodies: BodySet, flow: Flow, ledger: Ledger):
        """
        Args:
            context: openmm.Context.
            bodies: its bodies.
            flow: what will be followed.
            ledger: counts what a bath does.

        Raises:
            openmm.OpenMMException: the System is refused.
        """
        system = context.getSystem()
        checks.refuse_constrained_lines(system, bodies)
        checks.refuse_deforming_barostats(system, context.getMolecules(), bodies)
        # The Context owns its integrator and so all this: a strong reference back would keep both alive.
        self._context = weakref.proxy(context)
        self._rotation, self._fast_groups, self._ledger = flow.rotation, flow.fast_groups, ledger
        self.bodies = bodies
        self.check_step = StepCheck(system, bodies, inner_step)
        self.forces = BodyForces(context, bodies)
        self._in_kicks = CachedForces(self.forces.in_kicks)
        self.motion = self._new_motion()
        self.packing = Packing(bodies)

    @cached_property
    def molecule_centres(self) -> MoleculeCentres:
        """Return centres of mass of the molecules, each of which moves as a whole with the volume."""
        return MoleculeCentres(self.bodies, self._context.getMolecules())

    @cached_property
    def are_held(self) -> bool:
        """Tell whether the constraints of the System hold all bodies."""
        return constraints_hold(self._context.getSystem(), self.bodies)

    def _new_motion(self) -> Motion:
        fast = self._context.getIntegrator().getIntegrationForceGroups() & self._fast_groups
        return Motion(self._context, self.bodies, self._in_kicks, self._rotation, fast, self._ledger)

    def forces_changed(self) -> None:
        """Make the operators anew: the potential was changed."""
        self.motion = self._new_motion()
        self.forget_forces()

    def forget_forces(self) -> None:
        """Compute forces anew next time: positions, box or parameters were changed."""
        self._in_kicks.invalidate()
        self.forces.forget_energies()
        self.motion.follow(self._context)
