"""Draw velocities, satisfy constraints and minimize the energy, as users ask of a Context."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import openmm
from openmm import unit

from openmm_sier.engines.snapshot import Snapshot, potential_of
from openmm_sier.system.cut_molecules import refuse_cut_molecules

if TYPE_CHECKING:
    from openmm_sier.engines.protocol import Engine

#: Relative tolerance of constraints, which are solved before a minimization.
TOLERANCE = 1e-5

#: Atoms at no larger distance, nm, are named as a pair that overlaps.
OVERLAP = 0.05


class Actions:
    """Actions of OpenMM in a Context: drawn velocities, constraints, minimization. Constraints may be refused.

    An engine that can satisfy them itself has a subclass. In each method `by_openmm` calls the method of OpenMM that
    the user called, and records the change, so that the engine reads the Context again when it is asked for its bodies.
    """

    def __init__(self, context: openmm.Context, engine: Engine):
        """
        Args:
            context: weak proxy of an openmm.Context, which owns its integrator and so this object.
            engine: its engine, which holds this.
        """
        self._context = context
        self._engine = weakref.proxy(engine)
        self._solver_test = engine.solver_test

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
        self._engine.forget_history()
        _refuse_hopeless_start(self._context)
        self.solve(by_openmm)


def _refuse_hopeless_start(context: openmm.Context) -> None:
    """Refuse positions from which OpenMM's minimizer would never come back.

    It never terminates if the energy is infinite or NaN. Positions are as before in any case.

    Raises:
        openmm.OpenMMException: positions are not finite, OpenMM cannot satisfy the constraints from there, or the
            energy is not finite. The message names the atoms.
    """
    now = Snapshot.of(context)
    now.refuse_what_is_not_finite()
    groups = context.getIntegrator().getIntegrationForceGroups()
    try:
        # The minimizer does so first.
        openmm.Context.applyConstraints(context, TOLERANCE)
        context.computeVirtualSites()
        constrained = Snapshot.of(context).positions
        is_finite = np.isfinite(constrained).all(axis=1)
        if not is_finite.all():
            raise openmm.OpenMMException(
                "No minimization can begin here, since OpenMM cannot satisfy the constraints of "
                f"{_named(int(is_finite.argmin()), now.positions)}: give other positions"
            )
        state = openmm.Context.getState(context, energy=True, forces=True, groups=groups)
    finally:
        openmm.Context.setPositions(context, now.positions)
    energy = potential_of(state)
    if not np.isfinite(energy):
        forces = state.getForces(asNumpy=True).value_in_unit(unit.kilojoule_per_mole / unit.nanometer)
        atom = int(np.isfinite(forces).all(axis=1).argmin())
        raise openmm.OpenMMException(
            f"No minimization can begin here, since the energy is {energy}, and the force on "
            f"{_named(atom, constrained)} is not finite: give other positions"
        )


def _named(atom: int, positions: np.ndarray) -> str:
    """Return an atom by its number, with its neighbour where that is too near."""
    distances = np.linalg.norm(positions - positions[atom], axis=1)
    distances[atom] = np.inf
    if distances.min(initial=np.inf) > OVERLAP:
        return f"atom {atom}"
    other = int(distances.argmin())
    return f"atom {atom} ({distances[other]:.2g} nm from atom {other})"
