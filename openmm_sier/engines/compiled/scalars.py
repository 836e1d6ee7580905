"""The numbers of kernels that depend on settings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck, decay


@dataclass(frozen=True)
class Time:
    """A scalar: a factor times a power of the step."""

    factor: float
    power: int = 1

    size = 1

    def values(self, step: float, bath: OrnsteinUhlenbeck | None) -> list[float]:
        return [self.factor * step**self.power]


@dataclass(frozen=True)
class BathTime:
    """Scalars of a bath: factor of momenta and width of their noise, and those of angular momenta.

    Attributes:
        fraction: its time as a fraction of the step.
    """

    fraction: float

    size = 4

    def values(self, step: float, bath: OrnsteinUhlenbeck | None) -> list[float]:
        frictions = None if bath is None else bath.shared_frictions
        if bath is None or frictions is None:
            return [1.0, 0.0, 1.0, 0.0]
        root = np.sqrt(GAS_CONSTANT * bath.temperature)
        damping, width = decay(frictions[0], self.fraction * step)
        rotational_damping, rotational_width = decay(frictions[1], self.fraction * step)
        return [damping, root * width, rotational_damping, root * rotational_width]


class Scalars:
    """The numbers of kernels that depend on settings."""

    def __init__(self) -> None:
        self._places: dict[Time | BathTime, int] = {}
        self._size = 0

    def place(self, scalar: Time | BathTime) -> int:
        """Return the place of a scalar, or of the first of several, which is added unless it is there."""
        if scalar not in self._places:
            self._places[scalar] = self._size
            self._size += scalar.size
        return self._places[scalar]

    def values(self, method: IntegrationMethod) -> np.ndarray:
        """Return all values for the settings of a method; there is at least one."""
        values = [value for scalar in self._places for value in scalar.values(method.step, method.bath)]
        return np.array(values or [0.0])
