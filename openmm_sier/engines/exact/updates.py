"""Forces that act between steps, such as OpenMM's barostats and thermostats."""

import weakref

import openmm

from openmm_sier.engines.variables import PART
from openmm_sier.system import checks
from openmm_sier.system.forces import kind_of


class SystemUpdates:
    """Forces of a System that change positions, velocities or the box between steps.

    Attributes:
        acts: whether any does so in OpenMM; a CMMotionRemover does not, since the engine does what it is for.
        are_of_barostats: whether they are barostats alone, which leave velocities as they are.
        removers: for each CMMotionRemover, the number of steps from one action to the next.
    """

    def __init__(self, context: openmm.Context):
        # The Context owns its integrator and so all this: a strong reference back would keep both alive.
        self._context = weakref.proxy(context)
        system = context.getSystem()
        acting = checks.acting_forces(system)
        self.acts = bool(acting)
        self.are_of_barostats = all(kind_of(force).sets == "pressure" for force in acting)
        forces = [force for force in system.getForces() if isinstance(force, openmm.CMMotionRemover)]
        self.removers = [force.getFrequency() for force in forces]

    def let_act(self, step: float) -> None:
        """Apply their update for one step of `step` ps, without integration."""
        plain, integrator = openmm.CustomIntegrator, self._context.getIntegrator()
        native_step = plain.getStepSize(integrator)
        try:
            integrator.setGlobalVariableByName(PART, -1)
            plain.setStepSize(integrator, step)
            plain.step(integrator, 1)
        finally:
            plain.setStepSize(integrator, native_step)
            integrator.setGlobalVariableByName(PART, 0)
