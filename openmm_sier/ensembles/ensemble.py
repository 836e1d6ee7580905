"""The interface of ensembles, the one of constant energy, and what ensembles of constant temperature share."""

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, ClassVar, NamedTuple

import openmm
from openmm import unit

from openmm_sier.dynamics.barostat import MonteCarloVolumeMove, MoveSize
from openmm_sier.dynamics.constants import BAR, GAS_CONSTANT
from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.engines.protocol import Engine
from openmm_sier.engines.records import TrajectoryError
from openmm_sier.engines.session import Advance
from openmm_sier.engines.variables import PREFIX
from openmm_sier.system import checks
from openmm_sier.system.arguments import quantity_to_float, whole_number

#: Global variables of volume moves: the largest change of ln V, 0 before the first; and what else `MoveSize` has.
SIZE, MOVES, ACCEPTED_MOVES = (PREFIX + name for name in ("volume_size", "volume_moves", "volume_accepted"))

#: Units of the fields of ensembles.
UNITS = {"K": unit.kelvin, "1/ps": unit.picosecond**-1, "bar": unit.bar}


class Move(NamedTuple):
    """A move of an ensemble between steps.

    Attributes:
        every: interval. The move comes before each step whose number, from 1, is a multiple of this, so that
            step(every) ends one step after the move.
        act: a function of the engine.
    """

    every: int
    act: Callable[[Engine], None]


@dataclass(frozen=True)
class Ensemble:
    """Base class of ensembles, which act between the steps of a scheme. By itself it does nothing.

    A subclass has moves, which act between steps, another way to make steps, or another method, such as a bath within
    steps.

    The fields of a subclass are stored in XML as JSON, and given back to its constructor, which must check them.

    Attributes:
        is_random: whether it draws random numbers.
        counts: names of what it counts in the tally.
        steps: number of steps of the scheme in one step of the integrator.
        has_friction: whether it kicks each momentum by itself, so that the total momentum is not conserved.
    """

    counts: ClassVar[tuple[str, ...]] = ()
    is_random: ClassVar[bool] = False

    @property
    def steps(self) -> int:
        return 1

    @property
    def has_friction(self) -> bool:
        return False

    def scheme_for(self, scheme: Scheme) -> Scheme:
        """Return the scheme that an integrator gets if it is asked for one.

        Raises:
            ValueError: the ensemble cannot be sampled by it.
        """
        return scheme

    def method(self, method: IntegrationMethod) -> IntegrationMethod:
        """Return the method with the bath of the ensemble, or whatever else it changes."""
        return method

    def check(self, system: openmm.System, engine: Engine) -> None:
        """Refuse a System or an engine that cannot have the ensemble.

        Raises:
            openmm.OpenMMException: the System has a Force with which the ensemble cannot be sampled.
        """

    @cached_property
    def moves(self) -> tuple[Move, ...]:
        """The moves between steps, in this order. The moves of a step that cannot be completed are undone."""
        return ()

    def advancer(self, engine: Engine) -> Advance:
        """Return a function that makes the next block of steps with an engine, see `Advance`.

        A block ends at a completed step. It is a number of steps, or one step with the moves before it.
        """
        make = self.maker(engine)
        return partial(self._advance, engine, make) if self.moves else make

    def maker(self, engine: Engine) -> Advance:
        """Return a function that makes the next block of steps with an engine, none of which has moves before it."""
        return engine.propagate

    def _advance(self, engine: Engine, make: Advance, steps: int, signals: Collection[Any]) -> int:
        """Make the steps before the next moves, or the moves and the step after them; see `Advance`."""
        moves, made = self.moves, engine.clock.steps
        free = min(steps, *(move.every - 1 - made % move.every for move in moves))
        if free:
            return make(free, signals)
        with engine.transaction(keeps_completed=True):
            for move in moves:
                if (made + 1) % move.every == 0:
                    move.act(engine)
            return make(1, signals)


@dataclass(frozen=True)
class ConstantEnergy(Ensemble):
    """The ensemble of constant energy, which adds nothing to the method."""

    def method(self, method: IntegrationMethod) -> IntegrationMethod:
        return replace(method, constant_energy=True)


@dataclass(frozen=True)
class ConstantTemperature(Ensemble):
    """Keep a temperature and, if a pressure is given, change the volume by Monte Carlo moves between steps.

    You may give fields as quantities; they become numbers in the units below.

    Attributes:
        temperature: K, not negative.
        pressure: bar; None keeps the volume.
        interval: steps from one attempt to change the volume to the next, at least 1.

    Raises:
        ValueError: a value is not finite or has the wrong sign.
        TypeError: a quantity has the wrong dimension.
    """

    temperature: float
    pressure: float | None = field(default=None, kw_only=True)
    interval: int = field(default=25, kw_only=True)

    counts: ClassVar[tuple[str, ...]] = (SIZE, MOVES, ACCEPTED_MOVES)
    is_random: ClassVar[bool] = True

    def __post_init__(self) -> None:
        make_number(self, "temperature", "temperature", "K", least=0)
        if self.pressure is not None:
            make_number(self, "pressure", "pressure", "bar")
        make_number(self, "interval", "barostatInterval", least=1)

    def check(self, system: openmm.System, engine: Engine) -> None:
        if self.pressure is not None:
            checks.refuse_constant_pressure(system, engine.moving)

    @cached_property
    def moves(self) -> tuple[Move, ...]:
        return () if self.pressure is None else (Move(self.interval, partial(self._move_volume, BAR * self.pressure)),)

    def _move_volume(self, pressure: float, engine: Engine) -> None:
        """Try to change the volume at a pressure in kJ/mol/nm^3.

        It takes a draw of random numbers, and the energy that it gives is heat. What it does is counted for the size of
        the next move.

        Raises:
            openmm.OpenMMException: the box became too small for the cut-off, or OpenMM found no energy.
        """
        tally, before = engine.tally, engine.potential_energy()
        sample, volume, size = engine.save(), engine.volume(), _move_size(engine)
        move = MonteCarloVolumeMove.drawn(tally.seed, tally.draws, engine.molecule_centres.count, size.largest)
        try:
            engine.scale(move.factor)
            gain = engine.potential_energy() - before
        except TrajectoryError:
            # Positions that are not finite have nothing to do with the size of the box.
            raise
        except openmm.OpenMMException as error:
            remedy = "Take a larger box or a shorter cut-off. " if "periodic box size" in str(error) else ""
            raise openmm.OpenMMException(
                f"Step {engine.clock.steps + 1} could not try a volume of {move.factor**3 * volume:.4f} nm^3: "
                f"{str(error).rstrip('.')}. {remedy}The Context is left at the last completed step"
            ) from error
        probability = move.probability(gain, pressure, volume, GAS_CONSTANT * self.temperature)
        if move.is_accepted(probability):
            tally.heat += gain
        else:
            engine.restore(sample)
        tally.draws += 1
        tally.counts.update(zip((SIZE, MOVES, ACCEPTED_MOVES), size.after(probability), strict=True))


def make_number(ensemble: Ensemble, field: str, name: str, symbol: str = "", least: float = -math.inf) -> None:
    """Make a field a number in one of `UNITS`, or a whole one without a unit.

    Args:
        ensemble: gets the number.
        field: of the ensemble; may hold a quantity.
        name: by which users know the field.
        symbol: of the unit.
        least: that it may be.

    Raises:
        ValueError: it is less, not finite, or not a whole number.
        TypeError: it is no number, or its quantity has the wrong dimension.
    """
    given = getattr(ensemble, field)
    value = quantity_to_float(name, given, UNITS[symbol], symbol) if symbol else whole_number(name, given)
    if value < least:
        raise ValueError(f"{name} must be at least {least}, got {value} {symbol}".strip())
    object.__setattr__(ensemble, field, value)


def _move_size(engine: Engine) -> MoveSize:
    """Return the size of the next move, by what is counted of the earlier ones."""
    counts = engine.tally.counts
    if not counts[SIZE]:
        return MoveSize.first(engine.molecule_centres.count)
    return MoveSize(counts[SIZE], int(counts[MOVES]), counts[ACCEPTED_MOVES])
