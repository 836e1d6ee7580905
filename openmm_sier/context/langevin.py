"""Langevin dynamics of rigid bodies, for OpenMM users."""

from __future__ import annotations

import secrets
from collections.abc import Iterable
from typing import Any

import openmm
from openmm import unit

from openmm_sier.context import stored_settings
from openmm_sier.context.arguments import quantity_to_float, whole_number
from openmm_sier.context.host import Bodies
from openmm_sier.context.integrator import SIERIntegrator
from openmm_sier.context.stored_state import SEED
from openmm_sier.dynamics.barostat import MonteCarloVolumeMove
from openmm_sier.dynamics.bodies import BodyState, RigidBodies
from openmm_sier.dynamics.constants import BAR, GAS_CONSTANT
from openmm_sier.dynamics.operators import Operator, Rotation
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.schemes import BATH, SIER4G, Scheme
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck


class SIERLangevinIntegrator(SIERIntegrator):
    """Rigid-body Langevin dynamics at constant temperature.

    The scheme gets an exact heat bath where its averages keep their order: SIER2 in its middle (kick, half drift, bath,
    half drift, kick), schemes of fourth order half at either end (`Scheme.with_bath`). Where the friction is zero the
    trajectory is, bit for bit, that of the scheme without a bath.

    The noise is a function of the seed and of the number of bath operations done so far. Both travel in checkpoints, so
    that a restarted run continues the same trajectory. A State brings the number only, and never back to noise that the
    Context has used: a run restarted from it is the same if its integrator was given the same seed.

    With a pressure the volume of the box changes by Monte Carlo moves, which a restarted run continues in the same way.
    OpenMM's barostats work with this integrator too, but no State holds what they remember of their moves.
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
            rotation: free-rotation map, as `rotation.exact`.
            rotationalFriction: friction of the rotation, if it is to differ from `frictionCoeff`.
            pressure: if it is to be constant, a quantity or a number in bar. All edges of the box change by one factor,
                and ln V by up to 0.5/sqrt(number of molecules) in one move.
            barostatInterval: steps from one attempt to change the volume to the next.
            engine, substeps, fastForceGroups: see `SIERIntegrator`. The native engine takes OpenMM's noise and
                barostats.

        Raises:
            ValueError: a value is not finite or has the wrong sign.
            TypeError: a quantity has the wrong dimension.
        """
        scheme = scheme.with_bath() if isinstance(scheme, Scheme) else scheme
        super().__init__(stepSize, scheme, bodies, rotation, engine, substeps, fastForceGroups)
        friction = _friction("frictionCoeff", frictionCoeff)
        turning = friction if rotationalFriction is None else _friction("rotationalFriction", rotationalFriction)
        bath = OrnsteinUhlenbeck(_temperature(temperature), friction, turning, seed=0)
        if (interval := whole_number("barostatInterval", barostatInterval)) == 0:
            raise ValueError("barostatInterval must be at least 1, got 0")
        piston = None if pressure is None else MonteCarloVolumeMove(_pressure(pressure), interval, bath)
        self._surround(bath, piston, same_friction=rotationalFriction is None)
        self._store_surroundings()

    def _surround(self, bath: OrnsteinUhlenbeck, piston: MonteCarloVolumeMove | None, same_friction: bool) -> None:
        self._bath, self._piston, self._same_friction = bath, piston, same_friction
        self._cold_scheme = self._scheme.without(BATH)

    def _store_surroundings(self) -> None:
        """Put temperature, friction and pressure as they are now into what OpenMM serializes."""
        bath, piston = self._bath, self._piston
        numbers = bath.temperature, bath.friction, bath.rotational_friction, self._same_friction
        stored_settings.store(self, "bath", numbers)
        if piston is not None:
            stored_settings.store(self, "pressure", (piston.pressure, piston.interval))
        self._tell_program()

    def _coupling(self) -> tuple[float, float]:
        return self._bath.friction, GAS_CONSTANT * self._bath.temperature

    def _only_exact(self) -> str | None:
        if self._piston is not None:
            return "has no `pressure` of its own: add an openmm.MonteCarloBarostat to the System"
        if self._bath.rotational_friction != self._bath.friction:
            return "has one friction for all motion: leave out `rotationalFriction`"
        return super()._only_exact()

    #: Until the settings of the scheme are in place.
    _bath = OrnsteinUhlenbeck(0.0, 0.0, 0.0, seed=0)

    def _take_settings(self, rotation: Rotation | None = None) -> None:
        super()._take_settings(rotation)
        temperature, friction, turning, same_friction = stored_settings.required(self, "bath")[1].tolist()
        bath, piston = OrnsteinUhlenbeck(temperature, friction, turning, seed=0), None
        if (found := stored_settings.stored(self, "pressure")) is not None:
            pressure, interval = found[1].tolist()
            piston = MonteCarloVolumeMove(pressure, int(interval), bath)
        self._surround(bath, piston, bool(same_friction))

    def getTemperature(self) -> unit.Quantity:
        """Temperature of the bath, a quantity in K."""
        return self._bath.temperature * unit.kelvin

    def setTemperature(self, temp: Any) -> None:
        """Set the temperature of the bath, a quantity or a number in K."""
        self._bath.temperature = _temperature(temp)
        self._store_surroundings()

    def getFriction(self) -> unit.Quantity:
        """Friction of the translation, a quantity in 1/ps."""
        return self._bath.friction / unit.picosecond

    def setFriction(self, coeff: Any) -> None:
        """Set the friction, a quantity or a number in 1/ps; that of the rotation too unless it was given apart."""
        self._bath.friction = _friction("coeff", coeff)
        if self._same_friction:
            self._bath.rotational_friction = self._bath.friction
        self._store_surroundings()

    def getRotationalFriction(self) -> unit.Quantity:
        """Friction of the rotation, a quantity in 1/ps."""
        return self._bath.rotational_friction / unit.picosecond

    def setRotationalFriction(self, coeff: Any) -> None:
        """Set the friction of the rotation, a quantity or a number in 1/ps; from now on apart from the other."""
        self._bath.rotational_friction = _friction("coeff", coeff)
        self._same_friction = False
        self._store_surroundings()

    def getPressure(self) -> unit.Quantity | None:
        """Pressure that is kept, a quantity in bar; None where the volume is."""
        return None if self._piston is None else self._piston.pressure / BAR * unit.bar

    def setPressure(self, pressure: Any) -> None:
        """Set the pressure, a quantity or a number in bar, of an integrator that was made with one."""
        if self._piston is None:
            raise ValueError("this integrator keeps the volume: create it with a pressure")
        self._piston.pressure = _pressure(pressure)
        self._store_surroundings()

    def getBarostatInterval(self) -> int | None:
        """Steps from one attempt to change the volume to the next; None where the volume is kept."""
        return None if self._piston is None else self._piston.interval

    def setRandomNumberSeed(self, seed: int) -> None:
        """Set the seed of the noise for the next Context; as in OpenMM, 0 takes another one for every Context."""
        super().setRandomNumberSeed(whole_number("seed", seed))

    def getHeat(self) -> unit.Quantity:
        """Energy that the bath, and moves of the volume, have given to the bodies, a quantity.

        The total energy less it is conserved. The work P dV is not in it.
        """
        return self._bound().heat() * unit.kilojoule_per_mole

    def _bind(self, context: openmm.Context) -> None:
        super()._bind(context)
        # A Context that was reinitialized with its state goes on with the seed that it has.
        if self.getGlobalVariableByName(SEED) == 0:
            seed = self.getRandomNumberSeed() or secrets.randbelow(2**31 - 1) + 1
            self.setGlobalVariableByName(SEED, seed)
        self._bath.seed = int(self.getGlobalVariableByName(SEED))

    def _counters(self, known: BodyState | None) -> tuple[float, int]:
        if self.getGlobalVariableByName(SEED) == 0:
            # Somebody wrote the variables of another integrator over ours, as openmmtools' ContextCache does. Noise
            # must not be used twice, so that what was known before holds.
            self.setGlobalVariableByName(SEED, self._bath.seed)
            return (known.heat, known.draws) if known is not None else (0.0, 0)
        return super()._counters(known)

    def _active_scheme(self) -> Scheme:
        # A loaded checkpoint brings the seed of its run.
        self._bath.seed = int(self.getGlobalVariableByName(SEED))
        cold = self._bath.friction == 0 and self._bath.rotational_friction == 0
        return self._cold_scheme if cold else self._scheme

    def _extra_operators(self, bodies: RigidBodies) -> dict[str, Operator]:
        return {BATH: self._bath.operator(bodies)}


def _pressure(value: Any) -> float:
    return BAR * quantity_to_float("pressure", value, unit.bar, "bar")


def _temperature(value: Any) -> float:
    value = quantity_to_float("temperature", value, unit.kelvin, "K")
    if value < 0:
        raise ValueError(f"temperature must not be negative, got {value} K")
    return value


def _friction(name: str, value: Any) -> float:
    value = quantity_to_float(name, value, unit.picosecond**-1, "1/ps")
    if value < 0:
        raise ValueError(f"{name} must not be negative, got {value} 1/ps")
    return value
