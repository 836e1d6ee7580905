"""A trial of hybrid Monte Carlo as one native step, which OpenMM executes from the draw of momenta to the decision.

Only numbers cross between host and device. The host sets the kinetic energy of the start and the largest energy error
at which an end is accepted; it reads the error, the decision and the kinetic energy of the sample. Positions and
velocities of the start are kept in per-atom variables, from which a rejection restores them. Momenta are OpenMM's
random numbers.

OpenMM looks at every path through the blocks of a program, twice in a row, and computes an energy with each force after
which some path needs it. So the ending of the last step is written apart from those of the steps before it, whose
forces come without energies. It computes statements between two others in one kernel, but not across the beginning or
the end of a block: these are where constraints move atoms, which takes kernels of its own.

OpenMM's iterative solvers of constraints stop after so many iterations, wherever atoms are then, and say nothing. So
the constraints of an end are solved twice, and an end at which that moves an atom is rejected. It is done before the
last force, which positions that were moved would make invalid.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import openmm

from openmm_sier.dynamics.plan import Operation
from openmm_sier.engines.native.constrained_start import NOT_CONVERGED
from openmm_sier.engines.native.statements import THERMAL
from openmm_sier.engines.native.trial_variables import (
    CENTRE,
    CHANCES,
    END_ERROR,
    ENDS,
    FIRST_ERROR,
    GOES_ON,
    INFINITE,
    KINETIC,
    LEFT,
    SHARE,
    START,
    START_KINETIC,
    STEPS,
    STOPPED,
    TAKEN,
    THRESHOLD,
    WANTED,
)
from openmm_sier.engines.program import CONSTRAIN_V, CONSTRAIN_X, KEPT, START_V, START_X, Program, Statement, Trials
from openmm_sier.engines.trials import TRIAL, Decide, Draw, Follow, GoBack, Keep, StopCentre, WhileItGoesOn

#: The kinetic energy of atoms.
KINETIC_ENERGY = "0.5*m*v*v"

#: Energy of an atom that is moved where constraints are solved again, kJ/mol. It has a place in single precision.
BROKEN = 1e30

#: The kinetic energy of an end whose constraints were solved twice.
CHECKED_ENERGY = f"{KINETIC_ENERGY} + select(step(abs(x - {KEPT}) - {NOT_CONVERGED!r}), {BROKEN!r}, 0)"


def energies(program: Program) -> tuple[str, ...]:
    """Return the names of the potential energies that make up that of a program's forces.

    Groups whose forces a program takes by name have energies by name too, which come with these forces.
    """
    if program.slow_group is None:
        return ("energy",)
    return tuple(f"energy{group}" for group in (*program.fast_groups, program.slow_group))


#: A statement with the definitions of its lengths.
Executed = tuple[Statement, str]


def halves_of(program: Program) -> tuple[list[Executed], list[Executed]]:
    """Return the statements of a step to the last that moves atoms, and those after it.

    Velocities are constrained only at an end: until then constraints of positions take up what they have along them.
    """
    (part,) = program.parts
    executed = [each for line in part for each in line.executed()]
    if executed[-1][0].target == CONSTRAIN_V:
        executed = executed[:-1]
    middle = 1 + max(index for index, (statement, _) in enumerate(executed) if statement.moves)
    return executed[:middle], executed[middle:]


def ending_of(program: Program, checks_constraints: bool) -> list[Executed | str]:
    """Return the second of the halves, with the name of each energy before the first force of the same group.

    Where constraints are checked they are solved again first, and `KEPT` has the positions before that.
    """
    _, after = halves_of(program)
    if checks_constraints:
        # Velocities are corrected before, for what constraints moved, from positions that were kept.
        kick = next((i for i, (statement, _) in enumerate(after) if statement.force is not None), len(after))
        again = [(Statement(KEPT, "x"), ""), (Statement(CONSTRAIN_X), "")]
        return [*after[:kick], *again, *_with_energies(program, after[kick:])]
    return _with_energies(program, after)


def _with_energies(program: Program, statements: list[Executed]) -> list[Executed | str]:
    """Return statements of an end with the name of each energy before the first force of the same group."""
    ending: list[Executed | str] = [*statements]
    for energy in energies(program):
        name = energy.replace("energy", "f")
        places = (
            i
            for i, each in enumerate(ending)
            if not isinstance(each, str) and each[0].force is not None and each[0].force.name == name
        )
        ending.insert(next(places, len(ending)), energy)
    # Statements without a force can be computed with those of the first force, after its energy.
    first = next(i for i, each in enumerate(ending) if isinstance(each, str))
    return [ending[first], *ending[:first], *ending[first + 1 :]]


class Writer:
    """Writer of the computations of trials in an openmm.CustomIntegrator, which has their variables."""

    def __init__(
        self,
        program: Program,
        trials: Trials,
        integrator: openmm.CustomIntegrator,
        execute: Callable[[Statement, str], None],
    ):
        """
        Args:
            program: of one native step.
            trials: describes them.
            integrator: gets the computations.
            execute: adds a statement of the program, with the definitions of its lengths.
        """
        self._program = program
        self._trials = trials
        self._integrator = integrator
        self._execute = execute

    def write(self) -> None:
        """Add everything."""
        self._add(TRIAL)

    def _add(self, operations: Iterable[Operation]) -> None:
        for operation in operations:
            COMPUTATIONS[type(operation)](self, operation)

    def _draw(self, operation: Draw) -> None:
        """Draw momenta and scale them. All that can fail comes later, but for OpenMM's random numbers."""
        to = self._integrator
        old = "v"
        if self._trials.stopped_mass:
            old = f"(v + vector({', '.join(CENTRE)}))"
        # OpenMM computes this with the velocities, in one kernel.
        to.addComputePerDof(START_X, "x")
        to.addComputePerDof("v", f"{SHARE}*{old} + sqrt((1 - {SHARE}*{SHARE})*{THERMAL}/m)*gaussian")
        to.addConstrainVelocities()
        to.addComputeSum(START_KINETIC, KINETIC_ENERGY)
        to.addComputePerDof("v", f"v*sqrt(select({WANTED}, {WANTED}/{START_KINETIC}, 1))")

    def _keep(self, operation: Keep) -> None:
        """Keep the velocities and energies of the start; positions were kept when momenta were drawn."""
        to = self._integrator
        # OpenMM computes this with the velocities, in one kernel.
        to.addComputePerDof(START_V, "v")
        to.addComputeGlobal(START_KINETIC, f"select({WANTED}, {WANTED}, {START_KINETIC})")
        self._energy_of(START)

    def _while_it_goes_on(self, operation: WhileItGoesOn) -> None:
        to = self._integrator
        to.addComputeGlobal(ENDS, "0")
        to.addComputeGlobal(GOES_ON, "1")
        to.beginWhileBlock(f"{GOES_ON} > 0.5")
        self._add(operation.operations)
        to.endBlock()

    def _energy_of(self, name: str) -> None:
        first, *others = energies(self._program)
        self._integrator.addComputeGlobal(name, first)
        for each in others:
            self._integrator.addComputeGlobal(name, f"{name} + {each}")

    def _follow(self, operation: Follow) -> None:
        """Add the steps to an end, whose energies come with its last forces."""
        to = self._integrator
        before, after = halves_of(self._program)
        self._execute_all(before)
        to.addComputeGlobal(LEFT, f"{STEPS} - 1")
        to.beginWhileBlock(f"{LEFT} > 0.5")
        self._execute_all(after + before)
        to.addComputeGlobal(LEFT, f"{LEFT} - 1")
        to.endBlock()
        to.addComputeGlobal(END_ERROR, f"-{START} - {START_KINETIC}")
        for each in ending_of(self._program, self._trials.checks_constraints):
            if isinstance(each, str):
                to.addComputeGlobal(END_ERROR, f"{END_ERROR} + {each}")
            else:
                self._execute(*each)

    def _execute_all(self, statements: list[Executed]) -> None:
        for statement, lengths in statements:
            self._execute(statement, lengths)

    def _decide(self, operation: Decide) -> None:
        to = self._integrator
        to.addConstrainVelocities()
        to.addComputeSum(KINETIC, CHECKED_ENERGY if self._trials.checks_constraints else KINETIC_ENERGY)
        to.addComputeGlobal(END_ERROR, f"({END_ERROR} + {KINETIC})/{THERMAL}")
        to.addComputeGlobal(FIRST_ERROR, f"select({ENDS}, {FIRST_ERROR}, {END_ERROR})")
        to.addComputeGlobal(ENDS, f"{ENDS} + 1")
        # A comparison with NaN gives 0.
        is_finite = f"step({INFINITE!r} - abs({END_ERROR}))"
        to.addComputeGlobal(TAKEN, f"step({THRESHOLD} - {END_ERROR})*{is_finite}")
        to.addComputeGlobal(GOES_ON, f"(1 - {TAKEN})*step({CHANCES} - {ENDS})*{is_finite}")

    def _go_back(self, operation: GoBack) -> None:
        """Restore the start of a trial that was rejected, with reversed velocities."""
        to = self._integrator
        to.beginIfBlock(f"{TAKEN} < 0.5")
        to.addComputePerDof("x", START_X)
        to.addComputePerDof("v", f"-{START_V}")
        to.addComputeGlobal(KINETIC, START_KINETIC)
        to.endBlock()

    def _stop_centre(self, operation: StopCentre) -> None:
        """Stop the centre of mass where momenta were drawn.

        The sums use no global variable: to use one that has changed, the platforms for GPUs upload all of them.
        """
        to, mass = self._integrator, self._trials.stopped_mass
        if not mass:
            return
        for name, component in zip(CENTRE, ("_x", "_y", "_z"), strict=True):
            # A sum is over three components, and all of this vector are the same.
            to.addComputeSum(name, f"{1 / (3 * mass)!r}*m*{component}(v)")
        to.addComputePerDof("v", f"v - select({WANTED}, 1, 0)*vector({', '.join(CENTRE)})")
        squares = " + ".join(f"{name}*{name}" for name in CENTRE)
        to.addComputeGlobal(STOPPED, f"select({WANTED}, {0.5 * mass!r}*({squares}), 0)")
        to.addComputeGlobal(KINETIC, f"{KINETIC} - {STOPPED}")


#: Functions that write an operation of a trial, by its class.
COMPUTATIONS: dict[type[Operation], Callable[[Writer, Any], None]] = {
    Draw: Writer._draw,
    Keep: Writer._keep,
    WhileItGoesOn: Writer._while_it_goes_on,
    Follow: Writer._follow,
    Decide: Writer._decide,
    GoBack: Writer._go_back,
    StopCentre: Writer._stop_centre,
}
