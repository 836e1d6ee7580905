"""Energy minimization that keeps bodies rigid without constraints.

OpenMM's LocalEnergyMinimizer moves atoms and keeps only the System's constraints. It would tear apart bodies that are
rigid only because they were named.
"""

import math
from collections.abc import Callable, Collection
from itertools import islice
from typing import Any

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import BodySet, BodyState
from openmm_sier.dynamics.minimizer import descent
from openmm_sier.engines.snapshot import potential_of


def minimize_bodies(
    context: openmm.Context,
    bodies: BodySet,
    forces: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]],
    start: BodyState,
    tolerance: Any,
    iterations: int,
    reporter: openmm.MinimizationReporter | None = None,
    signals: Collection[Any] = (),
    at_signal: Callable[[], None] = lambda: None,
) -> None:
    """Minimize the energy of a Context's rigid bodies, as `openmm.LocalEnergyMinimizer.minimize` does for atoms.

    Only positions change. Where this raises an error they are not those of the start. The first steps find the length
    of a step, so that a few iterations can end with more energy than that of the start: then bodies stay at the start.

    Args:
        context: openmm.Context.
        bodies: its bodies.
        forces: (q, A) -> forces and torques on them, each (3, n); places them in the Context.
        start: where they are.
        tolerance: root mean square at which the minimization ends, a quantity or a number in kJ/mol/nm. It is that of
            forces, and of torques divided by radii of gyration, over the degrees of freedom of the bodies.
        iterations: largest number of iterations, each with one evaluation of forces; 0 for no limit.
        reporter: an openmm.MinimizationReporter or None.
        signals: those that wait.
        at_signal: called between two iterations when there are some.

    Raises:
        openmm.OpenMMException: a force is not finite.
    """
    if unit.is_quantity(tolerance):
        tolerance = tolerance.value_in_unit(unit.kilojoule_per_mole / unit.nanometer)
    points = descent(bodies, forces, start.q, start.A)
    before = math.nan
    for number, point in enumerate(islice(points, iterations + 1 if iterations else None)):
        if not number:
            before = _energy(context)
        if point.rms <= tolerance or (reporter is not None and _report(context, reporter, number)):
            break
        if signals:
            at_signal()
    if _energy(context) > before:
        forces(start.q, start.A)


def _energy(context: openmm.Context) -> float:
    """Return the potential energy of the forces that move the bodies where the Context is, kJ/mol."""
    groups = context.getIntegrator().getIntegrationForceGroups()
    return potential_of(openmm.Context.getState(context, energy=True, groups=groups))


def _report(context: openmm.Context, reporter: openmm.MinimizationReporter, number: int) -> bool:
    """Tell a MinimizationReporter of the positions that the Context has, and ask it whether to stop."""
    groups = context.getIntegrator().getIntegrationForceGroups()
    state = openmm.Context.getState(context, positions=True, forces=True, energy=True, groups=groups)
    x = state.getPositions(asNumpy=True).value_in_unit(unit.nanometer)
    forces = state.getForces(asNumpy=True).value_in_unit(unit.kilojoule_per_mole / unit.nanometer)
    others = dict.fromkeys(("restraint energy", "restraint strength", "max constraint error"), 0.0)
    arguments = {"system energy": potential_of(state), **others}
    return bool(reporter.report(number, x.ravel().tolist(), (-forces).ravel().tolist(), arguments))
