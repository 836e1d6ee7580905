"""Calls of steps like those of `Simulation`."""

from __future__ import annotations

import openmm

#: Steps in one call of `step`.
CALL = 10


def advance(integrator: openmm.Integrator, steps: int) -> None:
    """Make steps in calls of ten, and the remaining ones."""
    for start in range(0, steps, CALL):
        integrator.step(min(CALL, steps - start))
