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

    def __init__(self, context: openmm.Context):
        # The Context owns the integrator that holds this object.
        self._context = weakref.ref(context)
        self._then = _outline(context.getSystem())

    def check(self) -> None:
        """Compare particles, constraints, Forces, their groups and the parameters of PME: some microseconds a Force.

        Raises:
            openmm.OpenMMException: the System was changed after its Context was made.
        """
        context = self._context()
        if context is not None and (now := _outline(context.getSystem())) != self._then:
            raise openmm.OpenMMException(
                f"The System was changed after its Context was created, which OpenMM takes no notice of: "
                f"{_difference(self._then, now)}. Change a System, by prepare_system too, before the Context is "
                "created; or create a new one"
            )


def _outline(system: openmm.System) -> _Outline:
    forces = tuple(_described(system.getForce(i)) for i in range(system.getNumForces()))
    return _Outline(system.getNumParticles(), system.getNumConstraints(), forces)


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
