"""Describe what OpenMM executes of an integrator: the computations of a CustomIntegrator, line by line."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from openmm_sier.engines.variables import PREFIX

#: Targets of statements without an expression, each of which is one of OpenMM's own computations.
CONSTRAIN_X, CONSTRAIN_V, UPDATE = "constrain x", "constrain v", "update context state"

#: The force of all groups, in OpenMM's syntax.
ALL_GROUPS = "f"

#: Per-atom variables of programs. They hold positions or a displacement to be undone, velocities to return to (after a
#: step with one bath in its middle those just after the bath), and the heat that the bath, and removers of the motion
#: of the centre of mass, gave to each degree of freedom.
KEPT, V0, WORK = (PREFIX + name for name in ("kept", "v0", "work"))
VECTORS = (KEPT, V0, WORK)

#: Per-atom variables of trials: positions and velocities of the start.
START_X, START_V = (PREFIX + name for name in ("start_x", "start_v"))
TRIAL_VECTORS = (START_X, START_V)


class ForceTerm(NamedTuple):
    """One of OpenMM's forces, as a term of the force that moves the atoms.

    Attributes:
        name: `ALL_GROUPS`, or the force of one group, such as `f0`.
        sign: of the term.
        is_slow: whether it has slow forces, which may act on virtual sites and between all atoms. Fast forces are
            bonded and act on atoms alone.
    """

    name: str
    sign: str = "+"
    is_slow: bool = False


class Statement(NamedTuple):
    """One computation.

    Attributes:
        target: the per-atom variable that it sets, or one of `CONSTRAIN_X`, `CONSTRAIN_V`, `UPDATE`.
        expression: of the new value, in OpenMM's syntax; `h` is the step of the scheme, `e` an inner step, `d` a
            step of RATTLE.
        force: in the expression; None without one. OpenMM allows only one.
    """

    target: str
    expression: str = ""
    force: ForceTerm | None = None

    @property
    def moves(self) -> bool:
        """Return whether it changes the forces."""
        return self.target in ("x", CONSTRAIN_X)

    @property
    def needs_slow_force(self) -> bool:
        """Return whether it uses forces that may act on virtual sites, which must then be placed."""
        return self.force is not None and self.force.is_slow

    def __str__(self) -> str:
        return f"{self.target} = {self.expression}".replace(PREFIX, "") if self.expression else self.target


class Line(NamedTuple):
    """Statements that belong together.

    Attributes:
        title: what they do.
        statements: executed one after the other, all of them for each of `lengths`.
        lengths: values of `unit` in their expressions: `d` in units of the line's own step, or `e` in units of h.
        unit: name and unit of the lengths, such as d/h.
        inner: lines that replace the statements: an inner step of length e.
    """

    title: str
    statements: tuple[Statement, ...] = ()
    lengths: tuple[float, ...] = ()
    unit: str = "d/h"
    inner: tuple[Line, ...] = ()

    @property
    def needs_slow_force(self) -> bool:
        """Return whether it needs slow forces; inner lines use fast ones alone."""
        return any(statement.needs_slow_force for statement in self.statements)

    @property
    def moves(self) -> bool:
        return any(statement.moves for statement in self.statements) or any(line.moves for line in self.inner)

    def executed(self, e: float = 1.0) -> Iterator[tuple[Statement, str]]:
        """Return the statements in the order of execution, each with the definitions of d and e, if it has them.

        Args:
            e: length of the inner step that the line belongs to, in units of h.
        """
        for length in self.lengths or (0.0,):
            for line in self.inner:
                yield from line.executed(length)
            for statement in self.statements:
                yield statement, f"; d = {length * e!r}*h; e = {e!r}*h"

    def __str__(self) -> str:
        text = f"{self.title}: {'; '.join(map(str, self.statements))}".removesuffix(": ")
        return f"{text}  for {self.unit} = {', '.join(f'{d:.6g}' for d in self.lengths)}" if self.lengths else text


class Trials(NamedTuple):
    """Trials of hybrid Monte Carlo, each of which is one native step.

    Attributes:
        stopped_mass: mass of the atoms whose centre is stopped after each trial, Da; 0 where it is not.
        checks_constraints: whether ends at which constraints are not satisfied are rejected.
    """

    stopped_mass: float = 0.0
    checks_constraints: bool = True


class Program(NamedTuple):
    """A step of a scheme as native steps.

    Attributes:
        name: of the scheme.
        parts: the lines of each native step.
        refusal: why there are none, for a scheme that OpenMM cannot execute.
        inner_fraction: the longest inner step in units of h; 1 where there are none.
        counts_heat: whether it counts the heat of its bath.
        ends_constrained: whether velocities at the end of a step satisfy the constraints.
        slow_group: the force group that it takes all slow forces from; None: from the sum of all groups.
        momentum_lag: see `Scheme.momentum_lag`.
        fast_groups: the force groups within its drifts.
        trials: the trials that OpenMM executes by this step; None where it executes steps.
    """

    name: str
    parts: tuple[tuple[Line, ...], ...]
    refusal: str = ""
    inner_fraction: float = 1.0
    counts_heat: bool = True
    ends_constrained: bool = True
    slow_group: int | None = None
    momentum_lag: float = 0.0
    fast_groups: tuple[int, ...] = ()
    trials: Trials | None = None

    @property
    def native_steps(self) -> int:
        """Return the number of native steps in a step of the scheme; a trial is one native step."""
        return len(self.parts)

    @property
    def statements(self) -> list[Statement]:
        """Return all statements in the order of execution."""
        return [statement for part in self.parts for line in part for statement, _ in line.executed()]

    @property
    def vectors(self) -> tuple[str, ...]:
        """Return the per-atom variables that the statements set, and read afterwards."""
        targets = {statement.target for statement in self.statements}
        used = tuple(name for name in VECTORS if name in targets)
        return used if self.trials is None else (*used, *TRIAL_VECTORS)

    def __str__(self) -> str:
        n = len(self.parts)
        lines = [f"{self.name}: one step h = {n} native step{'s' if n > 1 else ''} dt"]
        if self.trials is not None:
            lines = [f"{self.name}: one trial of steps h = 1 native step"]
        for k, part in enumerate(self.parts, 1):
            lines += [f"{k if i == 0 else '':>2} {line}" for i, line in enumerate(part)]
        for inner in dict.fromkeys(line.inner for part in self.parts for line in part if line.inner):
            lines += ["an inner step e:", *(f"   {line}" for line in inner)]
        return "\n".join(lines)
