"""A program as the computations of an OpenMM CustomIntegrator, with the variables that it uses."""

import copy
from collections.abc import Iterable
from functools import partial

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck
from openmm_sier.engines.native import trial_program, trial_variables
from openmm_sier.engines.native.program import NEVER
from openmm_sier.engines.native.statements import FRICTION, THERMAL
from openmm_sier.engines.program import (
    ALL_GROUPS,
    CONSTRAIN_V,
    CONSTRAIN_X,
    TRIAL_VECTORS,
    UPDATE,
    VECTORS,
    WORK,
    Program,
    Statement,
)
from openmm_sier.engines.variables import PART, PREFIX, STATE_VARIABLES, per_atom_values

#: Global variable without a use. Without it OpenMM would misread checkpoints of earlier versions.
UNUSED = PREFIX + "exact_only"

#: Global variable: the number of native steps of the program in a step of the scheme, below 1 where a native step is a
#: trial.
PARTS = PREFIX + "parts"

#: The per-atom variables of both engines, which are there where a run may go on with the other one.
ALL_VECTORS = (*STATE_VARIABLES, *VECTORS)

#: OpenMM's own computations, by the targets of statements without an expression.
OWN = {
    CONSTRAIN_X: openmm.CustomIntegrator.addConstrainPositions,
    CONSTRAIN_V: openmm.CustomIntegrator.addConstrainVelocities,
    UPDATE: openmm.CustomIntegrator.addUpdateContextState,
}

#: An undefined variable, by which OpenMM's error message says what is wrong.
LOST = "This_is_a_SIER_integrator__import_openmm_sier_before_it_is_read_from_XML"


def all_vectors(method: IntegrationMethod) -> tuple[str, ...]:
    """Return the names of the per-atom variables of both engines for a method."""
    return (*ALL_VECTORS, *TRIAL_VECTORS) if method.trial_steps else ALL_VECTORS


def variables(in_trials: bool) -> tuple[str, ...]:
    """Return the names of the global variables of programs, of which some may make trials."""
    return (UNUSED, PART, PARTS, FRICTION, THERMAL, *(trial_variables.GLOBALS if in_trials else ()))


def declare(integrator: openmm.CustomIntegrator, in_trials: bool = False) -> None:
    """Give an openmm.CustomIntegrator the global variables of programs, or of trials too, unless it has them."""
    there = set(map(integrator.getGlobalVariableName, range(integrator.getNumGlobalVariables())))
    for name in variables(in_trials):
        if name not in there:
            integrator.addGlobalVariable(name, 0)


def install(program: Program, integrator: openmm.CustomIntegrator, vectors: Iterable[str] | None = None) -> None:
    """Give an openmm.CustomIntegrator a program and the variables of this module.

    `PART` says which native step is next. If it is negative, OpenMM updates the Context's state and does nothing else:
    the exact engine uses this. A program of trials has no such block. Without parts of a program nothing else can be
    executed here.

    Args:
        program: what OpenMM executes.
        integrator: has neither computations nor per-atom variables yet.
        vectors: names of the per-atom variables; None: those of the program, with all that steps may need.
    """
    usual = program.vectors if program.trials is not None else ALL_VECTORS
    for name in usual if vectors is None else vectors:
        integrator.addPerDofVariable(name, 0)
    declare(integrator, program.trials is not None)
    n = program.native_steps
    integrator.setGlobalVariableByName(PARTS, n)
    if program.trials is not None:
        trial_program.Writer(program, program.trials, integrator, partial(_execute, integrator, n)).write()
        _add_last_force(program, integrator)
        return
    integrator.beginIfBlock(f"{PART} < 0")
    integrator.addUpdateContextState()
    integrator.endBlock()
    for k, part in enumerate(program.parts):
        integrator.beginIfBlock(f"{PART} = {k}")
        for line in part:
            for statement, lengths in line.executed():
                _execute(integrator, n, statement, lengths)
        integrator.endBlock()
    _add_last_force(program, integrator)
    # A program of one native step has nothing to count: OpenMM's GPU platforms upload all global variables after each
    # computation of one.
    if n > 1:
        integrator.addComputeGlobal(PART, f"select(step({PART} - {n - 1}), 0, {PART} + step({PART}))")


def _execute(integrator: openmm.CustomIntegrator, native_steps: float, statement: Statement, lengths: str) -> None:
    """Add the computation of a statement, with the definitions of its lengths, to a program of so many native steps."""
    if statement.target in OWN:
        OWN[statement.target](integrator)
    else:
        integrator.addComputePerDof(statement.target, f"{statement.expression}{lengths}; h = {native_steps!r}*dt")


def _add_last_force(program: Program, integrator: openmm.CustomIntegrator) -> None:
    """Add a block that is never executed and uses the force group that the program uses last.

    OpenMM computes what uses no force together with what uses the next force, and statements after the last one alone,
    in kernels of their own.
    """
    used = [term.name for statement in program.statements if (term := statement.force) is not None]
    used = [name for name in used if name != ALL_GROUPS]
    if used:
        integrator.beginIfBlock(f"{PART} = {NEVER}")
        integrator.addComputePerDof("v", f"v + {used[-1]}/m")
        integrator.endBlock()


def without_program(integrator: openmm.CustomIntegrator) -> openmm.CustomIntegrator:
    """Return a copy of an integrator with its settings and global variables, and without anything that `install` adds.

    It is a plain CustomIntegrator, with the step of the scheme.
    """
    bare = openmm.CustomIntegrator(step_of(integrator))
    bare.setConstraintTolerance(integrator.getConstraintTolerance())
    bare.setRandomNumberSeed(integrator.getRandomNumberSeed())
    bare.setIntegrationForceGroups(integrator.getIntegrationForceGroups())
    bare.setKineticEnergyExpression(integrator.getKineticEnergyExpression())
    for i in range(integrator.getNumGlobalVariables()):
        bare.addGlobalVariable(integrator.getGlobalVariableName(i), integrator.getGlobalVariable(i))
    bare.setGlobalVariableByName(PARTS, 0)
    for i in range(integrator.getNumTabulatedFunctions()):
        bare.addTabulatedFunction(
            integrator.getTabulatedFunctionName(i), copy.deepcopy(integrator.getTabulatedFunction(i))
        )
    return bare


def uninstall(integrator: openmm.CustomIntegrator) -> None:
    """Take a program back from an integrator that has one but no Context.

    OpenMM cannot take computations back. So the Python object gets another OpenMM object, as OpenMM's own classes do
    when they are unpickled.
    """
    if integrator.getNumComputations():
        integrator.this = without_program(integrator).this


def vectors_of(integrator: openmm.CustomIntegrator) -> set[str]:
    """Return the names of the per-atom variables of an integrator."""
    return set(map(integrator.getPerDofVariableName, range(integrator.getNumPerDofVariables())))


def refuse_additions(integrator: openmm.CustomIntegrator, own: int) -> None:
    """Refuse an integrator that has other computations than the number of its own.

    Raises:
        openmm.OpenMMException: somebody added some.
    """
    if (count := integrator.getNumComputations()) != own:
        raise openmm.OpenMMException(
            f"This integrator had {own} computations and has {count} now. Its scheme defines its step, to which "
            "addComputePerDof and similar methods cannot add. For a step of your own use an openmm.CustomIntegrator"
        )


def set_variables(integrator: openmm.CustomIntegrator, native_steps: int, bath: OrnsteinUhlenbeck | None) -> None:
    """Set the variables of a program to the values that they must have, whatever was loaded.

    Args:
        integrator: openmm.CustomIntegrator with the variables of programs.
        native_steps: number of native steps in a step of the scheme. A State that was written on another platform may
            have that of another program.
        bath: of the scheme.
    """
    integrator.setGlobalVariableByName(PARTS, native_steps)
    set_bath(integrator, bath)


def step_of(integrator: openmm.CustomIntegrator) -> float:
    """Return the step of the scheme of an integrator, ps."""
    native_step = openmm.CustomIntegrator.getStepSize(integrator).value_in_unit(unit.picosecond)
    return native_step * (integrator.getGlobalVariableByName(PARTS) or 1)


def take_heat(context: openmm.Context) -> float:
    """Return the heat that the program of a Context's integrator has counted, kJ/mol, and set its count to zero."""
    integrator = context.getIntegrator()
    if WORK not in vectors_of(integrator):
        return 0.0
    (work,) = per_atom_values(context, WORK)
    integrator.setPerDofVariableByName(WORK, np.zeros(work.shape))
    return float(work.sum())


def set_bath(integrator: openmm.CustomIntegrator, bath: OrnsteinUhlenbeck | None) -> None:
    """Set the variables of the bath of a program, which begins with its first part.

    Args:
        integrator: openmm.CustomIntegrator with a program of `install`.
        bath: of the scheme.
    """
    friction = bath.common_friction if bath is not None else None
    thermal = GAS_CONSTANT * bath.temperature if bath is not None else 0.0
    # Only the exact engine follows a bath with several frictions.
    for name, value in ((PART, 0.0), (FRICTION, friction or 0.0), (THERMAL, thermal)):
        if integrator.getGlobalVariableByName(name) != value:
            integrator.setGlobalVariableByName(name, value)


def add_failure(integrator: openmm.CustomIntegrator) -> None:
    """Give an integrator without a program a computation that fails, with a message that names this package.

    XML becomes a plain CustomIntegrator where this package is not imported, and a step of it would do nothing.
    Reference and CPU name the undefined variable in an error; other platforms stop at positions that are NaN.
    """
    integrator.addComputePerDof(LOST, "0")
    integrator.addComputePerDof("x", "x + sqrt(-dt)")
