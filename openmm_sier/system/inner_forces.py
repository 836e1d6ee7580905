"""Iterate over the Forces of a System, including Forces inside an ATMForce or CustomCVForce.

OpenMM evaluates inner Forces in separate Contexts, with their own cut-offs, meshes and charges.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import openmm
from openmm import unit


@dataclass(frozen=True)
class SystemForce:
    """A Force of a System, or a Force inside one.

    Attributes:
        force: the Force, which may be changed.
        number: index in the System of the Force, or of the outermost Force that contains it.
        group: the force group in which it acts, that of the outermost Force.
        containers: the Forces that contain it, the outermost first.
    """

    force: openmm.Force
    number: int
    group: int
    containers: tuple[openmm.Force, ...] = ()

    @property
    def name(self) -> str:
        """Name of the Force, and of the Forces that contain it."""
        return " in ".join([self.force.getName(), *(outer.getName() for outer in reversed(self.containers))])

    @property
    def is_variable(self) -> bool:
        """Whether it is a collective variable: the energy of the System is a function of its energy."""
        return any(isinstance(outer, openmm.CustomCVForce) for outer in self.containers)


def all_forces(system: openmm.System) -> Iterator[SystemForce]:
    """Yield each Force of a System, followed by the Forces inside it."""
    for number, force in enumerate(system.getForces()):
        yield from with_inner_forces(force, number)


def with_inner_forces(force: openmm.Force, number: int = -1) -> Iterator[SystemForce]:
    """Yield a Force and the Forces inside it; `number` is its index in a System."""
    yield from _with_inner(SystemForce(force, number, force.getForceGroup()))


def pme_parameters(force: openmm.Force) -> tuple[float, int, int, int]:
    """Return the Ewald parameter in 1/nm and the mesh set for a Force; zeros leave the choice to OpenMM.

    Some Forces return the parameter without a unit.
    """
    alpha, *mesh = force.getPMEParameters()
    return (alpha.value_in_unit(unit.nanometer**-1) if unit.is_quantity(alpha) else alpha, *mesh)


def _with_inner(entry: SystemForce) -> Iterator[SystemForce]:
    yield entry
    for force in _inner(entry.force):
        yield from _with_inner(SystemForce(force, entry.number, entry.group, (*entry.containers, entry.force)))


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
