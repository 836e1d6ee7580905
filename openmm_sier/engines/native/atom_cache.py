"""Positions, velocities and box of a Context, each read when it is needed and cached until something moves the atoms.

To read the velocities of 24,000 atoms from a GPU takes 0.4 ms, and to write them as long. Ensembles ask for them
several times between two steps, and change them several times.
"""

# Without this, annotations would import numpy.random, which is slow.
from __future__ import annotations

import math
import weakref
from typing import Any

import numpy as np
import openmm

from openmm_sier.engines.snapshot import box_of
from openmm_sier.system import tables


class AtomCache:
    """Positions, velocities and box of a Context, read when needed, which can be written.

    Arrays are read-only. They are kept until `forget`, without which nobody may move atoms, and velocities are not
    written before `publish` or `forget`.

    Attributes:
        masses: of all particles, (N,), dalton.
        is_unwritten: whether the Context does not have the cached velocities yet.
    """

    def __init__(self, context: openmm.Context, is_single: bool) -> None:
        """
        Args:
            context: openmm.Context.
            is_single: whether its platform stores velocities in single precision.
        """
        # The Context owns its integrator and so all this: a strong reference back would keep both alive.
        self._context = weakref.proxy(context)
        self.masses = tables.masses(context.getSystem())
        self._mass = float(self.masses.sum())
        self._massless = np.flatnonzero(self.masses == 0)
        #: A mass for each component of the velocities, (N, 3): with one for each atom loops take twice as long.
        self._masses_of_components = np.repeat(self.masses[:, None], 3, axis=1)
        #: Spread of velocities at unit thermal energy, (N, 3); massless particles have none.
        masses = self._masses_of_components
        self._spreads = np.sqrt(np.divide(1.0, masses, out=np.zeros_like(masses), where=masses > 0))
        self._is_single = is_single
        self.is_unwritten = False
        self._positions: np.ndarray | None = None
        self._velocities: np.ndarray | None = None
        self._box: Any = None
        #: Kinetic energy and velocity of the centre of mass, where they were computed from the cached velocities.
        self._kinetic: float | None = None
        self._centre: np.ndarray | None = None

    def publish(self) -> None:
        """Write velocities that the Context does not have yet."""
        if self.is_unwritten:
            self.is_unwritten = False
            openmm.Context.setVelocities(self._context, self._velocities)

    def forget(self) -> None:
        """Write unwritten velocities and discard the cache, before atoms are moved or after that."""
        if self.is_unwritten:
            self.publish()
        self._positions = None
        self._velocities = None
        self._box = None
        self._kinetic = None
        self._centre = None

    def forget_velocities(self) -> None:
        """Discard cached velocities: they were replaced in the Context, and positions were not."""
        self._velocities = None
        self.is_unwritten = False
        self._kinetic = None
        self._centre = None

    # --- what the Context has ---

    @property
    def positions(self) -> np.ndarray:
        """Return the positions of all particles, (N, 3), nm."""
        if self._positions is None:
            self._positions = self._read(openmm.State.Positions, positions=True)
        return self._positions

    @property
    def velocities(self) -> np.ndarray:
        """Return velocities of all particles, (N, 3), nm/ps."""
        if self._velocities is None:
            self._velocities = self._read(openmm.State.Velocities, velocities=True)
        return self._velocities

    def _read(self, kind: int, **asked_for: bool) -> np.ndarray:
        """Return vectors of a kind, (N, 3)."""
        vectors = np.empty((len(self.masses), 3))
        # Like getPositions(asNumpy=True), but without its overhead for names and units.
        openmm.Context.getState(self._context, **asked_for)._getVectorAsNumpy(kind, vectors)
        vectors.flags.writeable = False
        return vectors

    @property
    def box(self) -> Any:
        """Return periodic box vectors, nm."""
        if self._box is None:
            self._box = box_of(openmm.Context.getState(self._context))
        return self._box

    # --- changes ---

    def write_box(self, box: Any) -> None:
        """Set periodic box vectors, nm."""
        self.forget()
        openmm.Context.setPeriodicBoxVectors(self._context, *box)

    def write_positions(self, positions: np.ndarray) -> None:
        """Set positions. GPU platforms may round them, so that they are read again."""
        self._positions = None
        openmm.Context.setPositions(self._context, positions)

    def write_velocities(self, velocities: np.ndarray) -> None:
        """Set velocities, which are cached then; the Context gets them by `publish`."""
        if self._is_single:
            # Round as the device does, so that continuing equals restarting.
            velocities = velocities.astype(np.float32).astype(float)
        self.forget_velocities()
        velocities.flags.writeable = False
        self._velocities = velocities
        self.is_unwritten = True

    def scale(self, factor: float, shift: np.ndarray) -> None:
        """Multiply the velocities of all atoms with mass by a factor, and add a velocity, (3,), nm/ps."""
        old = self.velocities
        new = factor * old + shift
        new[self._massless] = old[self._massless]
        self.write_velocities(new)

    def refresh_velocities(self, kept: float, kT: float, noise: np.random.Generator) -> None:
        """Draw velocities from a canonical distribution, of which the old ones stay a part. Constraints do not matter.

        Args:
            kept: factor that the old velocities keep.
            kT: thermal energy, kJ/mol.
            noise: random numbers.
        """
        drawn = noise.standard_normal((len(self.masses), 3))
        drawn *= self._spreads * math.sqrt((1 - kept**2) * kT)
        drawn += kept * self.velocities
        self.write_velocities(drawn)

    def constrain_velocities(self, tolerance: float) -> None:
        """Let OpenMM take away what velocities have along the constraints."""
        self.publish()
        openmm.Context.applyVelocityConstraints(self._context, tolerance)
        self.forget_velocities()

    # --- what follows from them ---

    def kinetic_energy(self) -> float:
        """Return the kinetic energy, kJ/mol."""
        if self._kinetic is not None:
            return self._kinetic
        velocities = self.velocities
        # No products of matrices: their last bits depend on the number of threads.
        energy = 0.5 * float((self._masses_of_components * velocities * velocities).sum())
        self._kinetic = energy
        return energy

    def centre_velocity(self) -> np.ndarray:
        """Return the velocity of the centre of mass, (3,), nm/ps; zero without masses."""
        if not self._mass:
            return np.zeros(3)
        if self._centre is not None:
            return self._centre
        # A sum for each axis is several times as fast as one over rows.
        centre = np.array([(self.masses * along).sum() for along in self.velocities.T]) / self._mass
        self._centre = centre
        return centre
