"""The interface of ensembles, the one of constant energy, and what ensembles of constant temperature share."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import ClassVar

import openmm
from openmm import unit

from openmm_sier.dynamics.barostat import MonteCarloVolumeMove, MoveSize
from openmm_sier.dynamics.constants import BAR, GAS_CONSTANT
from openmm_sier.dynamics.flow import Flow
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.engines.protocol import Engine, TrajectoryError
from openmm_sier.engines.variables import PREFIX, SEED, Record
from openmm_sier.system.arguments import quantity_to_float, whole_number

#: Global variables of volume moves: the largest change of ln V, 0 before the first; and what else `MoveSize` has.
SIZE, MOVES, ACCEPTED_MOVES = (PREFIX + name for name in ("volume_size", "volume_moves", "volume_accepted"))

#: Does something for an ensemble.
Action = Callable[..., None]

#: Units of the fields of ensembles.
UNITS = {"K": unit.kelvin, "1/ps": unit.picosecond**-1, "bar": unit.bar}


@dataclass(frozen=True)
class Ensemble:
    """What an integrator holds besides its scheme. Without changes of a subclass it adds nothing to the flow.

    The fields of a subclass are stored in XML as JSON, and given back to its constructor, which must check them.

    Attributes:
        is_random: whether it draws random numbers.
        record: names of the global variables that it keeps besides heat, draws and seed.
        steps: number of steps of the scheme in one step of the integrator.
        needs_package: whether the program of the scheme alone would do less.
        has_friction: whether it kicks each momentum by itself, so that the total momentum is not conserved.
    """

    record: ClassVar[tuple[str, ...]] = ()
    is_random: ClassVar[bool] = False

    @property
    def steps(self) -> int:
        return 1

    @property
    def needs_package(self) -> bool:
        return False

    @property
    def has_friction(self) -> bool:
        return False

    def suited(self, scheme: Scheme) -> Scheme:
        """The scheme that an integrator gets if it is asked for one.

        Raises:
            ValueError: the ensemble cannot be sampled by it.
        """
        return scheme

    def flow(self, flow: Flow, seed: int) -> Flow:
        """What the engine is to follow now, from a flow at constant energy."""
        return flow

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

    def flow(self, flow: Flow, seed: int) -> Flow:
        return replace(flow, constant_energy=True)


@dataclass(frozen=True)
class ConstantTemperature(Ensemble):
    """What has a temperature and, if a pressure is given, Monte Carlo moves of the volume between its steps.

    Fields may be given as quantities, and are numbers in the units that are named.

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

    record: ClassVar[tuple[str, ...]] = (SIZE, MOVES, ACCEPTED_MOVES)
    is_random: ClassVar[bool] = True

    def __post_init__(self) -> None:
        make_number(self, "temperature", "temperature", "K", least=0)
        if self.pressure is not None:
            make_number(self, "pressure", "pressure", "bar")
        make_number(self, "interval", "barostatInterval", least=1)

    @property
    def needs_package(self) -> bool:
        return self.pressure is not None

    def check(self, system: openmm.System, engine: Engine) -> None:
        if self.pressure is not None:
            engine.prepare_for_volume_moves()

    def advance(self, engine: Engine, flow: Flow, record: Record, steps: int) -> None:
        at_volume = partial(self.advance_at_volume, engine, flow, record)
        if self.pressure is None:
            return at_volume(steps)
        move = partial(_move_volume, engine, record, BAR * self.pressure, self.temperature)
        return advance_between(engine, record, steps, self.interval, move, at_volume)

    def advance_at_volume(self, engine: Engine, flow: Flow, record: Record, steps: int) -> None:
        """What `advance` does at constant volume."""
        engine.follow(steps)


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


def advance_between(engine: Engine, record: Record, steps: int, interval: int, act: Action, advance: Action) -> None:
    """Advance by steps of the integrator, and do something before each whose number is a multiple of an interval.

    After an error both the step and what was done before it are undone.

    Args:
        engine: counts steps.
        record: what is noted of what was done.
        steps: number of steps.
        interval: at least 1.
        act: what is done, a function without arguments.
        advance: advances by so many steps.
    """
    while steps:
        count = min(steps, interval - 1 - engine.clock.steps % interval)
        if count:
            advance(count)
        else:
            before, noted, done = engine.remember(), record.values(), engine.clock.steps
            try:
                act()
                advance(1)
            except BaseException:
                if engine.clock.steps == done:
                    engine.undo(before)
                    record.set(noted)
                raise
        steps -= count or 1


def _move_volume(engine: Engine, record: Record, pressure: float, temperature: float) -> None:
    """Try one move at a pressure in kJ/mol/nm^3 and a temperature in K.

    It takes a draw of random numbers, and the energy that it gives is heat. What it does is noted for the size of the
    next.

    Raises:
        openmm.OpenMMException: the box became too small for the cut-off. The engine is back where it was.
    """
    before, sample, volume = engine.potential_energy(), engine.remember(), engine.volume()
    size = _move_size(engine, record)
    move = MonteCarloVolumeMove.drawn(int(record[SEED]), engine.draws, engine.movers.centres.count, size.largest)
    try:
        engine.scale(move.factor)
        gain = engine.potential_energy() - before
    except BaseException as error:
        engine.undo(sample)
        if isinstance(error, openmm.OpenMMException) and not isinstance(error, TrajectoryError):
            raise openmm.OpenMMException(
                f"Step {engine.clock.steps + 1} could not try a volume of {move.factor**3 * volume:.4f} nm^3: "
                f"{error} A larger box or a shorter cut-off would help. The Context is left at the last completed step"
            ) from error
        raise
    probability = move.probability(gain, pressure, volume, GAS_CONSTANT * temperature)
    if move.is_accepted(probability):
        engine.add_heat(gain)
    else:
        engine.go_back(sample)
    engine.draws += 1
    record[SIZE], record[MOVES], record[ACCEPTED_MOVES] = size.after(probability)


def _move_size(engine: Engine, record: Record) -> MoveSize:
    """Return the size of the next move, by what is noted of the earlier ones."""
    if not record[SIZE]:
        return MoveSize.first(engine.movers.centres.count)
    return MoveSize(record[SIZE], int(record[MOVES]), record[ACCEPTED_MOVES])
