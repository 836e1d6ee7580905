"""What an engine is bound to."""

from __future__ import annotations

import weakref

import openmm


class Binding:
    """A Context and its integrator.

    The Context owns its integrator, and that its engine: a strong reference back would keep all of them alive.
    """

    def __init__(self, integrator: openmm.CustomIntegrator, context: openmm.Context):
        self._integrator_ref, self._context_ref = weakref.ref(integrator), weakref.ref(context)

    @property
    def _context(self) -> openmm.Context:
        context = self._context_ref()
        if context is None:
            raise openmm.OpenMMException("The Context of this integrator no longer exists")
        return context

    @property
    def _integrator(self) -> openmm.CustomIntegrator:
        integrator = self._integrator_ref()
        if integrator is None:
            raise openmm.OpenMMException("The integrator of this Context no longer exists")
        return integrator
