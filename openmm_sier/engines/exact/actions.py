"""Draw velocities, satisfy constraints and minimize the energy for bodies, where OpenMM cannot.

OpenMM moves atoms and keeps only the System's constraints. It would tear apart bodies that are rigid only because they
were named.
"""

import math
import secrets
from collections.abc import Callable, Collection
from dataclasses import replace
from functools import cached_property, partial
from itertools import islice
from typing import Any

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import BodySet, BodyState
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.minimizer import descent
from openmm_sier.dynamics.noise import generator
from openmm_sier.dynamics.vectors import combine
from openmm_sier.engines import interrupts
from openmm_sier.engines.actions import Actions
from openmm_sier.engines.exact.forces import BodyForces
from openmm_sier.engines.protocol import Engine
from openmm_sier.engines.snapshot import Snapshot, potential_of
from openmm_sier.system import tables
from openmm_sier.system.arguments import quantity_to_float
from openmm_sier.system.links import held_bodies


class BodyActions(Actions):
    """Leave actions to OpenMM where its solvers satisfy constraints that hold all bodies, and do the others."""

    def __init__(self, context: openmm.Context, engine: Engine, forces: BodyForces):
        super().__init__(context, engine)
        self._forces = forces

    @cached_property
    def _are_bodies_constrained(self) -> bool:
        """Whether the constraints of the System hold all bodies, and these move along and about all axes."""
        bodies = self._engine.bodies
        are_held = held_bodies(self._context.getSystem(), bodies.species)
        return bodies.bearings is None and all(held.all() for held in are_held)

    def _is_unsolved(self) -> bool:
        """Return whether OpenMM's solvers cannot satisfy the constraints."""
        return bool(self._solver_test.unsolved(self._positions))

    def _holds_all_bodies(self) -> bool:
        """Return whether the constraints of the System hold all bodies, and OpenMM's solvers satisfy them."""
        return self._are_bodies_constrained and not self._is_unsolved()

    def draw_velocities(self, by_openmm: Callable[[], None], temperature: Any, seed: int | None = None) -> None:
        if self._is_unsolved() or self._engine.bodies.has_other_moments:
            self._draw_velocities(temperature, seed)
            return
        by_openmm()
        if not self._holds_all_bodies():
            self._make_velocities_rigid()

    def _draw_velocities(self, temperature: Any, seed: int | None) -> None:
        """Set velocities from the canonical distribution.

        Velocities of single atoms are drawn; the rigid part of their motion, without that along constraints, is
        canonical for bodies. Where the moments of bodies are not those of the masses, angular momenta are drawn.

        Raises:
            ValueError: the temperature is negative or not finite.
        """
        kelvins = quantity_to_float("temperature", temperature, unit.kelvin, "K")
        if kelvins < 0:
            raise ValueError(f"temperature must not be negative, got {kelvins} K")
        state, bodies = self._engine.state(), self._engine.bodies
        masses = tables.masses(self._context.getSystem())
        spread = np.sqrt(GAS_CONSTANT * kelvins * np.divide(1.0, masses, out=np.zeros_like(masses), where=masses > 0))
        random = generator(secrets.randbelow(2**31) if seed is None else abs(int(seed)), 0, stream=4)
        p, L = bodies.momenta(spread[:, None] * random.standard_normal((len(masses), 3)), state.A)
        if bodies.has_other_moments:
            along_axes = np.sqrt(GAS_CONSTANT * kelvins * bodies.moments * bodies.turns) * random.standard_normal(
                L.shape
            )
            L = combine(along_axes, *state.A)
        drawn = replace(state, p=bodies.constraints.project(state.q, p), L=L)
        openmm.Context.setVelocities(self._context, bodies.move(drawn, Snapshot.of(self._context).velocities))

    def satisfy_positions(self, by_openmm: Callable[[], None]) -> None:
        if self._holds_all_bodies():
            by_openmm()
            return
        state, bodies = self._engine.state(), self._engine.bodies
        openmm.Context.setPositions(self._context, bodies.place(state.q, state.A, Snapshot.of(self._context).positions))
        self._context.computeVirtualSites()

    def satisfy_velocities(self, by_openmm: Callable[[], None]) -> None:
        if self._holds_all_bodies():
            by_openmm()
        else:
            self._make_velocities_rigid()

    def _make_velocities_rigid(self) -> None:
        """Keep the rigid part of the motion of each body, without that along constraints."""
        state, bodies = self._engine.state(), self._engine.bodies
        openmm.Context.setVelocities(self._context, bodies.move(state, Snapshot.of(self._context).velocities))

    def minimize(self, by_openmm: Callable[[], None], tolerance: Any, iterations: int, reporter: Any) -> None:
        engine = self._engine
        if self._holds_all_bodies():
            super().minimize(by_openmm, tolerance, iterations, reporter)
            return
        start, groups = engine.state(), self._context.getIntegrator().getIntegrationForceGroups()
        forces = partial(self._forces.compute, groups=groups)
        handlers = interrupts.defer()

        def call_handlers() -> None:
            """Call the handlers of signals where the Context is at the start: other positions belong to no step."""
            nonlocal handlers
            engine.recover()
            waiting, handlers = handlers, None
            interrupts.release(waiting)
            handlers = interrupts.defer()

        try:
            signals = () if handlers is None else interrupts.pending
            minimize_bodies(
                self._context, engine.bodies, forces, start, tolerance, iterations, reporter, signals, call_handlers
            )
        except BaseException:
            engine.recover()
            raise
        finally:
            interrupts.release(handlers)


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
