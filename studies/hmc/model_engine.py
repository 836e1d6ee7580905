"""Models of which hybrid Monte Carlo's averages are known, an engine that moves them, and chains of trials."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from openmm_sier.dynamics import operators
from openmm_sier.dynamics.bodies import BodyState, RigidBodies
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.species import Species
from openmm_sier.dynamics.thermostat import Thermostat
from openmm_sier.engines.phase_point import Movers, PhasePoint
from openmm_sier.engines.protocol import Clock, Flow
from openmm_sier.engines.variables import SEED
from openmm_sier.ensembles.metropolis import ACCEPTED, Metropolis

TEMPERATURE = 300.0
KT = GAS_CONSTANT * TEMPERATURE


class Wells:
    """Points in harmonic wells of several frequencies: V = sum of k q^2/2."""

    def __init__(self, n: int = 6) -> None:
        self.springs = 1000.0 * np.arange(1, n + 1)
        self.bodies = RigidBodies([Species(np.arange(n)[:, None], np.ones(1), np.zeros((3, 1)), np.zeros(3))], n)

    def forces(self, q: np.ndarray, A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return -self.springs * q, np.zeros_like(q)

    def energies(self, q: np.ndarray) -> np.ndarray:
        """k q^2/kT of each coordinate, whose square root has a normal distribution of unit variance."""
        return self.springs * q**2 / KT

    def potential(self, state: BodyState) -> float:
        return 0.5 * KT * float(self.energies(state.q).sum())

    def start(self) -> BodyState:
        n = self.bodies.n
        zero = np.zeros((3, n))
        return BodyState(zero, zero.copy(), np.repeat(np.eye(3)[:, :, None], n, axis=2), zero.copy())

    def observed(self, state: BodyState) -> np.ndarray:
        return self.energies(state.q)


class Dipoles(Wells):
    """Asymmetric bodies with a dipole along an axis that is none of their own, in a field along z."""

    FIELD = 10.0  # In kT for each dipole.

    def __init__(self, n: int = 6) -> None:
        masses = np.array([16.0, 1.0, 2.0])
        sites = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [-0.02, 0.09, 0.0]])
        self.bodies = RigidBodies([Species.from_coordinates(np.arange(3 * n).reshape(n, 3), masses, sites)], 3 * n)
        self.axis = np.array([0.6, 0.0, 0.8])

    def start(self) -> BodyState:
        along_the_field = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
        return replace(super().start(), A=np.repeat(along_the_field[:, :, None], self.bodies.n, axis=2))

    def directions(self, A: np.ndarray) -> np.ndarray:
        return np.einsum("k,kxn->xn", self.axis, A)

    def forces(self, q: np.ndarray, A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y, _ = self.directions(A)
        return np.zeros_like(q), self.FIELD * KT * np.stack([y, -x, np.zeros_like(x)])

    def potential(self, state: BodyState) -> float:
        return -self.FIELD * KT * float(self.directions(state.A)[2].sum())

    def observed(self, state: BodyState) -> np.ndarray:
        return self.directions(state.A)[2]


class ModelEngine(PhasePoint):
    """An engine without OpenMM: what ensembles need, for a model in a cubic box. It follows `flow`."""

    flow: Flow

    removes_momentum = False

    def __init__(self, model: Wells, rotation: operators.Rotation, volume: float, molecules: list | None) -> None:
        self.model, self.bodies = model, model.bodies
        self.movers = Movers(model.bodies, lambda: molecules or [[i] for i in range(model.bodies.n_particles)])
        self._reached, self.clock, self._volume = model.start(), Clock(0.0, 0), volume
        self._operators = operators.body_operators(model.bodies, operators.CachedForces(model.forces), rotation)

    @property
    def point(self) -> BodyState:
        return self._reached

    def change(self, operation: Callable[[BodyState], BodyState]) -> None:
        self._reached = operation(self._reached)

    def follow(self, steps: int) -> None:
        step = operators.stepper(self.flow.scheme, self._operators, self.flow.step)
        for _ in range(steps):
            self.change(step)
            self.clock = Clock(self.clock.time + self.flow.step, self.clock.steps + 1)

    def potential_energy(self) -> float:
        return self.model.potential(self._reached)

    def positions(self) -> np.ndarray:
        return self.bodies.place(self._reached.q, self._reached.A, np.zeros((self.bodies.n_particles, 3)))

    def draw_momenta(self, bath: Thermostat, time: float) -> None:
        self._reached = bath.operator(self.bodies)(self._reached, time)

    def remember(self) -> tuple:
        return self._reached, self.clock, self._volume

    def go_back(self, memory: tuple, reverse: bool = False) -> None:
        state, self.clock, self._volume = memory
        self._reached = replace(state, p=-state.p, L=-state.L) if reverse else state

    def volume(self) -> float:
        return self._volume

    def _scale_box(self, factor: float) -> None:
        self._volume *= factor**3


class Sample(NamedTuple):
    """The end of a trial, with the number of trials accepted so far."""

    state: BodyState
    accepted: int
    volume: float


@dataclass
class Chain:
    """A chain of trials: how they are made, and the numbers of steps that they have by turns.

    A mode of which a trajectory is just half a period long never leaves its energy. Trajectories of several lengths
    leave no such mode.
    """

    model: Wells
    scheme: Scheme
    h: float
    steps: tuple[int, ...] = (2, 3, 4)
    friction: float | None = None
    rotation: operators.Rotation = exact
    seed: int = 17
    pressure: float | None = None
    molecules: list | None = None
    record: dict = field(init=False)
    engine: ModelEngine = field(init=False)

    def __post_init__(self) -> None:
        self.record = defaultdict(float, {SEED: self.seed})
        volume = float(len(self.molecules)) if self.molecules else 1.0
        self.engine = ModelEngine(self.model, self.rotation, volume, self.molecules)

    def samples(self, trials: int) -> Iterator[Sample]:
        """The samples after each of so many trials."""
        flow = Flow(self.scheme, self.h, self.rotation, updates_context=False)
        # What a trial asks of an engine and of a record is here; what OpenMM and users ask is not.
        engine: Any = self.engine
        record: Any = self.record
        engine.flow = flow
        for steps in itertools.islice(itertools.cycle(self.steps), trials):
            made = Metropolis(TEMPERATURE, self.friction, steps, pressure=self.pressure, interval=1)
            made.advance(engine, flow, record, 1)
            yield Sample(engine.point, int(record[ACCEPTED]), engine.volume())
