"""Write steps as parts of calls: the third table from the operations of a plan.

Forces are computed between launches. Everything that movers do between two forces is one launch. Kicks at the same
positions commute, so that each force is computed once where the last kick of a drift by inner steps and the first one
of the next have slow forces between them. Movers on which no fast force acts have no inner steps, and do all that comes
between two slow forces in the first launch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from openmm_sier.dynamics.plan import (
    FAST,
    SLOW,
    Bath,
    Drift,
    Energy,
    Inner,
    Kick,
    Operation,
    Plan,
    Project,
    UpdateContext,
    expanded,
)
from openmm_sier.dynamics.stages import DRIFT_FROM_BATH, DRIFT_TO_BATH
from openmm_sier.engines.compiled import step_program
from openmm_sier.engines.compiled.movers import (
    BATHE,
    COUNT_AFTER,
    COUNT_BEFORE,
    DISPLACE,
    DRIFT,
    DRIFTS,
    FROM_BATH,
    KICK,
    KICK_FROM_THERE,
    PROJECT,
    TO_BATH,
    Call,
)
from openmm_sier.engines.compiled.scalars import BathTime, Scalars, Time

#: What a part begins with besides slow or fast forces where the atoms are: nothing, or a command that needs no kernel.
NOTHING, UPDATES, REORDER, RESTORED = "nothing", step_program.UPDATE, step_program.REORDER, step_program.RESTORED

#: Calls of which those beside each other may change places with kicks by forces at the same positions.
COMMUTING = KICK, PROJECT, DISPLACE, KICK_FROM_THERE


@dataclass
class Part:
    """What is done in one launch.

    Attributes:
        begins_with: `SLOW`, `FAST`, or one of the above.
        members: calls of movers on which fast forces act.
        others: calls of all other movers; none after fast forces.
        wants_energy: whether the energy of its forces is wanted, too.
    """

    begins_with: str
    members: list[Call] = field(default_factory=list)
    others: list[Call] = field(default_factory=list)
    wants_energy: bool = False

    @property
    def moves(self) -> bool:
        """Return whether it changes positions."""
        return any(call.moves for call in (*self.members, *self.others))

    @property
    def drifts(self) -> bool:
        """Return whether it changes positions for good."""
        return any(call.kind in DRIFTS for call in (*self.members, *self.others))


class StepWriter:
    """Writer of the parts of steps.

    Attributes:
        parts: so far.
        scalars: of all calls.
    """

    def __init__(self, counts_heat: bool, has_fast: bool, scalars: Scalars) -> None:
        """
        Args:
            counts_heat: whether the heat of OpenMM's own updates is counted.
            has_fast: whether there are fast forces.
            scalars: to which those of all calls are added.
        """
        self.parts = [Part(NOTHING)]
        self.scalars = scalars
        self._counts_heat = counts_heat
        self._has_fast = has_fast
        #: Parts that begin with the forces at the present positions, by these. Kicks are added to them.
        self._known: dict[str, Part] = {}

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

    def _begin(self, what: str) -> Part:
        part = Part(what)
        self.parts.append(part)
        if what == UPDATES:
            self._known = {}
        return part

    def _with_forces(self, forces: str) -> Part:
        """Return the part that begins with forces at the present positions."""
        if forces not in self._known:
            self._known[forces] = self._begin(forces)
        return self._known[forces]

    def _add(self, kind: str, scalars: tuple[int, ...] = (), members_only: bool = False) -> None:
        """Add a call after all others."""
        call = Call(kind, scalars)
        self.parts[-1].members.append(call)
        if not members_only:
            self._last_of_others.others.append(call)
        if kind in DRIFTS:
            self._known = {}
        elif kind not in COMMUTING:
            self._known = {forces: part for forces, part in self._known.items() if part is self.parts[-1]}

    @property
    def _last_of_others(self) -> Part:
        return next(part for part in reversed(self.parts) if part.begins_with != FAST)

    # --- operations ---

    def _update(self, operation: UpdateContext, unit: float, members_only: bool) -> None:
        if self._counts_heat:
            self._add(COUNT_BEFORE)
        self._begin(UPDATES)
        if self._counts_heat:
            self._add(COUNT_AFTER)

    def _energy(self, operation: Energy, unit: float, members_only: bool) -> None:
        if self._has_fast:
            self._with_forces(FAST).wants_energy = True
        self._known[SLOW] = self._begin(SLOW)
        self._known[SLOW].wants_energy = True

    def _kick(self, operation: Kick, unit: float, members_only: bool) -> None:
        time = self.scalars.place(Time(operation.fraction * unit))
        if operation.shift:
            self._kick_from_there(operation, time, unit, members_only)
            return
        part, call = self._with_forces(operation.forces), Call(KICK, (time,))
        part.members.append(call)
        if not members_only:
            part.others.append(call)

    def _kick_from_there(self, operation: Kick, time: int, unit: float, members_only: bool) -> None:
        """Add a gradient kick, after which positions are those of before."""
        if self._with_forces(operation.forces) is not self.parts[-1]:
            self._begin(operation.forces)
        shift = self.scalars.place(Time(operation.shift * unit**2, power=2))
        self._add(DISPLACE, (shift,), members_only)
        del self._known[operation.forces]
        self._begin(operation.forces)
        self._add(KICK_FROM_THERE, (time,), members_only)

    def _drift(self, operation: Drift, unit: float, members_only: bool) -> None:
        kind = {DRIFT_TO_BATH: TO_BATH, DRIFT_FROM_BATH: FROM_BATH}.get(operation.side, DRIFT)
        fraction = operation.fraction * unit
        steps = operation.weights if len(operation.weights) > 1 else ()
        times = [fraction, *(fraction * weight for weight in steps)]
        self._add(kind, tuple(self.scalars.place(Time(time)) for time in times), members_only)

    def _inner(self, operation: Inner, unit: float, members_only: bool) -> None:
        self._last_of_others.others.append(Call(DRIFT, (self.scalars.place(Time(operation.fraction)),)))
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


class Trajectory(NamedTuple):
    """Parts of a trajectory of n steps.

    Attributes:
        first: until the last forces of the first step.
        between: from there to the last forces of the next step, n - 1 times.
        last: the rest, with the energy of the end if its forces are those.
    """

    first: list[Part]
    between: list[Part]
    last: list[Part]


def written_trajectory(plan: Plan, has_fast: bool, scalars: Scalars) -> Trajectory:
    """Return the parts of trajectories of steps, in which the end of a step and the beginning of the next are one.

    Args:
        plan: a step.
        has_fast: whether there are fast forces.
        scalars: to which those of all calls are added.
    """

    def written(*plans: Plan) -> list[Part]:
        writer = StepWriter(False, has_fast, scalars)
        for each in plans:
            writer.write(each.operations)
        return writer.parts

    one, two, with_energy = written(plan), written(plan, plan), written(plan, plan.with_energy())
    start = len(one) - _ending(one)
    period = len(two) - len(one)
    first = one[:start] if one[0].members or one[0].others or start < 2 else one[1:start]
    return Trajectory(first, two[start : start + period], with_energy[-_ending(with_energy) :])


def _ending(parts: Sequence[Part]) -> int:
    """Return the number of parts after the last drift, at least one, to which the next step adds kicks."""
    last = max((number for number, part in enumerate(parts) if part.drifts), default=-1)
    return max(1, len(parts) - 1 - last)
