"""Langevin dynamics: a bath inside the scheme, and moves of the volume between steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import openmm

from openmm_sier.dynamics.barostat import MonteCarloVolumeMove
from openmm_sier.dynamics.schemes import BATH, Scheme
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck
from openmm_sier.engines.protocol import Engine, Flow
from openmm_sier.engines.variables import SEED
from openmm_sier.ensembles.ensemble import Record
from openmm_sier.ensembles.volume import is_due, move_volume


@dataclass(frozen=True)
class Langevin:
    """Constant temperature, and constant pressure where volume moves are given.

    Attributes:
        temperature: K.
        friction: of translation, 1/ps.
        rotational_friction: 1/ps.
        volume_move: None keeps the volume.
    """

    temperature: float
    friction: float
    rotational_friction: float
    volume_move: MonteCarloVolumeMove | None = None

    name: ClassVar[str] = "langevin"
    record: ClassVar[tuple[str, ...]] = ()
    is_random: ClassVar[bool] = True
    updates_context: ClassVar[bool] = True

    @property
    def steps(self) -> int:
        return 1

    @property
    def needs_package(self) -> bool:
        return self.volume_move is not None

    def executed(self, scheme: Scheme) -> Scheme:
        """Without its bath if there is no friction, so that the trajectory is that of the scheme alone."""
        return scheme.without(BATH) if self.friction == self.rotational_friction == 0 else scheme

    def bath(self, seed: int) -> OrnsteinUhlenbeck:
        return OrnsteinUhlenbeck(self.temperature, self.friction, self.rotational_friction, seed)

    def check(self, system: openmm.System, engine: Engine) -> None:
        if self.volume_move is not None:
            engine.prepare_for_volume_moves()

    def advance(self, engine: Engine, flow: Flow, record: Record, steps: int) -> None:
        if self.volume_move is None:
            return engine.follow(steps)
        interval, seed = self.volume_move.interval, int(record[SEED])
        while steps:
            done = engine.clock.steps
            if is_due(self.volume_move, done):
                move_volume(engine, self.volume_move, self.temperature, seed)
            flow_steps = min(steps, interval - (done + 1) % interval)
            engine.follow(flow_steps)
            steps -= flow_steps
        return None
