"""What the engine asks of the integrator that it runs."""

from __future__ import annotations

from typing import Any, Protocol

from openmm_sier.dynamics.barostat import MonteCarloVolumeMove
from openmm_sier.dynamics.bodies import BodyState, RigidBodies
from openmm_sier.dynamics.operators import Operator, Rotation
from openmm_sier.dynamics.schemes import Scheme


class Host(Protocol):
    """An integrator as the engine sees it; methods of `openmm.CustomIntegrator` are among its own."""

    _piston: MonteCarloVolumeMove | None

    @property
    def scheme(self) -> Scheme: ...

    @property
    def rotation(self) -> Rotation: ...

    def getStepSize(self) -> Any: ...

    def getIntegrationForceGroups(self) -> int: ...

    def getPerDofVariableByName(self, name: str) -> Any: ...

    def setPerDofVariableByName(self, name: str, values) -> None: ...

    def setGlobalVariableByName(self, name: str, value: float) -> None: ...

    def _plan_bodies(self, system) -> Any:
        """What tells the bodies of a System, see `find_bodies.BodyPlan`."""

    def _active_scheme(self) -> Scheme:
        """The scheme to execute now."""

    def _extra_operators(self, bodies: RigidBodies) -> dict[str, Operator]:
        """Operators besides kicks and drifts, by name."""

    def _counters(self, known: BodyState | None) -> tuple[float, int]:
        """Heat and number of draws of noise so far."""
