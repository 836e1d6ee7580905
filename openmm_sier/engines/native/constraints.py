"""Distances of atoms from the constraints of a System."""

from __future__ import annotations

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import RigidityError
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.system import tables

#: Atoms further than this off their constraints, in nm or nm/ps, were put there from outside and are moved onto them.
#: OpenMM's own constraints leave errors of up to 5e-9 nm, since SETTLE works with lengths in single precision.
OFF = 1e-7

#: Atoms still further off than this afterwards, in nm, have not converged.
NOT_CONVERGED = 1e-4


class SystemConstraints:
    """The constraints of a System.

    Attributes:
        pairs: particle indices, (n, 2).
        lengths: (n,), nm.
    """

    def __init__(self, system: openmm.System):
        self.pairs, self.lengths = tables.constraints(system)

    def satisfy(self, context: openmm.Context, tolerance: float) -> None:
        """Move the atoms of a Context, and their velocities, onto the constraints.

        Atoms that satisfy them are unchanged, bit for bit.

        Raises:
            RigidityError: OpenMM cannot satisfy them.
        """
        if not len(self.pairs):
            return
        now = Snapshot(context)
        if not self._errors(now).max() <= OFF:
            context.applyConstraints(tolerance)
            now = Snapshot(context)
            self._demand_converged(now)
        if not self._speeds(now).max() <= OFF:
            context.applyVelocityConstraints(tolerance)

    def _errors(self, now: Snapshot) -> np.ndarray:
        return np.abs(np.linalg.norm(self._differences(now.positions), axis=1) - self.lengths)

    def _speeds(self, now: Snapshot) -> np.ndarray:
        """Velocities along the constraints, nm/ps."""
        arms, velocities = self._differences(now.positions), self._differences(now.velocities)
        return np.abs((arms * velocities).sum(axis=1)) / self.lengths

    def _differences(self, vectors: np.ndarray) -> np.ndarray:
        return vectors[self.pairs[:, 1]] - vectors[self.pairs[:, 0]]

    def _demand_converged(self, now: Snapshot) -> None:
        errors = self._errors(now)
        worst = int(np.argmax(np.where(np.isfinite(errors), errors, np.inf)))
        if not errors[worst] <= NOT_CONVERGED:
            i, j = self.pairs[worst].tolist()
            raise RigidityError(
                f"the constraint of atoms {i} and {j} wants them {self.lengths[worst]:.4f} nm apart, and OpenMM could "
                f"move them no nearer to that than {errors[worst]:.2g} nm: give positions that satisfy the constraints"
            )
