"""A splitting scheme written out as the program of an OpenMM CustomIntegrator.

The program runs where the forces run, and XML carries it to interpreters without this package. `write` makes it from a
`Scheme` alone and `install` gives it to an integrator; `print(write(SIER4G, substeps=4))` shows it.

OpenMM moves virtual sites at the end of an integrator's step, but on the CPU and Reference platforms not within it
(docs/virtual-sites-report.md). A step of the scheme is therefore divided into several steps of OpenMM, here called
native steps, each of which computes forces at the positions that it starts from and nowhere else. All are h/n long,
so that OpenMM's clock is right after every n of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import openmm

from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.stages import BATH, DRIFT, GRADIENT_KICK, KICK, Stage

#: Targets of statements that assign no expression: each is a computation of OpenMM's.
CONSTRAIN_X, CONSTRAIN_V, UPDATE = "constrain x", "constrain v", "update context state"

#: Names of the integrator's variables begin with this, so that no parameter of a Force is called the same.
PREFIX = "sier_"

#: Per-atom variables of the program: the displacement and the velocities to come back from and to, what is kept for a
#: moment, and the heat that the bath gave to each degree of freedom.
MOVED, V0, KEPT, WORK = (PREFIX + name for name in ("moved", "v0", "kept", "work"))
VECTORS = (MOVED, V0, KEPT, WORK)

#: Global variables: the native step to come, and the bath's friction (1/ps) and thermal energy (kJ/mol).
PART, FRICTION, THERMAL = (PREFIX + name for name in ("part", "friction", "kT"))

#: Global variable: 1 where only the exact engine can do what the integrator was made for.
EXACT_ONLY = PREFIX + "exact_only"

#: OpenMM's message about an illegal variable of this name tells what happened.
LOST = "This_is_a_SIER_integrator__import_openmm_sier_before_it_is_read_from_XML"

#: OpenMM looks at every path through the if-blocks of a program, of which there are 2^parts.
MOST_PARTS = 12


_YOSHIDA = 1 / (2 - 2 ** (1 / 3))
_SUZUKI = 1 / (4 - 4 ** (1 / 3))

#: Steps of RATTLE, as fractions of a drift, that make it of fourth order. Five are 80 times as accurate as three
#: (Yoshida, Phys. Lett. A 150, 262 (1990); Suzuki, Phys. Lett. A 146, 319 (1990)).
COMPOSITIONS = {
    3: (_YOSHIDA, 1 - 2 * _YOSHIDA, _YOSHIDA),
    5: (_SUZUKI, _SUZUKI, 1 - 4 * _SUZUKI, _SUZUKI, _SUZUKI),
}


class Statement(NamedTuple):
    """One computation.

    Attributes:
        target: the per-atom variable that it sets, or one of `CONSTRAIN_X`, `CONSTRAIN_V`, `UPDATE`.
        expression: of the new value, in OpenMM's syntax; `h` is the step of the scheme, `d` a length that its line
            names.
    """

    target: str
    expression: str = ""

    @property
    def moves(self) -> bool:
        """Whether forces change with it."""
        return self.target in ("x", CONSTRAIN_X)

    @property
    def needs_force(self) -> bool:
        return "f/m" in self.expression

    def __str__(self) -> str:
        return f"{self.target} = {self.expression}".replace(PREFIX, "") if self.expression else self.target


class Line(NamedTuple):
    """Statements that belong together.

    Attributes:
        title: of what they do.
        statements: executed one after the other, all of them for each of `lengths`.
        lengths: values of `d` in their expressions, in units of h.
    """

    title: str
    statements: tuple[Statement, ...]
    lengths: tuple[float, ...] = ()

    def __str__(self) -> str:
        text = f"{self.title}: {'; '.join(map(str, self.statements))}"
        return f"{text}  for d/h = {', '.join(f'{d:.6g}' for d in self.lengths)}" if self.lengths else text


@dataclass(frozen=True)
class Program:
    """A step of a scheme as native steps.

    Attributes:
        name: of the scheme.
        parts: the lines of each native step.
    """

    name: str
    parts: tuple[tuple[Line, ...], ...]

    def __str__(self) -> str:
        n = len(self.parts)
        lines = [f"{self.name}: one step h = {n} native steps dt"]
        for k, part in enumerate(self.parts, 1):
            lines += [f"{k if i == 0 else '':>2} {line}" for i, line in enumerate(part)]
        return "\n".join(lines)


def write(scheme: Scheme, substeps: int) -> Program:
    """The program of a scheme.

    Args:
        scheme: what to execute; its operators are kicks, gradient kicks, drifts and baths.
        substeps: steps of RATTLE in each drift: 3 and 5 make it of fourth order (`COMPOSITIONS`), other numbers are
            equal steps.

    Raises:
        ValueError: the scheme has another operator, or needs more than `MOST_PARTS` native steps.
    """
    lines = [Line("every step", (Statement(UPDATE),))]
    for stage in scheme.stages:
        if stage.operator not in _LINES:
            raise ValueError(f"the operator '{stage.operator}' of the scheme {scheme.name} cannot be written out")
        lines += _LINES[stage.operator](stage, substeps)
    parts = _divided(lines)
    if len(parts) > MOST_PARTS:
        raise ValueError(f"the scheme {scheme.name} takes {len(parts)} native steps, more than {MOST_PARTS}")
    return Program(scheme.name, parts)


def _divided(lines: list[Line]) -> tuple[tuple[Line, ...], ...]:
    """Lines by native step: a new one begins where a force is needed at positions that were changed in this one."""
    parts: list[list[Line]] = [[]]
    moved = False
    for line in lines:
        if moved and any(statement.needs_force for statement in line.statements):
            parts.append([])
            moved = False
        parts[-1].append(line)
        moved = moved or any(statement.moves for statement in line.statements)
    return tuple(map(tuple, parts))


def _kick(stage: Stage, substeps: int) -> list[Line]:
    (t,) = _in_steps(stage)
    return [Line("kick", (Statement("v", f"v + {t}*f/m"), Statement(CONSTRAIN_V)))]


def _drift(stage: Stage, substeps: int) -> list[Line]:
    """Free motion by steps of RATTLE (Andersen, J. Comput. Phys. 52, 24 (1983)).

    The forces of the constraints move positions; the velocities change by what they moved them, and are constrained.
    """
    weights = COMPOSITIONS.get(substeps, (1 / substeps,) * substeps)
    statements = (
        Statement("x", "x + d*v"),
        Statement(KEPT, "x"),
        Statement(CONSTRAIN_X),
        Statement("v", f"v + (x - {KEPT})/d"),
        Statement(CONSTRAIN_V),
    )
    return [Line("drift", statements, tuple(stage.fraction * weight for weight in weights))]


def _gradient_kick(stage: Stage, substeps: int) -> list[Line]:
    """A kick by the forces at positions displaced by the constrained accelerations.

    Constraints of OpenMM act along the directions of the last positions that satisfied them. So positions are
    constrained after they were moved back, where this changes nothing but those directions. The displacement is kept
    rather than the positions, since GPU platforms may carry a molecule to the other side of the box between two native
    steps.
    """
    t, shift = _in_steps(stage)
    displace = (
        Statement(MOVED, "x"),
        Statement(V0, "v"),
        Statement("v", "f/m"),
        Statement(CONSTRAIN_V),
        Statement("x", f"x + {shift}*v"),
        Statement(CONSTRAIN_X),
        Statement(MOVED, f"x - {MOVED}"),
    )
    kick = (
        Statement("v", "f/m"),
        Statement(CONSTRAIN_V),
        Statement(KEPT, "v"),
        Statement("x", f"x - {MOVED}"),
        Statement(CONSTRAIN_X),
        Statement("v", KEPT),
        Statement(CONSTRAIN_V),
        Statement("v", f"{V0} + {t}*v"),
    )
    return [Line("displace", displace), Line("kick from there", kick)]


def _bath(stage: Stage, substeps: int) -> list[Line]:
    """The exact Ornstein-Uhlenbeck process of the constrained velocities: constraining projects the noise too."""
    (t,) = _in_steps(stage)
    spread = f"sqrt((1 - exp(-2*{FRICTION}*{t}))*{THERMAL}/m)"
    statements = (
        Statement(V0, "v"),
        Statement("v", f"exp(-{FRICTION}*{t})*v + {spread}*gaussian"),
        Statement(CONSTRAIN_V),
        Statement(WORK, f"{WORK} + 0.5*m*(v*v - {V0}*{V0})"),
    )
    return [Line("bath", statements)]


_LINES = {KICK: _kick, DRIFT: _drift, GRADIENT_KICK: _gradient_kick, BATH: _bath}


def _in_steps(stage: Stage) -> list[str]:
    """The times of a stage as expressions in h."""
    return [f"{factor!r}*{unit}" for factor, unit in zip(stage.times(1.0), ("h", "h*h"), strict=False)]


def install(program: Program | None, integrator: openmm.CustomIntegrator) -> None:
    """Give an openmm.CustomIntegrator a program and the variables of this module.

    `PART` says which native step is next. Where it is negative OpenMM updates the Context's state and does nothing
    else: the exact engine has this done.

    Args:
        program: None for an integrator that only the exact engine can execute.
        integrator: openmm.CustomIntegrator.
    """
    for name in VECTORS:
        integrator.addPerDofVariable(name, 0)
    for name in (EXACT_ONLY, PART, FRICTION, THERMAL):
        integrator.addGlobalVariable(name, 0)
    _add_guard(integrator)
    integrator.beginIfBlock(f"{PART} < 0")
    integrator.addUpdateContextState()
    integrator.endBlock()
    if program is None:
        return
    n = len(program.parts)
    for k, part in enumerate(program.parts):
        integrator.beginIfBlock(f"{PART} = {k}")
        for line in part:
            for d in line.lengths or (0.0,):
                for statement in line.statements:
                    _add_statement(statement, integrator, f"; d = {d!r}*h; h = {n}*dt")
        integrator.endBlock()
    integrator.addComputeGlobal(PART, f"select(step({PART} - {n - 1}), 0, {PART} + step({PART}))")


def _add_guard(integrator: openmm.CustomIntegrator) -> None:
    """Have the program fail where it is not all that was asked for, and this package is not there to do it.

    XML gives a plain CustomIntegrator there. Reference and CPU name the variable that does not exist, other platforms
    stop at positions that are NaN.
    """
    integrator.beginIfBlock(f"{EXACT_ONLY}*step({PART}) > 0.5")
    integrator.addComputePerDof(LOST, "0")
    integrator.addComputePerDof("x", f"x + sqrt(-{EXACT_ONLY})")
    integrator.addComputeGlobal(EXACT_ONLY, "energy")
    integrator.endBlock()


def _add_statement(statement: Statement, integrator: openmm.CustomIntegrator, definitions: str) -> None:
    if statement.target == CONSTRAIN_X:
        integrator.addConstrainPositions()
    elif statement.target == CONSTRAIN_V:
        integrator.addConstrainVelocities()
    elif statement.target == UPDATE:
        integrator.addUpdateContextState()
    else:
        integrator.addComputePerDof(statement.target, statement.expression + definitions)
