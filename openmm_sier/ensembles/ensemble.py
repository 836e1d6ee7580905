"""The interface of ensembles, the one of constant energy, and the Monte Carlo move of the volume for others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import openmm

from openmm_sier.dynamics.barostat import MonteCarloVolumeMove
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck
from openmm_sier.engines.protocol import Engine, Flow, TrajectoryError
from openmm_sier.engines.variables import Record


@dataclass(frozen=True)
class Ensemble:
    """What an integrator holds besides its scheme. Without changes of a subclass it adds nothing to the flow.

    The fields of a subclass are stored in XML by their types, see `integrators.settings`.

    Attributes:
        record: names of the global variables that it keeps besides heat, draws and seed.
        steps: number of steps of the scheme in one step of the integrator.
        is_random: whether it draws random numbers.
        updates_context: whether Forces that change velocities, positions or the box may act before each step of the
            scheme.
        needs_package: whether the program of the scheme alone would do less.
        constant_energy: whether nothing but rounding and the step changes the energy.
    """

    record: ClassVar[tuple[str, ...]] = ()
    is_random: ClassVar[bool] = False
    updates_context: ClassVar[bool] = True
    constant_energy: ClassVar[bool] = False

    @property
    def steps(self) -> int:
        return 1

    @property
    def needs_package(self) -> bool:
        return False

    def executed(self, scheme: Scheme) -> Scheme:
        """The scheme to execute now."""
        return scheme

    def bath(self, seed: int) -> OrnsteinUhlenbeck | None:
        """What executes the bath of the scheme."""
        return None

    def check(self, system: openmm.System, engine: Engine) -> None:
        """Prepare an engine.

        Raises:
            openmm.OpenMMException: the System has a Force with which the ensemble cannot be sampled.
        """

    def advance(self, engine: Engine, flow: Flow, record: Record, steps: int) -> None:
        """Advance by steps of the integrator, from what `Engine.begin` found.

        After an error the engine is at the last completed step.
        """
        engine.follow(steps)


@dataclass(frozen=True)
class ConstantEnergy(Ensemble):
    """Nothing but the flow."""

    constant_energy: ClassVar[bool] = True


def move_volume(engine: Engine, move: MonteCarloVolumeMove, temperature: float, seed: int) -> None:
    """Try one move at a temperature in K; it takes a draw of random numbers, and the energy that it gives is heat.

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
