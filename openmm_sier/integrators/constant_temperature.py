"""Integrators of constant temperature: one for any ensemble, with temperature, pressure, heat and the noise's seed."""

import math
from dataclasses import replace
from typing import Any

import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.operators import Rotation
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.schemes import SIER4G, Scheme
from openmm_sier.ensembles.ensemble import ConstantTemperature
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.system.arguments import ForceGroups, Quantity, quantity_to_float, whole_number


class SIERThermostatIntegrator(SIERIntegrator):
    """Keep the temperature constant, and the pressure if one is given, with a thermostat of your choice.

    Take `VelocityRescaling` if the bath should hardly disturb the motion. `SIERLangevinIntegrator` and
    `SIERHMCIntegrator` are subclasses with their own thermostats.

    >>> from openmm_sier.ensembles import VelocityRescaling
    >>> integrator = SIERThermostatIntegrator(VelocityRescaling(300*kelvin, 1/picosecond), 4*femtoseconds)
    >>> print(integrator.getTemperature())
    300.0 K

    The noise is a function of the seed and of the number of draws so far. Checkpoints contain both.
    """

    def __init__(
        self,
        thermostat: ConstantTemperature,
        stepSize: Quantity,
        scheme: Scheme | str = SIER4G,
        bodies: BodySet | None = None,
        rotation: Rotation = exact,
        engine: str = "auto",
        substeps: int | None = None,
        fastForceGroups: ForceGroups | None = None,
    ):
        """
        Args:
            thermostat: one of `openmm_sier.ensembles` with a temperature. It keeps its `pressure` too if given.
            stepSize: the step, a time quantity or a number in ps.
            scheme: the splitting scheme or its name.
            bodies: the rigid bodies, as in `SIERIntegrator`; None finds them in the System's constraints.
            rotation: see `SIERIntegrator`.
            engine: see `SIERIntegrator`.
            substeps: see `SIERIntegrator`.
            fastForceGroups: see `SIERIntegrator`.

        Raises:
            ValueError: the scheme cannot sample the thermostat's ensemble, or `SIERIntegrator` refuses a value.
            TypeError: the thermostat keeps no temperature.
        """
        if not isinstance(thermostat, ConstantTemperature):
            raise TypeError(f"thermostat must be like VelocityRescaling(300*kelvin, 1/picosecond), got {thermostat!r}")
        super().__init__(stepSize, scheme, bodies, rotation, engine, substeps, fastForceGroups, ensemble=thermostat)

    def _change_ensemble(self, **changes: Any) -> None:
        self.impl.change(ensemble=replace(self.impl.ensemble, **changes))

    def getTemperature(self) -> unit.Quantity:
        """Return the temperature of the bath, a quantity in K."""
        return self.impl.ensemble.temperature * unit.kelvin

    def setTemperature(self, temp: Quantity) -> None:
        """Set the temperature of the bath, a quantity or a number in K."""
        self._change_ensemble(temperature=temp)

    def getPressure(self) -> unit.Quantity | None:
        """Return the pressure, a quantity in bar; None at constant volume."""
        pressure = self.impl.ensemble.pressure
        return None if pressure is None else pressure * unit.bar

    def setPressure(self, pressure: Quantity) -> None:
        """Set the pressure, a quantity or a number in bar, of an integrator that was made with one."""
        if self.impl.ensemble.pressure is None:
            raise ValueError("this integrator runs at constant volume: create it with a pressure")
        self._change_ensemble(pressure=quantity_to_float("pressure", pressure, unit.bar, "bar"))

    def getBarostatInterval(self) -> int | None:
        """Return the number of steps between attempts to change the volume; None at constant volume."""
        return None if self.impl.ensemble.pressure is None else self.impl.ensemble.interval

    def setRandomNumberSeed(self, seed: int) -> None:
        """Set the seed of the noise for the next Context; as in OpenMM, 0 means a new one for every Context."""
        super().setRandomNumberSeed(whole_number("seed", seed, most=2**31 - 1))

    def getHeat(self) -> unit.Quantity:
        """Return the energy that the bodies got from the bath, volume moves and a CMMotionRemover, a quantity.

        The total energy less this heat is conserved. The heat does not include the work P dV, nor energy from a
        thermostat or barostat of OpenMM in the System, which is not counted.

        Raises:
            openmm.OpenMMException: the engine does not count it, see `SIERLangevinIntegrator`.
        """
        heat = self.countedHeat
        if math.isnan(heat):
            raise openmm.OpenMMException(
                "This integrator does not count the heat of its bath. Make it with countsHeat=True; counting takes up "
                "to a fifth of a step of the native engine on a GPU"
            )
        return heat * unit.kilojoule_per_mole
