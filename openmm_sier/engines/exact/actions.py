"""Draw velocities, satisfy constraints and minimize the energy for bodies, where OpenMM cannot."""

import secrets
import weakref
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.noise import generator
from openmm_sier.dynamics.vectors import combine
from openmm_sier.engines import interrupts
from openmm_sier.engines.actions import Actions
from openmm_sier.engines.exact.forces import BodyForces
from openmm_sier.engines.exact.minimization import minimize_bodies
from openmm_sier.engines.protocol import Engine
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.system import tables
from openmm_sier.system.arguments import quantity_to_float
from openmm_sier.system.links import held_bodies


class BodyActions(Actions):
    """Leave actions to OpenMM where it can do them, and do the others for constraints that its solvers cannot satisfy.

    So they do for bodies that no constraints hold: OpenMM would move their atoms as if these were free.
    """

    def __init__(self, context: openmm.Context, engine: Engine, forces: BodyForces):
        super().__init__(context, engine.solver_test)
        # The engine holds this.
        self._engine = weakref.proxy(engine)
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
        start, forces = engine.state(), self._forces.of_all_groups
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
