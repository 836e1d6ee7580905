"""Whether a System is still what it was when its Context was made: OpenMM reads it only then."""

from __future__ import annotations

import weakref
from typing import NamedTuple

import openmm


class _Force(NamedTuple):
    """What is compared of a Force; PME parameters are () for one that has none."""

    kind: type
    group: int
    pme: tuple[float, ...]


class _Outline(NamedTuple):
    """What is compared of a System."""

    particles: int
    constraints: int
    forces: tuple[_Force, ...]


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
            raise openmm.OpenMMException(
                f"The System was changed after its Context was created, which OpenMM takes no notice of: "
                f"{_difference(self._then, now)}. Change a System, by prepare_system too, before the Context is "
                "created; or create a new one"
            )
        self._changes = changes


def _counts(system: openmm.System) -> tuple[int, int, int]:
    return system.getNumParticles(), system.getNumConstraints(), system.getNumForces()


def _outline(system: openmm.System) -> _Outline:
    particles, constraints, forces = _counts(system)
    return _Outline(particles, constraints, tuple(_described(system.getForce(i)) for i in range(forces)))


def _described(force: openmm.Force) -> _Force:
    pme: tuple[float, ...] = ()
    if isinstance(force, openmm.NonbondedForce):
        alpha, *mesh = force.getPMEParameters()
        pme = (alpha._value, *mesh)
    return _Force(type(force), force.getForceGroup(), pme)


def _difference(then: _Outline, now: _Outline) -> str:
    for name in ("particles", "constraints"):
        if (before := getattr(then, name)) != (after := getattr(now, name)):
            return f"it had {before} {name} and has {after}"
    if len(then.forces) != len(now.forces):
        return f"it had {len(then.forces)} Forces and has {len(now.forces)}"
    pairs = enumerate(zip(then.forces, now.forces, strict=True))
    number, (one, other) = next((i, pair) for i, pair in pairs if pair[0] != pair[1])
    if one.kind != other.kind:
        return f"its Force {number} was a {one.kind.__name__} and is a {other.kind.__name__}"
    what = "force group" if one.group != other.group else "PME parameters"
    return f"the {what} of its Force {number}, a {one.kind.__name__}"
