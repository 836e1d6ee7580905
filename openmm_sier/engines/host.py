"""The interface of integrators that the engines use."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
import openmm

from openmm_sier.dynamics.barostat import MonteCarloVolumeMove
from openmm_sier.dynamics.bodies import BodyState, RigidBodies
from openmm_sier.dynamics.operators import Operator, Rotation, Stepper
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.system.arguments import Bodies


class Host(Protocol):
    """An integrator as the engines see it, including methods of `openmm.CustomIntegrator`."""

    _piston: MonteCarloVolumeMove | None
    _given_bodies: Bodies
    #: Bit mask of the force groups that act within drifts, and into how many inner steps these are divided, if given.
    _fast_groups: int
    _substeps: int | None

    @property
    def scheme(self) -> Scheme: ...

    @property
    def _native_steps(self) -> int:
        """Steps of OpenMM in one step of the scheme."""

    @property
    def rotation(self) -> Rotation: ...

    def getStepSize(self) -> Any: ...

    def getIntegrationForceGroups(self) -> int: ...

    def getPerDofVariableByName(self, name: str) -> Any: ...

    def setPerDofVariableByName(self, name: str, values: np.ndarray) -> None: ...

    def getConstraintTolerance(self) -> float: ...

    def setConstraintTolerance(self, tol: float) -> None: ...

    def getGlobalVariableByName(self, name: str) -> float: ...

    def setGlobalVariableByName(self, name: str, value: float) -> None: ...

    def _plan_bodies(self, system: openmm.System) -> Any:
        """The plan of a System's bodies, see `find_bodies.BodyPlan`."""

    def _only_exact(self) -> str | None:
        """Why the native engine cannot run this integrator, and the remedy; None if it can."""

    def _tell_program(self) -> None:
        """Give the variables of the native program the values that they must have."""

    def _active_scheme(self) -> Scheme:
        """The scheme to execute now."""

    def _extra_operators(self, bodies: RigidBodies) -> dict[str, Operator]:
        """Operators besides kicks and drifts, by name."""

    def _stepper(self, engine: Any, scheme: Scheme, operators: Mapping[str, Operator], h: float) -> Stepper:
        """The function that makes a step of length h, ps, with the operators of an exact engine."""

    def _moves_volume(self, state: BodyState, steps: int) -> bool:
        """Whether to move the volume at a state, before the step that follows `steps` completed ones."""

    def _potential_changed(self) -> None:
        """Respond to a change of forces on bodies, or of the box, from outside."""

    def _write_record(self, state: BodyState) -> None:
        """Store what a state holds besides its phase point in variables, which travel in checkpoints."""

    def _read_record(self, state: BodyState, known: BodyState | None, disturbed: bool) -> BodyState:
        """A phase point, with what the variables hold besides it.

        Args:
            state: the phase point.
            known: the state before changes from outside; None if there was none.
            disturbed: whether positions or velocities differ from those stored with the variables.
        """
