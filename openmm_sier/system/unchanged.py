"""Whether a System is still what it was when its Context was made: OpenMM reads it only then."""

from __future__ import annotations

import weakref
from typing import Any

import openmm


class UnchangedSystem:
    """The System of a Context, to be compared with what it was."""

    #: How often a Force of any System was removed, or got another group or other PME parameters: `hooks` counts. A look
    #: at every Force at each call of `step` would take 5 to 10 us for each of them.
    changes = 0

    def __init__(self, context: openmm.Context):
        # The Context owns the integrator that holds this object.
        self._context = weakref.ref(context)
        system = context.getSystem()
        self._then, self._counts, self._changes = _outline(system), _counts(system), UnchangedSystem.changes

    def check(self) -> None:
        """Compare particles, constraints, Forces, their groups and the parameters of PME.

        Raises:
            openmm.OpenMMException: the System was changed after its Context was made.
        """
        if (context := self._context()) is None:
            return
        system, changes = context.getSystem(), UnchangedSystem.changes
        if changes == self._changes and _counts(system) == self._counts:
            return
        if (now := _outline(system)) != self._then:
            name = next(name for name in self._then if now.get(name) != self._then[name])
            raise openmm.OpenMMException(
                f"The System was changed after its Context was created, which OpenMM takes no notice of: its {name} "
                f"was {self._then[name]} and is {now[name]}. Change a System, by prepare_system too, before the "
                "Context is created; or create a new one"
            )
        self._changes = changes


def _counts(system: openmm.System) -> tuple[int, int, int]:
    return system.getNumParticles(), system.getNumConstraints(), system.getNumForces()


def _outline(system: openmm.System) -> dict[str, Any]:
    """What is compared of a System, by names for messages."""
    names = ("number of particles", "number of constraints", "number of Forces")
    found: dict[str, Any] = dict(zip(names, _counts(system), strict=True))
    for number, force in enumerate(system.getForces()):
        found[f"Force {number}"] = kind = type(force).__name__
        found[f"force group of Force {number}, a {kind},"] = force.getForceGroup()
        if isinstance(force, openmm.NonbondedForce):
            alpha, *mesh = force.getPMEParameters()
            found[f"PME parameters of Force {number}, a {kind},"] = (alpha._value, *mesh)
    return found
