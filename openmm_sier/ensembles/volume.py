"""The Monte Carlo move of the volume, for every ensemble of constant pressure and every engine."""

from __future__ import annotations

import openmm

from openmm_sier.dynamics.barostat import MonteCarloVolumeMove
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.engines.protocol import Engine, TrajectoryError


def move_volume(engine: Engine, move: MonteCarloVolumeMove, temperature: float, seed: int) -> None:
    """Try one move; it takes a draw of random numbers, and its change of the potential energy counts as heat.

    Args:
        engine: prepared for volume moves.
        move: its pressure.
        temperature: K.
        seed: of the random numbers.

    Raises:
        openmm.OpenMMException: the box became too small for the cut-off. The engine is back where it was.
    """
    before, sample = engine.potential_energy(), engine.remember()
    proposal = move.proposal(seed, engine.draws, engine.molecules)
    volume = engine.volume()
    try:
        engine.scale(proposal.factor)
        gain = engine.potential_energy() - before
    except BaseException as error:
        engine.go_back(sample)
        if isinstance(error, openmm.OpenMMException) and not isinstance(error, TrajectoryError):
            raise openmm.OpenMMException(
                f"Step {engine.clock.steps + 1} could not try a volume of {proposal.factor**3 * volume:.4f} nm^3: "
                f"{error} A larger box or a shorter cut-off would help. The Context is left at the last completed step"
            ) from error
        raise
    if proposal.is_accepted(gain, volume, GAS_CONSTANT * temperature):
        engine.add_heat(gain)
    else:
        engine.go_back(sample)
    engine.draws += 1


def is_due(move: MonteCarloVolumeMove | None, steps: int) -> bool:
    """Whether to try a move before the step that follows `steps` completed ones."""
    return move is not None and (steps + 1) % move.interval == 0
