"""Whether a System is still what it was when its Context was made: OpenMM reads it only then."""

from typing import Any

import openmm
from openmm import unit

#: Particles whose masses are looked at, at each call of `step`.
LOOKED_AT = 3


class UnchangedSystem:
    """The System of a Context, to be compared with what it was."""

    #: How often a Force of any System was removed, or got another group or other PME parameters: `hooks` counts. A look
    #: at every Force at each call of `step` would take 5 to 10 us for each of them.
    changes = 0

    def __init__(self, system: openmm.System):
        self._then, self._seen = _outline(system), (self.changes, _glance(system))

    def check(self, system: openmm.System) -> None:
        """Compare particles, a few masses, constraints, Forces, their groups and the parameters of PME.

        Raises:
            openmm.OpenMMException: the System was changed after its Context was made.
        """
        if (seen := (self.changes, _glance(system))) == self._seen:
            return
        now = _outline(system)
        for name, value in self._then.items():
            if now.get(name) != value:
                raise openmm.OpenMMException(
                    "The System was changed after its Context was created, which OpenMM takes no notice of: its "
                    f"{name} was {value} and is {now.get(name)}. Change a System, by prepare_system too, before the "
                    "Context is created; or create a new one"
                )
        self._seen = seen


def _glance(system: openmm.System) -> dict[str, Any]:
    """What is looked at, at each call of `step`, by names for messages: heavy hydrogens are seen in a few masses."""
    found: dict[str, Any] = {
        "number of particles": system.getNumParticles(),
        "number of constraints": system.getNumConstraints(),
        "number of Forces": system.getNumForces(),
    }
    for number in range(min(LOOKED_AT, system.getNumParticles())):
        found[f"mass of particle {number}, in dalton,"] = system.getParticleMass(number).value_in_unit(unit.dalton)
    return found


def _outline(system: openmm.System) -> dict[str, Any]:
    """What is compared of a System, by names for messages."""
    found = _glance(system)
    for number, force in enumerate(system.getForces()):
        found[f"Force {number}"] = kind = type(force).__name__
        found[f"force group of Force {number}, a {kind},"] = force.getForceGroup()
        if isinstance(force, openmm.NonbondedForce):
            alpha, *mesh = force.getPMEParameters()
            found[f"PME parameters of Force {number}, a {kind},"] = (alpha.value_in_unit(unit.nanometer**-1), *mesh)
    return found
