"""Create further Contexts of the System of a run."""

import openmm

from openmm_sier.system.forces import kind_of


def second_context(context: openmm.Context, system: openmm.System) -> openmm.Context:
    """Return a new Context on the platform of another one, with its box and parameter values.

    The new Context has no barostat or thermostat of OpenMM: each of them reseeds OpenMM's random numbers when a Context
    is made, and all Contexts of a process share these, so that the noise of the first Context would change.

    Args:
        context: the first Context.
        system: System of the new Context; it is not changed.
    """
    second = openmm.Context(_without_baths(system), openmm.VerletIntegrator(0.001), *platform_of(context))
    second.setPeriodicBoxVectors(*openmm.Context.getState(context).getPeriodicBoxVectors())
    follow_parameters(context, second)
    return second


def cloned(system: openmm.System) -> openmm.System:
    """Return a copy of a System.

    Raises:
        openmm.OpenMMException: OpenMM cannot copy one of its Forces.
    """
    try:
        return openmm.XmlSerializer.clone(system)
    except openmm.OpenMMException as error:
        remedy = (
            ". A PythonForce is copied by pickle: give it a function that `def` defines at the top level of a module, "
            "in place of a lambda or a nested function"
        )
        is_pickle = "pickle" in str(error)
        raise openmm.OpenMMException(f"the System cannot be copied: {error}{remedy if is_pickle else ''}") from None


def reference_context(system: openmm.System) -> openmm.Context:
    """Return a Context of a System on the Reference platform, for double precision."""
    reference = openmm.Platform.getPlatformByName("Reference")
    return openmm.Context(system, openmm.VerletIntegrator(0.001), reference)


def platform_of(context: openmm.Context) -> tuple[openmm.Platform, dict[str, str]]:
    """Return the platform of a Context and its properties, for another Context."""
    platform = context.getPlatform()
    return platform, {name: platform.getPropertyValue(context, name) for name in platform.getPropertyNames()}


def follow_parameters(first: openmm.Context, second: openmm.Context) -> None:
    """Copy parameter values from the first Context to the second, where they differ."""
    values = first.getParameters()
    for name, value in second.getParameters().items():
        if value != values[name]:
            second.setParameter(name, values[name])


def _without_baths(system: openmm.System) -> openmm.System:
    """Return a System without Forces that set a temperature or a pressure: itself, or a copy."""
    if not any(kind_of(force).sets for force in system.getForces()):
        return system
    copied = cloned(system)
    for number in reversed(range(copied.getNumForces())):
        if kind_of(copied.getForce(number)).sets:
            copied.removeForce(number)
    return copied
