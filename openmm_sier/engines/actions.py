"""Draw velocities, satisfy constraints and minimize the energy, as users ask of a Context."""

import weakref
from collections.abc import Callable
from typing import Any

import openmm

from openmm_sier.engines.beginnings import refuse_hopeless_start
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.system.cut_molecules import refuse_cut_molecules


class Actions:
    """Let OpenMM draw velocities, satisfy constraints and minimize the energy.

    An engine has a subclass where OpenMM cannot do it for all constraints. In each method `by_openmm` calls the method
    of OpenMM that the user called.
    """

    def __init__(self, context: openmm.Context):
        # The Context owns its integrator and so all this: a strong reference back would keep both alive.
        self._context = weakref.proxy(context)

    def solve(self, by_openmm: Callable[[], None]) -> None:
        """Let OpenMM do something for which it satisfies constraints."""
        by_openmm()

    def draw_velocities(self, by_openmm: Callable[[], None], temperature: Any, seed: int | None) -> None:
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
