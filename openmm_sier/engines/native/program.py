"""A splitting scheme written out as the program of an OpenMM CustomIntegrator.

The program runs where the forces run. `write` makes it from the plan of a `Scheme` and `installation.install` gives it
to an integrator; `print(write(SIER4G, rattle_steps=5))` shows it.

OpenMM moves virtual sites at the end of an integrator's step, but on the CPU and Reference platforms not within it.
Where a System may have virtual sites, a step of the scheme is therefore divided into several steps of OpenMM, here
called native steps, each of which computes forces at the positions that it starts from and nowhere else. All are h/n
long, so that OpenMM's clock is right after every n of them. A step is divided, too, where positions must be looked at
before each force.

What a step costs on a GPU is the kernels that it launches and the memory that these move. So a program has no
computation of a global variable unless its step is divided (OpenMM uploads all of them after each), takes the slow
forces by the name of their group where they have one of their own, and counts the heat of a bath only where it is asked
to, since that takes four more projections of the velocities.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from typing import Any

from openmm_sier.dynamics.constraints.geodesic import SUZUKI, TRIPLE_JUMP
from openmm_sier.dynamics.integration_method import FEWEST_WITH_BATH
from openmm_sier.dynamics.plan import (
    Bath,
    Drift,
    Inner,
    Kick,
    Operation,
    Project,
    Repeat,
    Resolution,
    UpdateContext,
    expanded,
    plan_step,
)
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.stages import BATH, DRIFT, DRIFT_TO_BATH
from openmm_sier.dynamics.thermostat import Thermostat
from openmm_sier.engines.program import (
    ALL_GROUPS,
    CONSTRAIN_V,
    CONSTRAIN_X,
    KEPT,
    UPDATE,
    V0,
    WORK,
    ForceTerm,
    Line,
    Program,
    Statement,
)
from openmm_sier.engines.variables import PREFIX

#: Global variables for the bath's friction (1/ps) and thermal energy (kJ/mol).
FRICTION, THERMAL = (PREFIX + name for name in ("friction", "kT"))

#: OpenMM looks at every path through the if-blocks of a program, of which there are 2^parts.
MOST_PARTS = 12

#: RATTLE steps, as fractions of a drift, that make the drift fourth order. Five are 80 times as accurate as three.
COMPOSITIONS = {3: TRIPLE_JUMP, 5: SUZUKI}

#: Usual steps of RATTLE in each drift of an inner step.
USUAL_IN_INNER_STEPS = 3

#: A drift longer than this many times the simulated time per force takes five RATTLE steps.
LONG_DRIFT = 2.0

#: The condition of a block that is never executed: no native step has such a number.
NEVER = -9


#: Counts the kinetic energy gained since velocities were kept.
GAINED = Statement(WORK, f"{WORK} + 0.5*m*(v*v - {V0}*{V0})")

#: Count the kinetic energy gained from the first to the second, without keeping velocities.
BEFORE, AFTER = (Statement(WORK, f"{WORK} {sign} 0.5*m*v*v") for sign in "-+")

#: The force that moves the atoms, as a sum of OpenMM's forces.
Force = list[ForceTerm]


def usual_rattle_steps(scheme: Scheme) -> int:
    """Return the least number of steps of RATTLE in a drift whose errors are below those of the scheme at usual steps.

    SIER2, SIER4G and SIER4P have drifts of up to 1.6 times the simulated time per force, for which three suffice. SIER4
    and SIER4V have drifts of 2.4 and 2.8 times it. Beside a bath one step of 9 fs, which has the bath in its middle,
    has the exact averages of water within 0.1 %.
    """
    if scheme.bath_divides_drift:
        return 1
    return 5 if scheme.longest_drift * scheme.force_evaluations > LONG_DRIFT else 3


def write(
    scheme: Scheme,
    rattle_steps: int | None = None,
    fast_groups: Collection[int] = (),
    inner_step: float | None = None,
    updates_context: bool = True,
    bath: Thermostat | None = None,
    slow_group: int | None = None,
    divides_step: bool = True,
    counts_heat: bool = True,
) -> Program:
    """Write the program of a scheme.

    Without fast groups all forces are in the kicks, and the drift is free motion. With them the forces of these groups
    move from the kicks into the drift, see `dynamics.plan`. With a bath in the middle of the drift, the drift is an odd
    number of steps of RATTLE with the bath in the middle of one, with or without fast forces.

    Velocities are constrained where they are read, before a bath and at the end of the step, and not after every stage:
    what they have along the constraints changes no position that is constrained next, since the constraint forces take
    it up. Only forces at displaced positions are constrained where they act. A step with a bath in its middle whose
    heat is not counted leaves its end to the engine, which constrains velocities once after a call of `step`;
    trajectories then depend by rounding on how steps are divided into calls.

    Args:
        scheme: what to execute; its operators are kicks, gradient kicks, drifts and baths.
        rattle_steps: in each drift or, with fast groups, in each drift of an inner step: 3 and 5 make it fourth order
            (`COMPOSITIONS`), other numbers are equal steps. Beside a bath in the middle of a drift steps are always
            equal, and the one that has the bath in its middle is counted on both sides; with fast groups there is one
            in each inner step. None: `usual_rattle_steps`, and `USUAL_IN_INNER_STEPS` with fast groups.
        fast_groups: force groups of the fast forces, which must act on atoms alone, see `refusals.refuse_fast_forces`.
        inner_step: longest inner step as a fraction of the step; None: one in each drift, three around a bath.
        updates_context: whether OpenMM's barostats and CMMotionRemovers act before each step. What a remover takes is
            counted as heat, unless that of a bath is not.
        bath: executes the scheme's bath, with whatever temperature and friction it is given later.
        slow_group: the only force group of the slow forces; None: the sum of all forces less the fast ones.
        divides_step: whether a native step ends before each force at positions that changed, as in a System that may
            have virtual sites. Otherwise one native step is enough.
        counts_heat: whether the heat of the bath is counted. It takes projections of the velocities before and after
            the bath; the trajectory is the same without them, to rounding.

    Raises:
        ValueError: the scheme has another operator, or a bath that nothing executes, or needs more than `MOST_PARTS`
            native steps.
    """
    fast = [ForceTerm(f"f{group}") for group in sorted(fast_groups)]
    counts_heat = counts_heat or BATH not in scheme.operators
    if fast:
        resolution = _resolution(scheme, rattle_steps or USUAL_IN_INNER_STEPS)
        inner_step = inner_step or (1 / FEWEST_WITH_BATH if scheme.bath_divides_drift else scheme.longest_drift)
    else:
        resolution, inner_step = _resolution(scheme, rattle_steps or usual_rattle_steps(scheme)), None
    plan = plan_step(scheme, inner_step, resolution, updates_context)
    statements = Statements(_slow_forces(fast, slow_group), fast, bath, scheme.bath_divides_drift, counts_heat)
    lines = statements.of(plan.operations)
    parts = _divided(lines) if divides_step else (tuple(lines),)
    if len(parts) > MOST_PARTS:
        raise ValueError(f"the scheme {scheme.name} takes {len(parts)} native steps, more than {MOST_PARTS}")
    return Program(
        scheme.name,
        parts,
        inner_fraction=plan.longest_inner_step,
        counts_heat=counts_heat,
        ends_constrained=statements.ends_constrained,
        slow_group=slow_group,
        momentum_lag=scheme.momentum_lag,
        fast_groups=tuple(sorted(fast_groups)),
    )


def _resolution(scheme: Scheme, rattle_steps: int) -> Resolution:
    """Return how drifts are divided into steps of RATTLE; see `write`."""
    weights = COMPOSITIONS.get(rattle_steps, (1 / rattle_steps,) * rattle_steps)
    return Resolution(weights, weights, around_bath=2 * rattle_steps - 1 if scheme.bath_divides_drift else 0)


def _slow_forces(fast: Force, slow_group: int | None) -> Force:
    """Return the sum of all forces less the fast ones, or the force of the only slow group."""
    if slow_group is not None:
        return [ForceTerm(f"f{slow_group}", is_slow=True)]
    return [ForceTerm(ALL_GROUPS, is_slow=True), *(term._replace(sign="-") for term in fast)]


def _leaves_constrained(line: Line) -> bool:
    """Return whether velocities satisfy the constraints after a line."""
    changes = [statement.target for statement, _ in line.executed() if statement.target in ("v", CONSTRAIN_V)]
    return changes[-1:] == [CONSTRAIN_V]


def _divided(lines: list[Line]) -> tuple[tuple[Line, ...], ...]:
    """Return lines by native step; one begins where slow forces are needed at positions that the last one changed."""
    parts: list[list[Line]] = [[]]
    moved = False
    for line in lines:
        if moved and line.needs_slow_force:
            parts.append([])
            moved = False
        parts[-1].append(line)
        moved = moved or line.moves
    return tuple(map(tuple, parts))


# --- statements of operations ---


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
    bath: Thermostat | None
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
        if self.bath_divides_drift:
            return [_bath_in_drift(velocity, keeps=bool(self.fast))]
        return [_bath(velocity, self.counts_heat)]

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


def _bath_in_drift(velocity: str, keeps: bool) -> Line:
    """Write a bath in the middle of a drift; `keeps` keeps velocities after it as `V0`, for temperatures."""
    return Line("bath", (Statement("v", velocity), *([Statement(V0, "v")] if keeps else [])))


def _bath(velocity: str, counts_heat: bool) -> Line:
    """Write a bath. Where its heat is counted, velocities are constrained before and after it.

    Otherwise the drift that follows takes away what they have along the constraints.
    """
    drawn = Statement("v", velocity)
    if not counts_heat:
        return Line("bath", (drawn,))
    return Line("bath", (Statement(CONSTRAIN_V), Statement(V0, "v"), drawn, Statement(CONSTRAIN_V), GAINED))
