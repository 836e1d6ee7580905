"""What acts on bodies between two steps of a scheme: Forces with an effect of their own, and moves of the volume."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import openmm

from openmm_sier.dynamics.barostat import MonteCarloVolumeMove
from openmm_sier.dynamics.bodies import BodyState, RigidBodies
from openmm_sier.engines.exact.atoms import Atoms
from openmm_sier.engines.host import Host
from openmm_sier.engines.native.program import PART
from openmm_sier.system import checks


class Actors:
    """Forces of a System that change positions, velocities or the box.

    Attributes:
        are_present: whether there are any other than CMMotionRemovers.
        are_barostats: whether all of those are barostats, which leave velocities alone.
    """

    def __init__(self, system: openmm.System):
        forces = [system.getForce(i) for i in range(system.getNumForces())]
        acting = [force for force in forces if not checks.is_passive(force)]
        self.are_present = bool(acting)
        self.are_barostats = all(isinstance(force, checks.BAROSTATS) for force in acting)
        self._sweep_frequencies = [f.getFrequency() for f in forces if isinstance(f, openmm.CMMotionRemover)]

    def swept(self, bodies: RigidBodies, state: BodyState, steps: int) -> BodyState:
        """Do what a CMMotionRemover does, for bodies, before the step that follows `steps` completed ones."""
        if not any(steps % frequency == 0 for frequency in self._sweep_frequencies):
            return state
        return replace(state, p=state.p - bodies.masses * bodies.centre_velocity(state.p))


def act(integrator: Host) -> None:
    """Let OpenMM update the Context's state and do nothing else."""
    h = integrator.getStepSize()
    try:
        integrator.setGlobalVariableByName(PART, -1)
        # AndersenThermostat must see the whole step.
        openmm.CustomIntegrator.setStepSize(integrator, h)
        openmm.CustomIntegrator.step(integrator, 1)
    finally:
        openmm.CustomIntegrator.setStepSize(integrator, h / integrator._native_steps)
        integrator.setGlobalVariableByName(PART, 0)


class VolumeMoves:
    """Constant pressure by an integrator's own moves of the volume."""

    def __init__(self, piston: MonteCarloVolumeMove, bodies: RigidBodies, atoms: Atoms):
        """
        Raises:
            openmm.OpenMMException: the volume of the System cannot be changed.
        """
        context = atoms.context
        checks.refuse_constant_pressure(context.getSystem(), bodies)
        self._bodies, self._atoms = bodies, atoms
        self._move = piston.operator(bodies, context.getMolecules())

    def apply(self, state: BodyState, steps: int, groups: int) -> BodyState:
        """Try a move before the step that follows `steps` completed ones.

        Args:
            state: of the bodies.
            steps: completed so far.
            groups: bit mask of the force groups whose energy counts.

        Raises:
            openmm.OpenMMException: the box became too small for the cut-off.
            NotFiniteError: a position is not finite.
        """
        context, box = self._atoms.context, self._atoms.box()

        def energy(q: np.ndarray, factor: float) -> float:
            context.setPeriodicBoxVectors(*(factor * box))
            self._atoms.place(self._bodies, q, state.A)
            try:
                return context.getState(energy=True, groups=groups).getPotentialEnergy()._value
            except openmm.OpenMMException as error:
                edges = " x ".join(f"{edge:.3f}" for edge in factor * np.diag(box))
                raise openmm.OpenMMException(
                    f"Step {steps + 1} could not try a box of {edges} nm: {error}. A larger box or a "
                    "shorter cut-off would help. The Context is left at the last completed step."
                ) from error

        state, factor = self._move(state, float(np.linalg.det(box)), energy)
        context.setPeriodicBoxVectors(*(factor * box))
        return state
