"""Check that a System is still what it was when its Context was made: OpenMM reads it only then."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import openmm

from openmm_sier.system import tables
from openmm_sier.system.inner_forces import Part, parts, pme_parameters


class Outline(NamedTuple):
    """Hold the properties by which Systems are compared.

    Attributes:
        sizes: numbers of particles, constraints and Forces.
        masses: (N,), dalton.
        constraints: see `tables.constraint_rows`.
        forces: class and force group of each Force.
        meshes: PME parameters of each Force that has any, also of those within others, by its name.
    """

    sizes: tuple[int, int, int]
    masses: np.ndarray
    constraints: np.ndarray
    forces: list[tuple[str, int]]
    meshes: dict[str, tuple]


class UnchangedSystem:
    """The System of a Context, to be compared with what it was."""

    #: How often a mass, a constraint or a Force of any System was changed in the ways that `hooks` counts. A look at
    #: every Force at each call of `step` would take 5 to 10 us for each of them.
    changes = 0

    def __init__(self, system: openmm.System):
        self._then, self._seen = _outline(system), (self.changes, _sizes(system))

    def check(self, system: openmm.System) -> None:
        """Compare masses, constraints, Forces, their groups and the parameters of PME.

        Raises:
            openmm.OpenMMException: the System was changed after its Context was made.
        """
        seen = self.changes, _sizes(system)
        if seen == self._seen:
            return
        for name, before, now in _differences(self._then, _outline(system)):
            raise openmm.OpenMMException(
                "The System was changed after its Context was created, and OpenMM does not see the change: its "
                f"{name} was {before} and is {now}. Call prepare_system, and make other changes, before the Context "
                "or Simulation is made; or make a new Context"
            )
        self._seen = seen


def _sizes(system: openmm.System) -> tuple[int, int, int]:
    """Return what is looked at, at each call of `step`."""
    return system.getNumParticles(), system.getNumConstraints(), system.getNumForces()


def _outline(system: openmm.System) -> Outline:
    forces = [(type(force).__name__, force.getForceGroup()) for force in system.getForces()]
    with_mesh = [part for part in parts(system) if hasattr(part.force, "getPMEParameters")]
    meshes = {_described(part): pme_parameters(part.force) for part in with_mesh}
    return Outline(_sizes(system), tables.masses(system), tables.constraint_rows(system), forces, meshes)


def _described(part: Part) -> str:
    """Return the number and the class of a Force, and of those that it is within."""
    containers = [outer for outer, _ in reversed(part.within)]
    kind = " in ".join(type(force).__name__ for force in (part.force, *containers))
    place = ".".join(map(str, (part.number, *(index for _, index in part.within))))
    return f"{place}, a {kind}"


def _differences(then: Outline, now: Outline) -> Iterator[tuple[str, Any, Any]]:
    """Give what differs, by its name, as it was and as it is."""
    for name, before, after in zip(("particles", "constraints", "Forces"), then.sizes, now.sizes, strict=True):
        if before != after:
            yield f"number of {name}", before, after
    for i in np.flatnonzero(then.masses != now.masses).tolist():
        yield f"mass of particle {i}, in dalton,", float(then.masses[i]), float(now.masses[i])
    for i in np.flatnonzero((then.constraints != now.constraints).any(axis=1)).tolist():
        yield f"constraint {i}, atoms and length in nm,", _constraint(then, i), _constraint(now, i)
    for number, ((kind, group), (new_kind, new_group)) in enumerate(zip(then.forces, now.forces, strict=True)):
        if kind != new_kind:
            yield f"Force {number}", kind, new_kind
        if group != new_group:
            yield f"force group of Force {number}, a {kind},", group, new_group
    for name in then.meshes | now.meshes:
        if then.meshes.get(name) != now.meshes.get(name):
            yield f"PME parameters of Force {name},", then.meshes.get(name), now.meshes.get(name)


def _constraint(outline: Outline, number: int) -> tuple[int, int, float]:
    """Return the atoms and the length of a constraint."""
    first, second, length = outline.constraints[number].tolist()
    return int(first), int(second), length
