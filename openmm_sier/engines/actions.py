"""Draw velocities, satisfy constraints and minimize the energy, as users ask of a Context."""

from collections.abc import Callable
from typing import Any

import numpy as np
import openmm
from openmm import unit

from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.engines.start_checks import refuse_hopeless_start
from openmm_sier.system.cut_molecules import refuse_cut_molecules
from openmm_sier.system.solver_test import SolverTest


class Actions:
    """Actions of OpenMM in a Context: drawn velocities, constraints, minimization. Constraints may be refused.

    An engine that can satisfy them itself has a subclass. In each method `by_openmm` calls the method of OpenMM that
    the user called, and records the change, so that the engine reads the Context again when it is asked for its bodies.
    """

    def __init__(self, context: openmm.Context, solver_test: SolverTest):
        """
        Args:
            context: weak proxy of an openmm.Context, which owns its integrator and so this object.
            solver_test: of its System.
        """
        self._context = context
        self._solver_test = solver_test

    def _positions(self) -> np.ndarray:
        """Return positions, (N, 3), nm; zeros if none were set yet."""
        state = openmm.Context.getState(self._context, positions=True)
        return state.getPositions(asNumpy=True).value_in_unit(unit.nanometer)

    def solve(self, by_openmm: Callable[[], None]) -> None:
        """Let OpenMM do something for which it satisfies constraints.

        Raises:
            openmm.OpenMMException: it cannot.
        """
        self._solver_test.refuse(self._positions)
        by_openmm()

    def draw_velocities(self, by_openmm: Callable[[], None], temperature: Any, seed: int | None = None) -> None:
        """Draw velocities of all atoms, see `Context.setVelocitiesToTemperature`."""
        self.solve(by_openmm)

    def satisfy_positions(self, by_openmm: Callable[[], None]) -> None:
        """Move atoms onto the constraints, see `Context.applyConstraints`."""
        self.solve(by_openmm)

    def satisfy_velocities(self, by_openmm: Callable[[], None]) -> None:
        """Take away velocities along constraints, see `Context.applyVelocityConstraints`."""
        self.solve(by_openmm)

    def minimize(self, by_openmm: Callable[[], None], tolerance: Any, iterations: int, reporter: Any) -> None:
        """Minimize the energy and keep bodies rigid, see `openmm.LocalEnergyMinimizer` for the arguments.

        Raises:
            RigidityError: the periodic boundary cuts a molecule, which constraints or bonds would pull together.
            openmm.OpenMMException: it cannot begin where the atoms are.
        """
        now = Snapshot.of(self._context)
        refuse_cut_molecules(self._context.getSystem(), now.positions, now.box)
        refuse_hopeless_start(self._context)
        self.solve(by_openmm)
