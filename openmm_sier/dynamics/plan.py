"""A step as a list of operations, written once for all engines.

A `Scheme` has the order and the fractions of its stages. A plan adds all that a System needs: inner steps, by which
fast forces move bodies within drifts, steps of RATTLE, and the place at which OpenMM's own updates act. Engines execute
a plan by a table from the class of an operation to a function, or to statements of a program. `str(plan)` reads as the
algorithm.

Let the step be h. Fractions of operations are those of h and, within `Inner`, those of the inner step e.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

from openmm_sier.dynamics.constraints.geodesic import SUZUKI, TRIPLE_JUMP
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.stages import BATH, DRIFT, DRIFT_FROM_BATH, GRADIENT_KICK, KICK, Stage

#: Forces of a kick: those that act between drifts, and the fast ones, which act within them.
SLOW, FAST = "slow", "fast"


@dataclass(frozen=True)
class Operation:
    """One operation of a step.

    Attributes:
        moves_atoms: whether it changes positions, and with them the forces.
    """

    moves_atoms: ClassVar[bool] = False

    def times(self, step: float) -> tuple[float, ...]:
        """Return its time in a step, ps, and other lengths that it has; none where it takes no time."""
        return ()


@dataclass(frozen=True)
class Timed(Operation):
    """An operation that takes time.

    Attributes:
        fraction: its time as a fraction of the step.
    """

    fraction: float

    def times(self, step: float) -> tuple[float, ...]:
        return (self.fraction * step,)


@dataclass(frozen=True)
class Kick(Timed):
    """Momenta change by forces at fixed positions.

    Attributes:
        shift: displacement of the force of a gradient kick, divided by (step)^2 times the acceleration.
        forces: `SLOW` or `FAST`.
    """

    shift: float = 0.0
    forces: str = SLOW

    def times(self, step: float) -> tuple[float, ...]:
        return (self.fraction * step, self.shift * step * step) if self.shift else (self.fraction * step,)

    def __str__(self) -> str:
        displaced = f", displaced by {self.shift:.6g} (step)^2 a" if self.shift else ""
        return f"kick {self.fraction:.6g} by {self.forces} forces{displaced}"


@dataclass(frozen=True)
class Drift(Timed):
    """Free motion, with constraints.

    Attributes:
        weights: steps of RATTLE that follow constraints, as fractions of the drift.
        side: `DRIFT_TO_BATH` or `DRIFT_FROM_BATH` for either half of a drift with a bath in its middle, else `DRIFT`.
    """

    weights: tuple[float, ...] = (1.0,)
    side: str = DRIFT

    moves_atoms: ClassVar[bool] = True

    def __str__(self) -> str:
        steps = f" in {len(self.weights)} steps of RATTLE" if len(self.weights) > 1 else ""
        return f"{self.side} {self.fraction:.6g}{steps}"


@dataclass(frozen=True)
class Bath(Timed):
    """An exact Ornstein-Uhlenbeck process of the momenta, or another heat bath."""

    def __str__(self) -> str:
        return f"bath {self.fraction:.6g}"


@dataclass(frozen=True)
class Inner(Timed):
    """A drift in which fast forces move bodies by inner steps; bodies that no fast force moves drift.

    Attributes:
        fraction: of the drift.
        whole: fraction of the step that `number` inner steps fill.
        number: of inner steps e = whole*h/number.
        operations: in units of the inner step.
        drift: of the bodies that no fast force moves.
    """

    whole: float
    number: int
    operations: tuple[Operation, ...]
    drift: Drift

    moves_atoms: ClassVar[bool] = True

    def inner_step(self, step: float) -> float:
        """Return the length of an inner step, ps."""
        return self.whole * step / self.number

    def __str__(self) -> str:
        lines = "".join(f"\n    {line}" for each in self.operations for line in str(each).splitlines())
        return f"{self.drift.side} {self.fraction:.6g}, by inner steps e = {self.whole:.6g}/{self.number} h:{lines}"


@dataclass(frozen=True)
class Repeat(Operation):
    """Operations that are repeated."""

    number: int
    operations: tuple[Operation, ...]

    @property
    def moves_atoms(self) -> bool:  # type: ignore[override]
        return any(operation.moves_atoms for operation in self.operations)

    def __str__(self) -> str:
        lines = "".join(f"\n    {line}" for each in self.operations for line in str(each).splitlines())
        return f"{self.number} times:{lines}"


@dataclass(frozen=True)
class UpdateContext(Operation):
    """OpenMM's barostats, AndersenThermostat and CMMotionRemovers act."""

    def __str__(self) -> str:
        return "update context state"


@dataclass(frozen=True)
class Project(Operation):
    """Momenta lose the components along constraints."""

    def __str__(self) -> str:
        return "project momenta"


@dataclass(frozen=True)
class Energy(Operation):
    """The potential energy becomes known, with the slow forces of the same positions."""

    def __str__(self) -> str:
        return "energy, with the slow forces"


@dataclass(frozen=True)
class Plan:
    """A step as a list of operations.

    Attributes:
        name: of the scheme.
        operations: in order.
    """

    name: str
    operations: tuple[Operation, ...]

    @property
    def longest_inner_step(self) -> float:
        """The longest inner step as a fraction of the step; 1 where there are none."""
        lengths = [abs(each.whole) / each.number for each in self.operations if isinstance(each, Inner)]
        return max(lengths, default=1.0)

    def with_energy(self) -> Plan:
        """Return the plan of a step of whose end the energy is wanted.

        It is computed with the last forces, if these are those of the end.
        """
        last = max((i for i, operation in enumerate(self.operations) if operation.moves_atoms), default=-1) + 1
        before, after = self.operations[:last], self.operations[last:]
        if not any(isinstance(operation, Kick) for operation in after):
            return self
        return replace(self, operations=(*before, Energy(), *after))

    def __str__(self) -> str:
        return "\n".join([f"{self.name}, a step h:", *map(str, self.operations)])


def expanded(operations: Iterable[Operation]) -> Iterator[Operation]:
    """Return operations with those that are repeated one after the other."""
    for operation in operations:
        if isinstance(operation, Repeat):
            yield from list(expanded(operation.operations)) * operation.number
        else:
            yield operation


@dataclass(frozen=True)
class Resolution:
    """Choices of an engine for drifts.

    Attributes:
        weights: steps of RATTLE in a drift, as fractions of it. Free motion needs no forces, so that its error can be
            far below that of any scheme.
        inner_weights: the same in drifts of inner steps, except beside a bath.
        around_bath: number of equal steps of RATTLE in a drift with a bath in its middle, which is odd: one of them has
            the bath in its middle. 0 takes `weights` on both sides of the bath.
    """

    weights: tuple[float, ...] = SUZUKI
    inner_weights: tuple[float, ...] = TRIPLE_JUMP
    around_bath: int = 0


def plan_step(
    scheme: Scheme,
    longest_inner_step: float | None = None,
    resolution: Resolution | None = None,
    updates: bool = True,
    projects: bool = True,
) -> Plan:
    """Return the plan of a scheme.

    With fast forces each drift is motion under these by the least number of equal inner steps of SIER4G: one follows
    springs of 1100/cm in a drift of 3 fs as well as twenty steps of velocity Verlet. The outer scheme then splits off
    the slow forces alone, H = (T + V_fast) + V_slow. Both flows are symmetric, and the composite has the order of the
    outer scheme if the inner steps have it and are proportional to the outer ones. A gradient kick is unchanged: its
    bracket [V_slow, [T + V_fast, V_slow]] has no term from V_fast, which commutes with V_slow.

    Energy error of two free chains of three CH2 (constrained C-H, springs up to 1100/cm), in drifts of 3 fs over 1.2 ps
    at 300 K:

    | inner scheme, steps a drift | fast forces | rms(H), kJ/mol |
    |---|---|---|
    | SIER2, 2, 4, 8 or 12 | 2, 4, 8 or 12 | 0.11, 0.027, 0.0065, 0.0029 |
    | SIER4, 1 or 2 | 4 or 8 | 0.0016, 0.0001 |
    | SIER4G, 1 or 2 | 3 or 6 | 0.0013, 0.0001 |
    | the same with plain RATTLE | 3 or 6 | 0.0018, 0.0005, and drifts by 0.0012, 0.0003 /ps |

    Where a bath divides a drift, the drift is an odd number of equal steps, each a whole kick and a drift, with the
    bath in the middle of one. So harmonic motion under fast forces has the right averages at the end of the step,
    however long the inner steps are. With a bath between steps of velocity Verlet the variance of the positions of a
    mode would be too large by a share (omega h)^2/4: 12 % for a bond of 19 fs and steps of 2 fs. Momenta at the end lag
    behind by half an inner kick of the fast forces, and by half a kick of the others.

    Args:
        scheme: the scheme.
        longest_inner_step: upper bound of inner steps, as a fraction of the step; None without fast forces.
        resolution: how drifts are divided.
        updates: whether `UpdateContext` comes first.
        projects: whether `Project` comes last.

    Raises:
        ValueError: a stage has no operation, or the bound of inner steps is not positive.
    """
    if longest_inner_step is not None and not longest_inner_step > 0:
        raise ValueError(f"the longest inner step must be positive, got {longest_inner_step}")
    writer = _Writer(scheme, longest_inner_step, resolution or Resolution())
    operations = [writer.operation_of(stage) for stage in scheme.stages]
    first = [UpdateContext()] if updates else []
    last = [Project()] if projects else []
    return Plan(scheme.name, (*first, *operations, *last))


@dataclass(frozen=True)
class _Writer:
    """Writer of the operations of stages."""

    scheme: Scheme
    longest: float | None
    resolution: Resolution

    def operation_of(self, stage: Stage) -> Operation:
        """Return the operation of a stage."""
        if stage.flow == DRIFT:
            return self._drift(stage)
        return operation_of(stage)

    def _drift(self, stage: Stage) -> Operation:
        """Return a drift, by inner steps where there are fast forces."""
        drift = Drift(stage.fraction, self.resolution.weights, stage.operator)
        if stage.operator != DRIFT:
            return self._beside_bath(drift)
        if self.longest is None:
            return drift
        number = inner_steps(stage.fraction, self.longest)
        weights = self.resolution.inner_weights
        step = tuple(
            Drift(each.fraction, weights) if each.flow == DRIFT else operation_of(each, FAST)
            for each in self.scheme.within_drifts.stages
        )
        return Inner(stage.fraction, stage.fraction, number, _repeated(number, step), drift)

    def _beside_bath(self, drift: Drift) -> Operation:
        """Return the part of a drift on one side of a bath in its middle: half a step, and whole ones.

        On the side to the bath these are (kick e, drift e) n/2 times, kick e, drift e/2.
        """
        kick: tuple[Operation, ...] = ()
        if self.longest is not None:
            number, kick = steps_with_bath(2 * drift.fraction, self.longest), (Kick(1.0, 0.0, FAST),)
        elif self.resolution.around_bath:
            number = self.resolution.around_bath
        else:
            return drift
        half = Drift(0.5, (1.0,), drift.side)
        if number == 1 and not kick:
            return Drift(drift.fraction, (1.0,), drift.side)
        whole = _repeated(number // 2, (*kick, Drift(1.0)))
        operations = (half, *whole) if drift.side == DRIFT_FROM_BATH else (*whole, *kick, half)
        return Inner(drift.fraction, 2 * drift.fraction, number, operations, drift)


def _repeated(number: int, operations: tuple[Operation, ...]) -> tuple[Operation, ...]:
    """Return operations that are repeated a number of times, which may be 0."""
    if number < 2:
        return operations * number
    return (Repeat(number, operations),)


def operation_of(stage: Stage, forces: str = SLOW) -> Operation:
    """Return the operation of a stage that is no drift.

    Raises:
        ValueError: there is none.
    """
    if stage.operator in (KICK, GRADIENT_KICK):
        return Kick(stage.fraction, stage.shift, forces)
    if stage.operator == BATH:
        return Bath(stage.fraction)
    raise ValueError(f"nothing executes the operator '{stage.operator}'")


def inner_steps(drift: float, longest: float) -> int:
    """Return the number of inner steps into which a drift is divided, the same for both directions of time."""
    return max(1, math.ceil(abs(drift) / longest * (1 - 1e-12)))


def steps_with_bath(drift: float, longest: float) -> int:
    """Return the number of inner steps with a bath in the middle of one, which is odd."""
    return 2 * (inner_steps(drift, longest) // 2) + 1
