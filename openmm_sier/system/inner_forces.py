"""Iterate over the Forces of a System, including Forces inside an ATMForce or CustomCVForce.

OpenMM evaluates inner Forces in separate Contexts, with their own cut-offs, meshes and charges.
"""

import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import openmm
from openmm import unit

from openmm_sier.system.second_context import reference_context

#: Values of collective variables at which derivatives are compared, to see whether they are constant: typical energies
#: of a box in kJ/mol, and distances in nm.
TRIED = (0.0, 0.31, -2.7, 41.0, -380.0, 5200.0, -71000.0)

#: Relative difference up to which derivatives count as equal.
ROUNDING = 1e-9


@dataclass(frozen=True)
class SystemForce:
    """A Force of a System, or a Force inside one.

    Attributes:
        force: the Force, which may be changed.
        number: index in the System of the Force, or of the outermost Force that contains it.
        group: the force group in which it acts, that of the outermost Force.
        containers: the Forces that contain it, the outermost first, each with the index of the next one inside it.
    """

    force: openmm.Force
    number: int
    group: int
    containers: tuple[tuple[openmm.Force, int], ...] = ()

    @property
    def name(self) -> str:
        """Name of the Force, and of the Forces that contain it."""
        return " in ".join([self.force.getName(), *(outer.getName() for outer, _ in reversed(self.containers))])

    @cached_property
    def weight(self) -> float | None:
        """Factor of its energy in the energy of the System; None if it is not constant.

        An ATMForce divides an energy between two states, and energies shared by both count once. A CustomCVForce
        multiplies it by the derivative of its expression, if this is constant, with global parameters at their
        defaults.
        """
        product = 1.0
        for outer, index in self.containers:
            factor = 1.0 if isinstance(outer, openmm.ATMForce) else _constant_derivatives(outer)[index]
            if factor is None:
                return None
            product *= factor
        return product


def all_forces(system: openmm.System) -> Iterator[SystemForce]:
    """Yield each Force of a System, followed by the Forces inside it."""
    for number, force in enumerate(system.getForces()):
        yield from _with_inner(SystemForce(force, number, force.getForceGroup()))


def is_linear(force: openmm.CustomCVForce) -> bool:
    """Return whether a CustomCVForce is a linear combination of its variables."""
    return None not in _constant_derivatives(force)


def pme_parameters(force: openmm.Force) -> tuple[float, int, int, int]:
    """Return the Ewald parameter in 1/nm and the mesh set for a Force; zeros leave the choice to OpenMM.

    Some Forces return the parameter without a unit.
    """
    alpha, *mesh = force.getPMEParameters()
    return (alpha.value_in_unit(unit.nanometer**-1) if unit.is_quantity(alpha) else alpha, *mesh)


def _with_inner(entry: SystemForce) -> Iterator[SystemForce]:
    yield entry
    for index, force in enumerate(_inner(entry.force)):
        yield from _with_inner(SystemForce(force, entry.number, entry.group, (*entry.containers, (entry.force, index))))


def _inner(force: openmm.Force) -> list[openmm.Force]:
    if isinstance(force, openmm.ATMForce):
        return [_of_its_class(force.getForce(i)) for i in range(force.getNumForces())]
    if isinstance(force, openmm.CustomCVForce):
        return [force.getCollectiveVariable(i) for i in range(force.getNumCollectiveVariables())]
    return []


def _of_its_class(force: openmm.Force) -> openmm.Force:
    """Return a Force as an object of its own class: `ATMForce.getForce` returns a plain Force without methods.

    A System returns Forces by class. The holder below is never deleted, since it would delete the Force, which belongs
    to the ATMForce; it takes 200 bytes.
    """
    if type(force) is not openmm.Force:
        return force
    holder = openmm.System()
    holder.thisown = False
    force.thisown = True
    holder.addForce(force)
    return holder.getForce(0)


def _constant_derivatives(force: openmm.CustomCVForce) -> list[float | None]:
    """Return the derivatives of a CustomCVForce's energy by its variables; None for each that is not constant."""
    names = [force.getCollectiveVariableName(i) for i in range(force.getNumCollectiveVariables())]
    # The same expression, with parameters in place of variables.
    expression = openmm.CustomCVForce(force.getEnergyFunction())
    for name in names:
        expression.addGlobalParameter(name, 0.0)
        expression.addEnergyParameterDerivative(name)
    for i in range(force.getNumGlobalParameters()):
        expression.addGlobalParameter(force.getGlobalParameterName(i), force.getGlobalParameterDefaultValue(i))
    for i in range(force.getNumTabulatedFunctions()):
        function = copy.deepcopy(force.getTabulatedFunction(i))
        expression.addTabulatedFunction(force.getTabulatedFunctionName(i), function)
    system = openmm.System()
    system.addParticle(1.0)
    system.addForce(expression)
    context = reference_context(system)
    context.setPositions([openmm.Vec3(0, 0, 0)])
    rows = []
    for first in range(len(TRIED)):
        for i, name in enumerate(names):
            context.setParameter(name, TRIED[(first + i) % len(TRIED)])
        derivatives = context.getState(parameterDerivatives=True).getEnergyParameterDerivatives()
        rows.append([derivatives[name] for name in names])
    # Tabulated functions are zero outside their range, which may contain none of the values.
    has_tables = force.getNumTabulatedFunctions() > 0
    constants: list[float | None] = []
    for column in zip(*rows, strict=True):
        is_same = all(math.isclose(value, column[0], rel_tol=ROUNDING) for value in column)
        constants.append(column[0] if is_same and (column[0] != 0 or not has_tables) else None)
    return constants
