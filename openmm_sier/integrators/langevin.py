"""Langevin dynamics of rigid bodies, for OpenMM users."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from openmm import unit

from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.operators import Rotation
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.schemes import BATH, SIER4G, Scheme
from openmm_sier.integrators import stored_settings
from openmm_sier.integrators.constant_temperature import ConstantTemperatureIntegrator, checked_friction
from openmm_sier.system.arguments import Bodies


class SIERLangevinIntegrator(ConstantTemperatureIntegrator):
    """Rigid-body Langevin dynamics at constant temperature.

    An exact heat bath is placed in the scheme so that averages keep its order: in the middle of SIER2 (kick, half
    drift, bath, half drift, kick), and half at either end of fourth-order schemes (`Scheme.with_bath`). With zero
    friction the trajectory is, bit for bit, that of the scheme without a bath.

    The noise is a function of the seed and of the number of bath operations done so far. Both travel in checkpoints, so
    that a restarted run continues the same trajectory. A State brings only the number, and never brings back noise that
    the Context has used: a run restarted from it is the same if its integrator was given the same seed.

    With `pressure`, Monte Carlo moves change the volume of the box, and a restarted run repeats them exactly. OpenMM's
    barostats work with this integrator too, but no State holds their memory of earlier moves.
    """

    def __init__(
        self,
        temperature: Any,
        frictionCoeff: Any,
        stepSize: Any,
        scheme: Scheme = SIER4G,
        bodies: Bodies = None,
        rotation: Rotation = exact,
        rotationalFriction: Any = None,
        pressure: Any = None,
        barostatInterval: int = 25,
        engine: str = "auto",
        substeps: int | None = None,
        fastForceGroups: Iterable[int] | int | None = None,
    ):
        """
        Args:
            temperature: of the bath, a quantity or a number in K.
            frictionCoeff: coupling to the bath, a quantity or a number in 1/ps.
            stepSize: step, a time quantity or a number in ps.
            scheme: splitting scheme; one without a bath gets one by `Scheme.with_bath`.
            bodies: see `SIERIntegrator`.
            rotation: free-rotation map, such as `rotation.exact`.
            rotationalFriction: friction of the rotation, if it differs from `frictionCoeff`.
            pressure: for constant pressure, a quantity or a number in bar. One move scales all edges of the box by the
                same factor, and changes ln V by up to 0.5/sqrt(number of molecules).
            barostatInterval: number of steps between attempts to change the volume.
            engine, substeps, fastForceGroups: see `SIERIntegrator`. The native engine uses OpenMM's noise and
                barostats.

        Raises:
            ValueError: a value is not finite or has the wrong sign.
            TypeError: a quantity has the wrong dimension.
        """
        scheme = scheme.with_bath() if isinstance(scheme, Scheme) else scheme
        super().__init__(stepSize, scheme, bodies, rotation, engine, substeps, fastForceGroups)
        friction = checked_friction("frictionCoeff", frictionCoeff)
        turning = friction if rotationalFriction is None else checked_friction("rotationalFriction", rotationalFriction)
        self._surround(self._checked_temperature(temperature), (friction, turning), pressure, barostatInterval)
        self._same_friction = rotationalFriction is None
        self._store_surroundings()

    def _store_surroundings(self) -> None:
        stored_settings.store(self, "friction", [self._same_friction])
        super()._store_surroundings()

    def _coupling(self) -> tuple[float, float]:
        return self._bath.friction, GAS_CONSTANT * self._bath.temperature

    def _only_exact(self) -> str | None:
        if self._piston is not None:
            return "has no `pressure` of its own: add an openmm.MonteCarloBarostat to the System"
        if self._bath.rotational_friction != self._bath.friction:
            return "has one friction for all motion: leave out `rotationalFriction`"
        return super()._only_exact()

    def _take_settings(self, rotation: Rotation | None = None) -> None:
        super()._take_settings(rotation)
        self._same_friction = bool(stored_settings.required(self, "friction")[1][0])

    def setFriction(self, coeff: Any) -> None:
        """Set the friction, a quantity or a number in 1/ps, also for the rotation unless that has its own."""
        self._bath.friction = checked_friction("coeff", coeff)
        if self._same_friction:
            self._bath.rotational_friction = self._bath.friction
        self._store_surroundings()

    def getRotationalFriction(self) -> unit.Quantity:
        """Friction of the rotation, a quantity in 1/ps."""
        return self._bath.rotational_friction / unit.picosecond

    def setRotationalFriction(self, coeff: Any) -> None:
        """Set the friction of the rotation, a quantity or a number in 1/ps; `setFriction` no longer changes it."""
        self._bath.rotational_friction = checked_friction("coeff", coeff)
        self._same_friction = False
        self._store_surroundings()

    def _active_scheme(self) -> Scheme:
        scheme = super()._active_scheme()
        cold = self._bath.friction == 0 and self._bath.rotational_friction == 0
        return scheme.without(BATH) if cold else scheme
