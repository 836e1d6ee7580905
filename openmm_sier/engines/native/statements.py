"""The statements of each operation of a plan, in the syntax of OpenMM's CustomIntegrator."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from openmm_sier.dynamics.plan import Bath, Drift, Inner, Kick, Operation, Project, Repeat, UpdateContext, expanded
from openmm_sier.dynamics.stages import DRIFT, DRIFT_TO_BATH
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck
from openmm_sier.engines.program import CONSTRAIN_V, CONSTRAIN_X, KEPT, UPDATE, V0, WORK, ForceTerm, Line, Statement
from openmm_sier.engines.variables import PREFIX

#: Global variables for the bath's friction (1/ps) and thermal energy (kJ/mol).
FRICTION, THERMAL = (PREFIX + name for name in ("friction", "kT"))

#: Counts the kinetic energy gained since velocities were kept.
GAINED = Statement(WORK, f"{WORK} + 0.5*m*(v*v - {V0}*{V0})")

#: Count the kinetic energy gained from the first to the second, without keeping velocities.
BEFORE, AFTER = (Statement(WORK, f"{WORK} {sign} 0.5*m*v*v") for sign in "-+")

#: The force that moves the atoms, as a sum of OpenMM's forces.
Force = list[ForceTerm]


@dataclass(frozen=True)
class Statements:
    """The statements of each operation of a plan.

    Attributes:
        slow, fast: the forces of kicks.
        bath: executes `Bath`; None where nothing does.
        bath_divides_drift: whether a bath is in the middle of a drift.
        counts_heat: whether heat is counted.
    """

    slow: Force
    fast: Force
    bath: OrnsteinUhlenbeck | None
    bath_divides_drift: bool
    counts_heat: bool

    @property
    def ends_constrained(self) -> bool:
        """Whether velocities are constrained at the end of a step."""
        return self.counts_heat or not self.bath_divides_drift

    def of(self, operations: Iterable[Operation], step: str = "h") -> list[Line]:
        """Return the lines of operations of a step that expressions call `step`.

        Raises:
            ValueError: OpenMM cannot execute an operation.
        """
        lines: list[Line] = []
        for operation in operations:
            if isinstance(operation, Project):
                lines += self._projection(lines)
            elif type(operation) in STATEMENTS:
                lines += STATEMENTS[type(operation)](self, operation, step)
            else:
                raise ValueError(f"OpenMM cannot execute the operation '{operation}' in a CustomIntegrator")
        return lines

    def _update(self, operation: UpdateContext, step: str) -> list[Line]:
        """Let OpenMM's barostats and CMMotionRemovers act."""
        update = (Statement(V0, "v"), Statement(UPDATE), GAINED) if self.counts_heat else (Statement(UPDATE),)
        return [Line("every step", update)]

    def _kick(self, operation: Kick, step: str) -> list[Line]:
        force = getattr(self, operation.forces)
        time = f"{operation.fraction!r}*{step}"
        if operation.shift:
            return _gradient_kick(time, f"{operation.shift!r}*{step}*{step}", force)
        return [Line("kick", tuple(_summed("v", "v", f"{time}*", force)))]

    def _drift(self, operation: Drift, step: str) -> list[Line]:
        """Write out free motion by steps of RATTLE (Andersen, J. Comput. Phys. 52, 24 (1983)).

        Constraints move the positions, and the velocities are corrected for this displacement. It is the difference to
        where the atoms would be without, so that rounded positions do not change the velocities of free atoms.
        """
        if operation.side == DRIFT:
            statements = _constrained_motion("x", "d")
        elif operation.side == DRIFT_TO_BATH:
            statements = _half_drift_to_bath(self.counts_heat)
        else:
            statements = _half_drift_from_bath(self.counts_heat)
        lengths = tuple(operation.fraction * weight for weight in operation.weights)
        return [Line(operation.side, statements, lengths, f"d/{step}")]

    def _inner(self, operation: Inner, step: str) -> list[Line]:
        """Write inner steps, all alike or, beside a bath, one after the other."""
        length, operations, times = operation.whole / operation.number, operation.operations, 1
        if len(operations) == 1 and isinstance(operations[0], Repeat):
            times, operations = operations[0].number, operations[0].operations
        inner = tuple(self.of(expanded(operations), "e"))
        return [Line(f"{operation.drift.side}, inner steps", (), (length,) * times, f"e/{step}", inner)]

    def _bathe(self, operation: Bath, step: str) -> list[Line]:
        if self.bath is None:
            raise ValueError(f"OpenMM cannot execute the operation '{operation}' in a CustomIntegrator")
        velocity = self.bath.velocity(f"{operation.fraction!r}*{step}", FRICTION, THERMAL)
        drawn = Statement("v", velocity)
        if self.bath_divides_drift:
            # Temperatures are those of the velocities after it.
            return [Line("bath", (drawn, Statement(V0, "v")) if self.fast else (drawn,))]
        if not self.counts_heat:
            # The drift that follows takes away what velocities have along the constraints.
            return [Line("bath", (drawn,))]
        constrain = Statement(CONSTRAIN_V)
        return [Line("bath", (constrain, Statement(V0, "v"), drawn, constrain, GAINED))]

    def _projection(self, lines: list[Line]) -> list[Line]:
        """Constrain velocities, unless the lines before have done so or the engine will."""
        if not self.ends_constrained or (lines and _leaves_constrained(lines[-1])):
            return []
        return [Line("end", (Statement(CONSTRAIN_V),))]


#: Functions that write an operation, by its class.
STATEMENTS: dict[type[Operation], Callable[[Statements, Any, str], list[Line]]] = {
    UpdateContext: Statements._update,
    Kick: Statements._kick,
    Drift: Statements._drift,
    Inner: Statements._inner,
    Bath: Statements._bathe,
}


def _half_drift_to_bath(counts_heat: bool) -> tuple[Statement, ...]:
    """Write free motion for half a RATTLE step; `_half_drift_from_bath` constrains the positions.

    Velocities are constrained first. What they have along the constraints would move atoms here, and the bath would
    change it before the second half corrects the velocities for that.

    Positions change only in the second half: OpenMM computes what follows such a change in another kernel.
    """
    return Statement(CONSTRAIN_V), *((BEFORE,) if counts_heat else ()), Statement(KEPT, "x + d*v")


def _half_drift_from_bath(counts_heat: bool) -> tuple[Statement, ...]:
    """Write free motion for the second half of a RATTLE step, and bring positions back onto the constraints.

    Velocities are corrected for this displacement over the whole step, as OpenMM's LangevinMiddleIntegrator does, so
    that one solution of the constraints is enough for both halves. Half of the noise along the constraints is left, and
    is taken away where velocities are constrained next.
    """
    after = (Statement(CONSTRAIN_V), AFTER) if counts_heat else ()
    return *_constrained_motion(KEPT, "(2*d)"), *after


def _constrained_motion(start: str, time: str) -> tuple[Statement, ...]:
    """Write free motion from a start for a time d, constraints, and the velocities that these change over a time."""
    return (
        Statement(KEPT, f"{start} + d*v"),
        Statement("x", KEPT),
        Statement(CONSTRAIN_X),
        Statement("v", f"v + (x - {KEPT})/{time}"),
    )


def _summed(target: str, start: str, time: str, force: Force) -> list[Statement]:
    """Write `target = start + time*f/m`, one statement for each group: OpenMM allows only one in an expression."""
    statements = []
    for term in force:
        before = f"{start} {term.sign} " if start else term.sign.strip("+")
        statements.append(Statement(target, f"{before}{time}{term.name}/m", term))
        start = target
    return statements


def _gradient_kick(time: str, shift: str, force: Force) -> list[Line]:
    """Write out a kick by the forces at positions displaced by the accelerations, under the constraints.

    OpenMM's constraints act along the directions of the last positions that satisfied them. So positions are
    constrained again after they are moved back, which changes nothing but those directions. The displacement is kept
    rather than the positions, since GPU platforms may carry a molecule to the other side of the box between two native
    steps.
    """
    *others, last = force
    acceleration = f"({V0} {last.sign} {last.name}/m)" if others else f"{last.name}/m"
    displace = (
        *_summed(V0, "", "", others),
        Statement(KEPT, "x"),
        Statement("x", f"x + {shift}*{acceleration}", last),
        Statement(CONSTRAIN_X),
        Statement(KEPT, f"x - {KEPT}"),
    )
    kick = (
        Statement(V0, "v"),
        *_summed("v", "", "", force),
        Statement(CONSTRAIN_V),
        Statement("x", f"x - {KEPT}"),
        Statement(CONSTRAIN_X),
        Statement("v", f"{V0} + {time}*v"),
    )
    return [Line("displace", displace), Line("kick from there", kick)]


def _leaves_constrained(line: Line) -> bool:
    """Return whether velocities satisfy the constraints after a line."""
    changes = [statement.target for statement, _ in line.executed() if statement.target in ("v", CONSTRAIN_V)]
    return changes[-1:] == [CONSTRAIN_V]
