"""What integrators of constant temperature have in common: temperature, pressure, heat, and the seed of their noise."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from openmm import unit

from openmm_sier.dynamics.barostat import MonteCarloVolumeMove
from openmm_sier.dynamics.constants import BAR
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.system.arguments import quantity_to_float, whole_number


class ConstantTemperatureIntegrator(SIERIntegrator):
    """A `SIERIntegrator` whose ensemble has a temperature and, if a pressure is given, moves of the volume.

    Its noise is a function of the seed and of the number of draws so far, which both travel in checkpoints.
    """

    def _change_ensemble(self, **changes: Any) -> None:
        self.binding.change(ensemble=replace(self.binding.ensemble, **changes))

    def getTemperature(self) -> unit.Quantity:
        """Temperature of the bath, a quantity in K."""
        return self.binding.ensemble.temperature * unit.kelvin

    def setTemperature(self, temp: Any) -> None:
        """Set the temperature of the bath, a quantity or a number in K."""
        self._change_ensemble(temperature=in_kelvin(temp))

    def getFriction(self) -> unit.Quantity:
        """Friction of the translation, a quantity in 1/ps; infinite where momenta are drawn anew."""
        friction = self.binding.ensemble.friction
        return (math.inf if friction is None else friction) / unit.picosecond

    def getPressure(self) -> unit.Quantity | None:
        """Pressure that is kept, a quantity in bar; None if the volume is kept."""
        move = self.binding.ensemble.volume_move
        return None if move is None else move.pressure / BAR * unit.bar

    def setPressure(self, pressure: Any) -> None:
        """Set the pressure, a quantity or a number in bar, of an integrator that was made with one."""
        if (move := self.binding.ensemble.volume_move) is None:
            raise ValueError("this integrator keeps the volume: create it with a pressure")
        self._change_ensemble(volume_move=replace(move, pressure=_pressure(pressure)))

    def getBarostatInterval(self) -> int | None:
        """The `barostatInterval` that the integrator was made with; None if the volume is kept."""
        move = self.binding.ensemble.volume_move
        return None if move is None else move.interval

    def setRandomNumberSeed(self, seed: int) -> None:
        """Set the seed of the noise for the next Context; as in OpenMM, 0 means a new one for every Context."""
        super().setRandomNumberSeed(whole_number("seed", seed))

    def getHeat(self) -> unit.Quantity:
        """Energy that the bath, moves of the volume and a CMMotionRemover have given to the bodies, a quantity.

        The total energy less this heat is conserved. The work P dV is not included in the heat.
        """
        return self.binding.engine.heat() * unit.kilojoule_per_mole


def volume_move(pressure: Any, interval: Any) -> MonteCarloVolumeMove | None:
    """The volume move for the arguments `pressure` and `barostatInterval`; None keeps the volume."""
    given = 0.0 if pressure is None else _pressure(pressure)
    move = MonteCarloVolumeMove(given, whole_number("barostatInterval", interval))
    return None if pressure is None else move


def _pressure(value: Any) -> float:
    return BAR * quantity_to_float("pressure", value, unit.bar, "bar")


def in_kelvin(temperature: Any) -> float:
    """A temperature in K, from a quantity or a number."""
    return quantity_to_float("temperature", temperature, unit.kelvin, "K")


def per_picosecond(name: str, friction: Any) -> float:
    """A friction in 1/ps, from a quantity or a number."""
    return quantity_to_float(name, friction, unit.picosecond**-1, "1/ps")
