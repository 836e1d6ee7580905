"""Forces on the bodies of one Context, and their energies."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any

import numpy as np

from openmm_sier.dynamics.bodies import BodyState, NotFiniteError, RigidBodies
from openmm_sier.dynamics.operators import CachedForces
from openmm_sier.engines.exact.atoms import Atoms
from openmm_sier.engines.protocol import TrajectoryError
from openmm_sier.system.stiffness import stiffest_force


class BodyForces:
    """Forces, torques and energies of bodies, which the Context computes at the atoms' positions.

    What is not finite raises `TrajectoryError`.

    Attributes:
        in_kicks: forces and torques of all groups but the fast ones.
    """

    def __init__(self, atoms: Atoms, next_step: Callable[[], int]):
        """
        Args:
            atoms: of the Context.
            next_step: gives the number of the step that is being made, for messages.
        """
        self._atoms, self._next_step = atoms, next_step
        self._bodies: RigidBodies | None = None
        self._groups = self._fast_groups = 0
        self.in_kicks = CachedForces(weakly(self._in_kicks))
        self.forget()

    def act_on(self, bodies: RigidBodies) -> None:
        """Take bodies."""
        self._bodies = bodies

    def select(self, groups: int, fast_groups: int) -> None:
        """Take the force groups that move the bodies, and the fast ones among them, each as a bit mask."""
        self._groups, self._fast_groups = groups, fast_groups

    def forget(self) -> None:
        """Compute everything anew next time: positions, box, parameters or the potential were changed."""
        # The last two energies, for the start and the end of a trajectory.
        self._energies: list[tuple[np.ndarray, np.ndarray, float]] = []
        self.in_kicks.invalidate()

    def of_all_groups(self, q: np.ndarray, A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Forces and torques on bodies at (q, A), each (3, n), including fast forces."""
        self.in_kicks.evaluations += 1
        return self._of(self._groups, q, A)

    def energy(self, state: BodyState) -> float:
        """Potential energy at a state, kJ/mol, of all groups that move the bodies."""
        q, A = state.q, state.A
        found = next((kept for kept in self._energies if kept[0] is q and kept[1] is A), None)
        if found is None:
            self.place(q, A)
            energy = self._atoms.context.getState(energy=True, groups=self._groups).getPotentialEnergy()._value
            found = (q, A, energy)
        self._energies = [*(kept for kept in self._energies if kept is not found), found][-2:]
        return found[2]

    def place(self, q: np.ndarray, A: np.ndarray) -> None:
        """Set the positions of the Context to those of bodies at (q, A), unless they are there already."""
        try:
            self._atoms.place(self._present, q, A)
        except NotFiniteError as error:
            raise self._blown_up("position of", error) from None

    def stiffest_on(self, bodies: np.ndarray, positions: np.ndarray) -> str:
        """What a message says of the stiffest force on some bodies, at positions (N, 3), nm."""
        atoms = [int(i) for body in bodies.tolist() for i in self._present.atoms_of(body)]
        found = stiffest_force(self._atoms.context, positions, atoms)
        return "" if found is None else f", or a force too stiff for it ({found})"

    @property
    def _present(self) -> RigidBodies:
        assert self._bodies is not None
        return self._bodies

    def _in_kicks(self, q: np.ndarray, A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._of(self._groups & ~self._fast_groups, q, A)

    def _of(self, groups: int, q: np.ndarray, A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self.place(q, A)
        try:
            return self._present.forces_and_torques(self._atoms.forces(groups), A)
        except NotFiniteError as error:
            raise self._blown_up("force on", error) from None

    def _blown_up(self, what: str, error: NotFiniteError) -> TrajectoryError:
        return TrajectoryError(
            f"The {what} {self._present.describe(error.body)} is not finite in step {self._next_step()}. Is the step "
            "size too long, or do atoms overlap? The Context is left at the last completed step."
        )


def weakly(method: Callable[..., Any]) -> Callable[..., Any]:
    """A method that does not keep its object alive.

    The engine owns a Context for fast forces, and so must not be left to the garbage collector, which may delete that
    Context's System before the Context.
    """
    reference = weakref.WeakMethod(method)

    def call(*arguments: Any) -> Any:
        found = reference()
        assert found is not None
        return found(*arguments)

    return call
