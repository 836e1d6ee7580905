"""Systems of Contexts that exist. OpenMM reads a System only when a Context is made, so that they must not change."""

import weakref

import openmm

_contexts: weakref.WeakSet = weakref.WeakSet()


def add(context: openmm.Context) -> None:
    """Let `refuse_bound` know the System of a Context, as long as the Context exists."""
    _contexts.add(context)


def refuse_bound(system: openmm.System) -> None:
    """Refuse a System that a Context with a SIER integrator was made for.

    Raises:
        ValueError: there is such a Context.
    """
    # Each call of `getSystem` makes another Python object for the same System.
    address = int(system.this)
    if any(int(context.getSystem().this) == address for context in _contexts):
        raise ValueError(
            "OpenMM reads a System only when a Context is made, and this one has a Context already: prepare Systems "
            "before the Context or Simulation is made. Make this System again, or delete that Context first"
        )
