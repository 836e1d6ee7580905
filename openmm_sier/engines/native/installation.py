"""A program as the computations of an OpenMM CustomIntegrator, with the variables that it uses."""

import inspect
from xml.etree import ElementTree

import openmm

from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.thermostat import Thermostat
from openmm_sier.engines.native.program import CONSTRAIN_V, CONSTRAIN_X, FRICTION, THERMAL, UPDATE, VECTORS, Program
from openmm_sier.engines.variables import PART, PREFIX

#: Global variable that is 1 if only the exact engine can do what the integrator was made for.
EXACT_ONLY = PREFIX + "exact_only"

#: OpenMM's own computations, by the targets of statements without an expression.
OWN = {
    CONSTRAIN_X: openmm.CustomIntegrator.addConstrainPositions,
    CONSTRAIN_V: openmm.CustomIntegrator.addConstrainVelocities,
    UPDATE: openmm.CustomIntegrator.addUpdateContextState,
}

#: The name of an undefined variable, so that OpenMM's error message about it tells what is wrong.
LOST = "This_is_a_SIER_integrator__import_openmm_sier_before_it_is_read_from_XML"


def install(program: Program, integrator: openmm.CustomIntegrator) -> None:
    """Give an openmm.CustomIntegrator a program and the variables of this module.

    `PART` says which native step is next. If it is negative, OpenMM updates the Context's state and does nothing else:
    the exact engine uses this. Without parts of a program nothing else can be executed here.
    """
    for name in VECTORS:
        integrator.addPerDofVariable(name, 0)
    for name in (EXACT_ONLY, PART, FRICTION, THERMAL):
        integrator.addGlobalVariable(name, 0)
    _add_guard(integrator)
    integrator.beginIfBlock(f"{PART} < 0")
    integrator.addUpdateContextState()
    integrator.endBlock()
    n = len(program.parts)
    for k, part in enumerate(program.parts):
        integrator.beginIfBlock(f"{PART} = {k}")
        for line in part:
            for statement, lengths in line.executed():
                if statement.target in OWN:
                    OWN[statement.target](integrator)
                else:
                    integrator.addComputePerDof(statement.target, f"{statement.expression}{lengths}; h = {n}*dt")
        integrator.endBlock()
    if n:
        integrator.addComputeGlobal(PART, f"select(step({PART} - {n - 1}), 0, {PART} + step({PART}))")


def rewrite(integrator: openmm.CustomIntegrator, program: Program) -> None:
    """Give an integrator another program. Its variables, functions, seed, tolerance and force groups stay.

    A program is written before its System is known, and OpenMM cannot take a computation back. So the Python object
    gets another OpenMM object, from the XML of its present one with other computations. This is possible until a
    Context is created, which holds the OpenMM object.
    """
    donor = _alone(program)
    root, other = (ElementTree.fromstring(openmm.XmlSerializer.serialize(one)) for one in (integrator, donor))
    computations = [child.tag for child in root].index("Computations")
    root[computations] = other[[child.tag for child in other].index("Computations")]
    # Unwrapped, it makes a plain CustomIntegrator and not one of ours.
    plain = inspect.unwrap(openmm.XmlSerializer._deserializeIntegrator)
    integrator.this = plain(ElementTree.tostring(root, encoding="unicode")).this


def refuse_additions(integrator: openmm.CustomIntegrator, program: Program) -> None:
    """Refuse an integrator that has other computations than its program.

    Raises:
        openmm.OpenMMException: somebody added some.
    """
    if (count := integrator.getNumComputations()) != (own := _alone(program).getNumComputations()):
        raise openmm.OpenMMException(
            f"This integrator has {own} computations of its own and {count} now: a step of it is its scheme, and "
            "addComputePerDof and the like cannot add to it. Use an openmm.CustomIntegrator for steps of your own"
        )


def set_variables(integrator: openmm.CustomIntegrator, bath: Thermostat | None, is_guarded: bool) -> None:
    """Set the program's variables to the values that they must have, whatever was loaded.

    Args:
        integrator: openmm.CustomIntegrator with a program of `install`.
        bath: of the scheme.
        is_guarded: whether the program must refuse to run, since it would do less than what was asked for.
    """
    friction, thermal = (0.0, 0.0) if bath is None else (bath.friction, GAS_CONSTANT * bath.temperature)
    for name, value in ((EXACT_ONLY, float(is_guarded)), (PART, 0.0), (FRICTION, friction), (THERMAL, thermal)):
        if integrator.getGlobalVariableByName(name) != value:
            integrator.setGlobalVariableByName(name, value)


def _alone(program: Program) -> openmm.CustomIntegrator:
    """An integrator that has nothing but a program."""
    integrator = openmm.CustomIntegrator(1.0)
    install(program, integrator)
    return integrator


def _add_guard(integrator: openmm.CustomIntegrator) -> None:
    """Make the program fail where it cannot do all that was asked for, and this package is not there to do it.

    XML gives a plain CustomIntegrator there. Reference and CPU name the undefined variable in an error; other platforms
    stop at positions that are NaN.
    """
    integrator.beginIfBlock(f"{EXACT_ONLY}*step({PART}) > 0.5")
    integrator.addComputePerDof(LOST, "0")
    integrator.addComputePerDof("x", f"x + sqrt(-{EXACT_ONLY})")
    integrator.addComputeGlobal(EXACT_ONLY, "energy")
    integrator.endBlock()
