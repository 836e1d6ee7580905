"""Langevin dynamics: a bath inside the scheme, and moves of the volume between steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import openmm

from openmm_sier.dynamics.barostat import MonteCarloVolumeMove
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck
from openmm_sier.engines.protocol import Engine, Flow
from openmm_sier.engines.variables import SEED, Record
from openmm_sier.ensembles.ensemble import Ensemble, move_volume


@dataclass(frozen=True)
class Langevin(Ensemble):
    """Constant temperature, and constant pressure where volume moves are given.

    Attributes:
        temperature: K.
        friction: of translation, 1/ps.
        rotational_friction: 1/ps; None: that of translation, also after that was changed.
        volume_move: None keeps the volume.
    """

    temperature: float
    friction: float
    rotational_friction: float | None = None
    volume_move: MonteCarloVolumeMove | None = None

    is_random: ClassVar[bool] = True

    def __post_init__(self) -> None:
        values = self.temperature, self.friction, self.turning
        for name, value in zip(("temperature", "frictionCoeff", "rotationalFriction"), values, strict=True):
            if value < 0:
                raise ValueError(f"{name} must not be negative, got {value} {'K' if name == 'temperature' else '1/ps'}")

    @property
    def turning(self) -> float:
        """Friction of rotation, 1/ps."""
        return self.friction if self.rotational_friction is None else self.rotational_friction

    @property
    def needs_package(self) -> bool:
        return self.volume_move is not None

    def executed(self, scheme: Scheme) -> Scheme:
        """Without its bath if there is no friction, so that the trajectory is that of the scheme alone."""
        return scheme.without_bath() if self.friction == self.turning == 0 else scheme

    def bath(self, seed: int) -> OrnsteinUhlenbeck:
        return OrnsteinUhlenbeck(self.temperature, self.friction, self.turning, seed)

    def check(self, system: openmm.System, engine: Engine) -> None:
        if self.volume_move is not None:
            engine.prepare_for_volume_moves()

    def advance(self, engine: Engine, flow: Flow, record: Record, steps: int) -> None:
        move = self.volume_move
        if move is None:
            return engine.follow(steps)
        while steps:
            count = min(steps, move.interval - 1 - engine.clock.steps % move.interval)
            if count:
                engine.follow(count)
            else:
                self._step_at_new_volume(engine, move, int(record[SEED]))
            steps -= count or 1
        return None

    def _step_at_new_volume(self, engine: Engine, volume_move: MonteCarloVolumeMove, seed: int) -> None:
        """Try a move and make the step after it: both or neither."""
        before, steps = engine.remember(), engine.clock.steps
        try:
            move_volume(engine, volume_move, self.temperature, seed)
            engine.follow(1)
        except BaseException:
            if engine.clock.steps == steps:
                engine.go_back(before)
            raise
