"""Updates of a Context's state, by barostats and thermostats, without a step of a program."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import openmm

from openmm_sier.engines.variables import PART


@contextmanager
def updating_context(integrator: openmm.CustomIntegrator, step: float) -> Iterator[None]:
    """Make native steps update the Context's state and do nothing else.

    Args:
        integrator: openmm.CustomIntegrator with a program of `native.installation`.
        step: the step that Forces such as AndersenThermostat are to see, ps.
    """
    native_step = openmm.CustomIntegrator.getStepSize(integrator)
    try:
        integrator.setGlobalVariableByName(PART, -1)
        openmm.CustomIntegrator.setStepSize(integrator, step)
        yield
    finally:
        openmm.CustomIntegrator.setStepSize(integrator, native_step)
        integrator.setGlobalVariableByName(PART, 0)
