"""Write a step as commands and calls: the third table from the operations of a plan.

Forces are computed between launches. Everything that movers do between two forces is one launch. Movers on which no
fast force acts have no inner steps, and do all that comes between two slow forces in the first launch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.plan import (
    FAST,
    Bath,
    Drift,
    Energy,
    Inner,
    Kick,
    Operation,
    Project,
    UpdateContext,
    expanded,
)
from openmm_sier.dynamics.stages import DRIFT_FROM_BATH, DRIFT_TO_BATH
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck, decay
from openmm_sier.engines.compiled.movers import (
    BATHE,
    COUNT_AFTER,
    COUNT_BEFORE,
    DISPLACE,
    DRIFT,
    FROM_BATH,
    KICK,
    KICK_FROM_THERE,
    PROJECT,
    TO_BATH,
    Call,
)

#: What an epoch begins with: nothing, OpenMM's own updates, the slow forces, or these and all energies.
NOTHING, UPDATES, FORCES, ENERGY = "nothing", "updates", "forces", "energy"


@dataclass(frozen=True)
class Epoch:
    """What happens until the slow forces are needed at other positions.

    Attributes:
        begins_with: one of the above.
        others: calls of movers without fast forces.
        parts: calls of members, with other fast forces before each part but the first.
    """

    begins_with: str
    others: list[Call] = field(default_factory=list)
    parts: list[list[Call]] = field(default_factory=lambda: [[]])

    @property
    def moves(self) -> bool:
        """Return whether it changes positions."""
        return any(call.moves for calls in (self.others, *self.parts) for call in calls)


@dataclass(frozen=True)
class Time:
    """A scalar: a factor times a power of the step."""

    factor: float
    power: int = 1

    size = 1

    def values(self, step: float, bath: OrnsteinUhlenbeck | None) -> list[float]:
        return [self.factor * step**self.power]


@dataclass(frozen=True)
class BathTime:
    """Scalars of a bath: factor of momenta and width of their noise, and those of angular momenta.

    Attributes:
        fraction: its time as a fraction of the step.
    """

    fraction: float

    size = 4

    def values(self, step: float, bath: OrnsteinUhlenbeck | None) -> list[float]:
        frictions = None if bath is None else bath.shared_frictions
        if bath is None or frictions is None:
            return [1.0, 0.0, 1.0, 0.0]
        root = np.sqrt(GAS_CONSTANT * bath.temperature)
        damping, width = decay(frictions[0], self.fraction * step)
        rotational_damping, rotational_width = decay(frictions[1], self.fraction * step)
        return [damping, root * width, rotational_damping, root * rotational_width]


class Scalars:
    """The numbers of kernels that depend on settings."""

    def __init__(self) -> None:
        self._places: dict[Time | BathTime, int] = {}
        self._size = 0

    def place(self, scalar: Time | BathTime) -> int:
        """Return the place of a scalar, or of the first of several, which is added unless it is there."""
        if scalar not in self._places:
            self._places[scalar] = self._size
            self._size += scalar.size
        return self._places[scalar]

    def values(self, method: IntegrationMethod) -> np.ndarray:
        """Return all values for the settings of a method; there is at least one."""
        values = [value for scalar in self._places for value in scalar.values(method.step, method.bath)]
        return np.array(values or [0.0])


@dataclass(frozen=True)
class StepWriter:
    """Writer of the epochs of a step.

    Attributes:
        counts_heat: whether the heat of OpenMM's own updates is counted.
        epochs: so far.
        scalars: of all calls.
    """

    counts_heat: bool
    epochs: list[Epoch] = field(default_factory=lambda: [Epoch(NOTHING)])
    scalars: Scalars = field(default_factory=Scalars)

    def write(self, operations: Iterable[Operation], unit: float = 1.0, members_only: bool = False) -> None:
        """Write operations.

        Args:
            operations: in order.
            unit: that of their fractions, as a fraction of the step.
            members_only: whether they are those of inner steps.

        Raises:
            ValueError: an operation is not in the table.
        """
        for operation in expanded(operations):
            if type(operation) not in CALLS:
                raise ValueError(f"kernels cannot execute the operation '{operation}'")
            CALLS[type(operation)](self, operation, unit, members_only)

    # --- where calls belong ---

    def _add(self, kind: str, scalars: tuple[int, ...] = (), members_only: bool = False) -> None:
        epoch, call = self.epochs[-1], Call(kind, scalars)
        epoch.parts[-1].append(call)
        if not members_only:
            epoch.others.append(call)

    def _begin(self, what: str) -> None:
        self.epochs.append(Epoch(what))

    def _have_slow_forces(self) -> bool:
        """Return whether the slow forces of the present positions are at hand."""
        epoch = self.epochs[-1]
        return epoch.begins_with in (FORCES, ENERGY) and not epoch.moves and len(epoch.parts) == 1

    def _have_fast_forces(self) -> bool:
        """Return whether the fast forces of the present positions are at hand."""
        parts = self.epochs[-1].parts
        return len(parts) > 1 and not any(call.moves for call in parts[-1])

    # --- operations ---

    def _update(self, operation: UpdateContext, unit: float, members_only: bool) -> None:
        if self.counts_heat:
            self._add(COUNT_BEFORE)
        self._begin(UPDATES)
        if self.counts_heat:
            self._add(COUNT_AFTER)

    def _need_forces(self, operation: Kick) -> None:
        """Let the forces of a kick be computed where the last ones are not these."""
        if operation.forces == FAST:
            if not self._have_fast_forces():
                self.epochs[-1].parts.append([])
        elif not self._have_slow_forces():
            self._begin(FORCES)

    def _energy(self, operation: Energy, unit: float, members_only: bool) -> None:
        self._begin(ENERGY)

    def _kick(self, operation: Kick, unit: float, members_only: bool) -> None:
        self._need_forces(operation)
        time = self.scalars.place(Time(operation.fraction * unit))
        if not operation.shift:
            self._add(KICK, (time,), members_only)
            return
        shift = self.scalars.place(Time(operation.shift * unit**2, power=2))
        self._add(DISPLACE, (shift,), members_only)
        self._need_forces(operation)
        self._add(KICK_FROM_THERE, (time,), members_only)

    def _drift(self, operation: Drift, unit: float, members_only: bool) -> None:
        kind = {DRIFT_TO_BATH: TO_BATH, DRIFT_FROM_BATH: FROM_BATH}.get(operation.side, DRIFT)
        fraction = operation.fraction * unit
        steps = operation.weights if len(operation.weights) > 1 else ()
        times = [fraction, *(fraction * weight for weight in steps)]
        self._add(kind, tuple(self.scalars.place(Time(time)) for time in times), members_only)

    def _inner(self, operation: Inner, unit: float, members_only: bool) -> None:
        self.epochs[-1].others.append(Call(DRIFT, (self.scalars.place(Time(operation.fraction)),)))
        self.write(operation.operations, operation.whole / operation.number, members_only=True)

    def _bathe(self, operation: Bath, unit: float, members_only: bool) -> None:
        self._add(BATHE, (self.scalars.place(BathTime(operation.fraction)),))

    def _project(self, operation: Project, unit: float, members_only: bool) -> None:
        self._add(PROJECT)


#: Functions that write an operation, by its class.
CALLS: dict[type[Operation], Callable[[StepWriter, Any, float, bool], None]] = {
    UpdateContext: StepWriter._update,
    Kick: StepWriter._kick,
    Drift: StepWriter._drift,
    Inner: StepWriter._inner,
    Bath: StepWriter._bathe,
    Project: StepWriter._project,
    Energy: StepWriter._energy,
}
