"""The interface of ensembles, and the one of constant energy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

import openmm

from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck
from openmm_sier.engines.protocol import Engine, Flow


class Record(Protocol):
    """The global variables of an integrator by name: what must travel in checkpoints."""

    def __getitem__(self, name: str, /) -> float: ...

    def __setitem__(self, name: str, value: float, /) -> None: ...


class Ensemble(Protocol):
    """What an integrator holds besides its scheme.

    Attributes:
        name: by which settings are stored.
        record: names of the global variables that it keeps besides heat, draws and seed.
        steps: number of steps of the scheme in one step of the integrator.
        is_random: whether it draws random numbers.
        updates_context: whether Forces that change velocities, positions or the box may act before each step of the
            scheme.
        needs_package: whether the program of the scheme alone would do less.
    """

    name: ClassVar[str]
    record: ClassVar[tuple[str, ...]]
    is_random: ClassVar[bool]
    updates_context: ClassVar[bool]

    @property
    def steps(self) -> int: ...

    @property
    def needs_package(self) -> bool: ...

    def executed(self, scheme: Scheme) -> Scheme:
        """The scheme to execute now."""

    def bath(self, seed: int) -> OrnsteinUhlenbeck | None:
        """What executes the bath of the scheme."""

    def check(self, system: openmm.System, engine: Engine) -> None:
        """Prepare an engine.

        Raises:
            openmm.OpenMMException: the System has a Force with which the ensemble cannot be sampled.
        """

    def advance(self, engine: Engine, flow: Flow, record: Record, steps: int) -> None:
        """Advance by steps of the integrator, from what `Engine.begin` found.

        After an error the engine is at the last completed step.
        """


@dataclass(frozen=True)
class ConstantEnergy:
    """Nothing but the flow."""

    name: ClassVar[str] = "constant energy"
    record: ClassVar[tuple[str, ...]] = ()
    is_random: ClassVar[bool] = False
    updates_context: ClassVar[bool] = True

    @property
    def steps(self) -> int:
        return 1

    @property
    def needs_package(self) -> bool:
        return False

    def executed(self, scheme: Scheme) -> Scheme:
        return scheme

    def bath(self, seed: int) -> OrnsteinUhlenbeck | None:
        return None

    def check(self, system: openmm.System, engine: Engine) -> None:
        """Every System will do."""

    def advance(self, engine: Engine, flow: Flow, record: Record, steps: int) -> None:
        engine.follow(steps)
