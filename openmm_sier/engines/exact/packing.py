"""Body states as per-atom variables, so that OpenMM's checkpoints and States carry them bit for bit.

The numbers of the bodies follow one another, species by species, without regard to whose atoms the variables are.
"""

import weakref

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet, BodyState
from openmm_sier.engines.snapshot import is_on_host
from openmm_sier.engines.variables import STATE_VARIABLES, per_atom_values


class Packing:
    """Phase points of bodies as three vectors for each atom.

    Attributes:
        bodies: the bodies.
    """

    def __init__(self, bodies: BodySet):
        self.bodies = bodies
        #: Bodies in the order in which they are stored: species by species.
        self._order = np.concatenate([np.empty(0, np.int64), *bodies.numbers])
        #: Ranges of stored bodies that are all points, or all not.
        self._runs: list[tuple[slice, bool]] = []
        start = 0
        for species in bodies.species:
            count, size = species.atoms.shape
            first = start
            if self._runs and self._runs[-1][1] == (size == 1):
                first = self._runs.pop()[0].start
            start += count
            self._runs.append((slice(first, start), size == 1))

    def pack(self, state: BodyState) -> np.ndarray:
        """Return the numbers (q, p, L, A) of all bodies, shape (3, N, 3); zero beyond them."""
        values = np.zeros((3, self.bodies.n_particles, 3))
        numbers, start = values.reshape(-1), 0
        for vectors in self._vectors(_ordered(state, self._order)):
            numbers[start : start + vectors.size] = vectors.ravel()
            start += vectors.size
        return values

    def unpack(self, values: np.ndarray) -> BodyState:
        """Return the state that `pack` stored, with identity attitudes for point bodies.

        Args:
            values: shape (3, N, 3).
        """
        n = self.bodies.n
        q, p, L = np.zeros((3, 3, n))
        state = BodyState(q, p, np.repeat(np.eye(3)[:, :, None], n, axis=2), L)
        numbers, start = values.reshape(-1), 0
        for vectors in self._vectors(state):
            vectors[:] = numbers[start : start + vectors.size].reshape(vectors.shape)
            start += vectors.size
        return _ordered(state, np.argsort(self._order))

    def _vectors(self, state: BodyState) -> list[np.ndarray]:
        """Return views of what is stored of a state, in the order in which it is."""
        # Of a point there is room for six numbers, and it has no more.
        return [
            vectors[..., part]
            for part, is_point in self._runs
            for vectors in ((state.q, state.p) if is_point else (state.q, state.p, state.L, state.A))
        ]


def _ordered(state: BodyState, order: np.ndarray) -> BodyState:
    """Return a state of the bodies with indices `order`, (n,)."""
    q, p, A, L = (np.ascontiguousarray(vectors[..., order]) for vectors in (state.q, state.p, state.A, state.L))
    return BodyState(q, p, A, L)


class StoredPoint:
    """The phase point in the per-atom variables of an integrator.

    Attributes:
        is_outdated: whether the variables hold an older phase point than that of the engine.
    """

    def __init__(self, context: openmm.Context, bodies: BodySet):
        # The Context owns its integrator and so all this.
        self._context = weakref.proxy(context)
        self._packing = Packing(bodies)
        #: Whether the platform rounds what is written, so that it must be read again.
        self._is_rounded = not is_on_host(context.getPlatform())
        #: The phase point that the variables hold, where it is known.
        self._point: BodyState | None = None
        self.is_outdated = False

    def write(self, point: BodyState) -> None:
        """Set the variables to a phase point."""
        integrator = self._context.getIntegrator()
        for name, values in zip(STATE_VARIABLES, self._packing.pack(point), strict=True):
            integrator.setPerDofVariableByName(name, values)
        self.is_outdated = False
        self._point = point

    def latest(self, point: BodyState | None, is_loaded: bool) -> BodyState | None:
        """Return the phase point of the variables, or the engine's where they are outdated; None without one.

        Args:
            point: phase point of the engine.
            is_loaded: whether a checkpoint or State has brought the variables.
        """
        if self.is_outdated and not is_loaded:
            return point
        if is_loaded or self._is_rounded:
            self._point = self._read()
        return self._point

    def _read(self) -> BodyState | None:
        values = per_atom_values(self._context, *STATE_VARIABLES)
        if not values.any() or not np.isfinite(values).all():
            return None
        return self._packing.unpack(values)
