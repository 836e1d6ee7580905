"""Registry of Systems that have Contexts. OpenMM reads a System only when a Context is made: later changes are lost."""

import weakref

import openmm

_contexts: weakref.WeakSet = weakref.WeakSet()


def add(context: openmm.Context) -> None:
    """Register the System of a Context with `refuse_bound` for the lifetime of the Context."""
    _contexts.add(context)


def refuse_bound(system: openmm.System) -> None:
    """Refuse a System that already has a Context, with whatever integrator.

    Raises:
        ValueError: there is such a Context.
    """
    # Each call of `getSystem` makes another Python object for the same System.
    address = int(system.this)
    if any(int(context.getSystem().this) == address for context in _contexts):
        raise ValueError(
            "OpenMM reads a System only when a Context is made, and this System already has one: prepare Systems "
            "before the Context or Simulation is made. Delete that Context or Simulation first; or prepare a copy, "
            "copy.deepcopy(system), for a new one"
        )
