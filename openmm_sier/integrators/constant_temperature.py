"""Integrators at constant temperature: their bath, pressure, heat, and the seed of their noise."""

from __future__ import annotations

import secrets
from typing import Any

import openmm
from openmm import unit

from openmm_sier.dynamics.barostat import MonteCarloVolumeMove
from openmm_sier.dynamics.bodies import BodyState, RigidBodies
from openmm_sier.dynamics.constants import BAR
from openmm_sier.dynamics.operators import Operator, Rotation
from openmm_sier.dynamics.schemes import BATH, Scheme
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck
from openmm_sier.engines.stored_state import SEED
from openmm_sier.integrators import stored_settings
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.system.arguments import quantity_to_float, whole_number


class ConstantTemperatureIntegrator(SIERIntegrator):
    """A `SIERIntegrator` with a heat bath and, if a pressure is given, moves of the volume.

    Its noise is a function of the seed and of the number of draws so far, which both travel in checkpoints.
    """

    def _surround(self, temperature: float, frictions: tuple[float, float], pressure: Any, interval: Any) -> None:
        """Set up bath and pressure of a new integrator.

        Args:
            temperature: K.
            frictions: of translation and of rotation, 1/ps.
            pressure: a quantity or a number in bar; None: the volume is kept.
            interval: number of steps or trials between attempts to change the volume.
        """
        self._bath = OrnsteinUhlenbeck(temperature, frictions[0], frictions[1], seed=0)
        if (interval := whole_number("barostatInterval", interval)) == 0:
            raise ValueError("barostatInterval must be at least 1, got 0")
        self._piston = None if pressure is None else MonteCarloVolumeMove(_pressure(pressure), interval, self._bath)

    def _store_surroundings(self) -> None:
        """Put temperature, friction and pressure as they are now into what OpenMM serializes."""
        bath, piston = self._bath, self._piston
        stored_settings.store(self, "bath", (bath.temperature, bath.friction, bath.rotational_friction))
        if piston is not None:
            stored_settings.store(self, "pressure", (piston.pressure, piston.interval))
        self._tell_program()

    #: A placeholder until the settings of the scheme are in place.
    _bath = OrnsteinUhlenbeck(0.0, 0.0, 0.0, seed=0)

    def _take_settings(self, rotation: Rotation | None = None) -> None:
        super()._take_settings(rotation)
        temperature, friction, turning = stored_settings.required(self, "bath")[1].tolist()
        bath = OrnsteinUhlenbeck(temperature, friction, turning, seed=0)
        self._bath, self._piston = bath, None
        if (found := stored_settings.stored(self, "pressure")) is not None:
            pressure, interval = found[1].tolist()
            self._piston = MonteCarloVolumeMove(pressure, int(interval), bath)

    def _bath_temperature(self) -> float:
        return self._bath.temperature

    def getTemperature(self) -> unit.Quantity:
        """Temperature of the bath, a quantity in K."""
        return self._bath.temperature * unit.kelvin

    def setTemperature(self, temp: Any) -> None:
        """Set the temperature of the bath, a quantity or a number in K."""
        self._bath.temperature = self._checked_temperature(temp)
        self._store_surroundings()

    @staticmethod
    def _checked_temperature(value: Any) -> float:
        value = quantity_to_float("temperature", value, unit.kelvin, "K")
        if value < 0:
            raise ValueError(f"temperature must not be negative, got {value} K")
        return value

    def getFriction(self) -> unit.Quantity:
        """Friction of the translation, a quantity in 1/ps."""
        return self._bath.friction / unit.picosecond

    def getPressure(self) -> unit.Quantity | None:
        """Pressure that is kept, a quantity in bar; None if the volume is kept."""
        return None if self._piston is None else self._piston.pressure / BAR * unit.bar

    def setPressure(self, pressure: Any) -> None:
        """Set the pressure, a quantity or a number in bar, of an integrator that was made with one."""
        if self._piston is None:
            raise ValueError("this integrator keeps the volume: create it with a pressure")
        self._piston.pressure = _pressure(pressure)
        self._store_surroundings()

    def getBarostatInterval(self) -> int | None:
        """The `barostatInterval` that the integrator was made with; None if the volume is kept."""
        return None if self._piston is None else self._piston.interval

    def setRandomNumberSeed(self, seed: int) -> None:
        """Set the seed of the noise for the next Context; as in OpenMM, 0 means a new one for every Context."""
        super().setRandomNumberSeed(whole_number("seed", seed))

    def getHeat(self) -> unit.Quantity:
        """Energy that the bath, and moves of the volume, have given to the bodies, a quantity.

        The total energy less this heat is conserved. The work P dV is not included in the heat.
        """
        return self._bound().heat() * unit.kilojoule_per_mole

    def _bind(self, context: openmm.Context) -> None:
        super()._bind(context)
        # A Context that was reinitialized with its state keeps its seed.
        if self.getGlobalVariableByName(SEED) == 0:
            seed = self.getRandomNumberSeed() or secrets.randbelow(2**31 - 1) + 1
            self.setGlobalVariableByName(SEED, seed)
        self._bath.seed = int(self.getGlobalVariableByName(SEED))

    def _read_record(self, state: BodyState, known: BodyState | None, disturbed: bool) -> BodyState:
        if self.getGlobalVariableByName(SEED) == 0:
            # Somebody wrote the variables of another integrator over ours, as openmmtools' ContextCache does. Noise
            # must not be used twice, so the values known before are restored.
            self.setGlobalVariableByName(SEED, self._bath.seed)
            if known is None:
                self._clear_record()
            else:
                self._write_record(known)
        return super()._read_record(state, known, disturbed)

    def _active_scheme(self) -> Scheme:
        # A loaded checkpoint brings the seed of its run.
        self._bath.seed = int(self.getGlobalVariableByName(SEED))
        return self._scheme

    def _extra_operators(self, bodies: RigidBodies) -> dict[str, Operator]:
        return {BATH: self._bath.operator(bodies)}


def _pressure(value: Any) -> float:
    return BAR * quantity_to_float("pressure", value, unit.bar, "bar")


def checked_friction(name: str, value: Any) -> float:
    """A friction in 1/ps, from a quantity or a number."""
    value = quantity_to_float(name, value, unit.picosecond**-1, "1/ps")
    if value < 0:
        raise ValueError(f"{name} must not be negative, got {value} 1/ps")
    return value
