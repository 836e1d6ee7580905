"""Samplers of the averages: a bath, trials and velocity rescaling, by what one step of them does."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import openmm

from openmm_sier import SIERHMCIntegrator, SIERLangevinIntegrator, SIERThermostatIntegrator
from openmm_sier.dynamics.schemes import CATALOGUE, Scheme
from openmm_sier.ensembles import VelocityRescaling
from tests.laws.linear_maps import Oscillator, in_bath, pushed


@dataclass(frozen=True)
class Bath:
    """Langevin dynamics.

    Attributes:
        scheme: name.
        engine: name.
        friction: times the step.
        turning: friction of rotation times the step; None: the same.
        step: ps.
        temperature: K.
        pressure: "", "moves" of the integrator, or OpenMM's "barostat".
        substeps: inner steps, with fast bonds.
    """

    scheme: str = "sier2"
    engine: str = "exact"
    friction: float = 0.3
    turning: float | None = None
    step: float = 0.004
    temperature: float = 300.0
    pressure: str = ""
    substeps: int | None = None

    is_exact: ClassVar[bool] = False
    is_ergodic: ClassVar[bool] = True

    def oscillator(self, pace: float) -> Oscillator:
        return in_bath(self._scheme.with_bath(), pace)

    def pushed(self, kept: float) -> float:
        return pushed(self._scheme.with_bath(), kept)

    @property
    def _scheme(self) -> Scheme:
        return CATALOGUE[self.scheme]

    @property
    def keeps(self) -> tuple[float, float] | None:
        turning = self.friction if self.turning is None else self.turning
        return math.exp(-self.friction), math.exp(-turning)

    def integrator(self, **options) -> openmm.CustomIntegrator:
        turning = None if self.turning is None else self.turning / self.step
        friction = self.friction / self.step
        options |= {"rotationalFriction": turning, "substeps": self.substeps, "engine": self.engine}
        return SIERLangevinIntegrator(self.temperature, friction, self.step, self.scheme, **options)


@dataclass(frozen=True)
class Trials:
    """Hybrid Monte Carlo.

    Attributes:
        steps: of a trial.
        share: factor that momenta keep in a trial.
        chances: extra ones.
        remover: whether a CMMotionRemover stops the centre of mass.
    """

    scheme: str = "sier2v2"
    engine: str = "exact"
    steps: int = 3
    share: float = 0.0
    chances: int = 0
    step: float = 0.004
    temperature: float = 300.0
    pressure: str = ""
    substeps: int | None = None
    remover: bool = False

    is_exact: ClassVar[bool] = True
    is_ergodic: ClassVar[bool] = True
    keeps: ClassVar[None] = None

    def oscillator(self, pace: float) -> Oscillator:
        return Oscillator()

    def integrator(self, **options) -> openmm.CustomIntegrator:
        friction = -math.log(self.share) / (self.steps * self.step) if self.share else None
        options |= {"extraChances": self.chances, "substeps": self.substeps, "engine": self.engine}
        return SIERHMCIntegrator(self.temperature, self.step, self.scheme, self.steps, friction, **options)


@dataclass(frozen=True)
class Rescaling:
    """Stochastic velocity rescaling, which keeps nothing canonical but sums over all molecules.

    Attributes:
        rate: times the step.
        every: steps from one scaling to the next.
    """

    scheme: str = "sier2"
    engine: str = "exact"
    rate: float = 0.1
    every: int = 3
    step: float = 0.004
    temperature: float = 300.0
    pressure: str = ""

    is_exact: ClassVar[bool] = False
    is_ergodic: ClassVar[bool] = False
    keeps: ClassVar[None] = None

    def oscillator(self, pace: float) -> Oscillator:
        return in_bath(CATALOGUE[self.scheme], pace)

    def integrator(self, pressure=None, barostatInterval=1, **options) -> openmm.CustomIntegrator:
        options.pop("fastForceGroups", None)
        bath = VelocityRescaling(
            self.temperature, self.rate / self.step, self.every, pressure=pressure, interval=barostatInterval
        )
        return SIERThermostatIntegrator(bath, self.step, self.scheme, engine=self.engine, **options)


Sampler = Bath | Trials | Rescaling
