"""Make Contexts beside that of a run."""

import openmm

from openmm_sier.system.forces import kind_of


def second_context(context: openmm.Context, system: openmm.System) -> openmm.Context:
    """Return a new Context on the platform of another, with its box and the values of its parameters.

    It has no barostat or thermostat of OpenMM: each seeds OpenMM's random numbers anew when a Context is made, and all
    Contexts of a process share them, so that noise in the first one would change.

    Args:
        context: the first Context.
        system: for the new one. It stays as it is.
    """
    made = openmm.Context(_without_baths(system), openmm.VerletIntegrator(0.001), *platform_of(context))
    made.setPeriodicBoxVectors(*openmm.Context.getState(context).getPeriodicBoxVectors())
    follow_parameters(context, made)
    return made


def reference_context(system: openmm.System) -> openmm.Context:
    """Return a Context of a System on the Reference platform, to evaluate in double precision."""
    reference = openmm.Platform.getPlatformByName("Reference")
    return openmm.Context(system, openmm.VerletIntegrator(0.001), reference)


def platform_of(context: openmm.Context) -> tuple[openmm.Platform, dict[str, str]]:
    """Return the platform of a Context and its properties, with which to make another one there."""
    platform = context.getPlatform()
    return platform, {name: platform.getPropertyValue(context, name) for name in platform.getPropertyNames()}


def follow_parameters(first: openmm.Context, second: openmm.Context) -> None:
    """Give the second Context the values that parameters have in the first one, where they differ."""
    wanted = first.getParameters()
    for name, value in second.getParameters().items():
        if value != wanted[name]:
            second.setParameter(name, wanted[name])


def _without_baths(system: openmm.System) -> openmm.System:
    """Return a System without Forces that set a temperature or a pressure: itself, or a copy."""
    if not any(kind_of(force).sets for force in system.getForces()):
        return system
    copied = openmm.XmlSerializer.clone(system)
    for number in reversed(range(copied.getNumForces())):
        if kind_of(copied.getForce(number)).sets:
            copied.removeForce(number)
    return copied
