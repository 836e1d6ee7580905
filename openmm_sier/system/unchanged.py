"""Whether a System is still what it was when its Context was made: OpenMM reads it only then."""

from typing import Any

import openmm
from openmm import unit

from openmm_sier.system import tables
from openmm_sier.system.inner_forces import parts, pme_parameters


class UnchangedSystem:
    """The System of a Context, to be compared with what it was."""

    #: How often a mass, a constraint or a Force of any System was changed in the ways that `hooks` counts. A look at
    #: every Force at each call of `step` would take 5 to 10 us for each of them.
    changes = 0

    def __init__(self, system: openmm.System):
        self._then, self._seen = _outline(system), (self.changes, _glance(system))

    def check(self, system: openmm.System) -> None:
        """Compare masses, constraints, Forces, their groups and the parameters of PME.

        Raises:
            openmm.OpenMMException: the System was changed after its Context was made.
        """
        if (seen := (self.changes, _glance(system))) == self._seen:
            return
        now = _outline(system)
        for name, value in self._then.items():
            if now.get(name) != value:
                raise openmm.OpenMMException(
                    "The System was changed after its Context was created, so that OpenMM does not see the change: its "
                    f"{name} was {value} and is {now.get(name)}. Call prepare_system, and make other changes, before "
                    "the Context or Simulation is made; or make a new one"
                )
        self._seen = seen


def _glance(system: openmm.System) -> tuple[int, int, int]:
    """What is looked at, at each call of `step`."""
    return system.getNumParticles(), system.getNumConstraints(), system.getNumForces()


def _outline(system: openmm.System) -> dict[str, Any]:
    """What is compared of a System, by names for messages."""
    names = "number of particles", "number of constraints", "number of Forces"
    found: dict[str, Any] = dict(zip(names, _glance(system), strict=True))
    found |= {f"mass of particle {i}, in dalton,": mass for i, mass in enumerate(tables.masses(system).tolist())}
    for i in range(system.getNumConstraints()):
        a, b, length = system.getConstraintParameters(i)
        found[f"constraint {i}, atoms and length in nm,"] = a, b, length.value_in_unit(unit.nanometer)
    for number, force in enumerate(system.getForces()):
        found[f"Force {number}"] = kind = type(force).__name__
        found[f"force group of Force {number}, a {kind},"] = force.getForceGroup()
    for part in parts(system):
        if hasattr(part.force, "getPMEParameters"):
            containers = [outer for outer, _ in reversed(part.within)]
            kind = " in ".join(type(force).__name__ for force in (part.force, *containers))
            place = ".".join(map(str, (part.number, *(index for _, index in part.within))))
            found[f"PME parameters of Force {place}, a {kind},"] = pme_parameters(part.force)
    return found
