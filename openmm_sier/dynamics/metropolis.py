"""Hybrid Monte Carlo: trajectories of a scheme, each accepted or rejected on its true energy.

A trial refreshes the momenta and follows a trajectory of n steps. Its end is accepted with the probability
min(1, exp(-(H1 - H0)/kT)); otherwise its start is taken again, with all momenta reversed. Averages over the ends of
trials are those of the canonical ensemble, whatever the step, provided that trajectories reverse and keep the volume of
phase space. Drifts and kicks do, and so does a gradient kick: momenta change by a function of positions alone.

Sources: Duane, Kennedy, Pendleton and Roweth, Phys. Lett. B 195, 216 (1987); Horowitz, Phys. Lett. B 268, 247 (1991)
for momenta that are refreshed in part.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from openmm_sier.dynamics.bodies import BodyState, RigidBodies
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.noise import generator
from openmm_sier.dynamics.operators import Stepper
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck

#: Potential energy of a state, kJ/mol.
Potential = Callable[[BodyState], float]


@dataclass(frozen=True, eq=False)
class Trial:
    """A trajectory that has begun and is not at its end.

    Attributes:
        start: the state to come back to, with refreshed momenta.
        energy: total energy there, kJ/mol.
        h: length of its steps, ps.
        steps: that were made.
    """

    start: BodyState
    energy: float
    h: float
    steps: int = 0


@dataclass(frozen=True, eq=False)
class SampledState(BodyState):
    """A phase point of hybrid Monte Carlo.

    Attributes:
        trial: the trajectory that it lies on; None: it is a sample.
        trials, accepted: how many trials there were, and how many were accepted.
        error: energy at the end of the last trial less that at its start, in kT; NaN before the first.
    """

    trial: Trial | None = None
    trials: int = 0
    accepted: int = 0
    error: float = math.nan

    @classmethod
    def of(cls, state: BodyState) -> SampledState:
        """A state as one of hybrid Monte Carlo; one that is no such state begins without trials."""
        if isinstance(state, cls):
            return state
        return cls(state.q, state.p, state.A, state.L, state.heat, state.draws)

    def moved_to(self, state: BodyState, **changes) -> SampledState:
        """This state at another phase point."""
        place = {name: getattr(state, name) for name in ("q", "p", "A", "L", "heat", "draws")}
        return replace(self, **place, **changes)

    def abandoned(self) -> SampledState:
        """The start of a trial that is given up for a reason that does not depend on its trajectory."""
        return self if self.trial is None else self.moved_to(self.trial.start, draws=self.draws, trial=None)


class HybridMonteCarlo:
    """The Metropolis rule around the steps of a scheme without a bath.

    Random numbers are a function of the seed and of the number of draws so far, which travel with the state.

    Attributes:
        bath: temperature, and friction with which momenta are refreshed between trials; infinite: drawn anew.
        steps: of each trial.
    """

    def __init__(self, bath: OrnsteinUhlenbeck, steps: int):
        self.bath = bath
        self.steps = steps

    def stepper(self, bodies: RigidBodies, advance: Stepper, potential: Potential, h: float, at_rest: bool) -> Stepper:
        """A step of a trial, which begins and ends it where it is the first and the last one.

        Args:
            bodies: the rigid and point bodies.
            advance: a step of the scheme.
            potential: potential energy of a state.
            h: length of the step, ps. A trial that has begun with another one is abandoned.
            at_rest: whether the total momentum is held at zero. Then momenta are refreshed at that total.
        """
        refresh = self._refreshment(bodies, h, at_rest)

        def energy(state: BodyState) -> float:
            return sum(bodies.kinetic_energies(state)) + potential(state)

        def step(state: BodyState) -> SampledState:
            found = SampledState.of(state)
            if found.trial is not None and found.trial.h != h:
                found = found.abandoned()
            if found.trial is None:
                start = refresh(found)
                found = found.moved_to(start, trial=Trial(start, energy(start), h))
            trial = found.trial
            assert trial is not None
            found = found.moved_to(advance(found), trial=replace(trial, steps=trial.steps + 1))
            return found if trial.steps + 1 < self.steps else self._decided(found, energy(found))

        return step

    def _refreshment(self, bodies: RigidBodies, h: float, at_rest: bool) -> Stepper:
        bath, time = self.bath.operator(bodies), self.steps * h

        def refresh(state: BodyState) -> BodyState:
            if time == 0:
                return state
            warmed = bath(BodyState(state.q, state.p, state.A, state.L, state.heat, state.draws), time)
            return without_total_momentum(bodies, warmed) if at_rest else warmed

        return refresh

    def _decided(self, end: SampledState, energy: float) -> SampledState:
        """The sample at the end of a trial."""
        trial = end.trial
        assert trial is not None
        luck = generator(self.bath.seed, end.draws, stream=2).random()
        error = (energy - trial.energy) / (GAS_CONSTANT * self.bath.temperature)
        counted = {"trial": None, "trials": end.trials + 1, "error": error, "draws": end.draws + 1}
        # An energy that is not a number is not accepted.
        if error <= -math.log(1 - luck):
            return replace(end, accepted=end.accepted + 1, **counted)
        start = trial.start
        return replace(end.moved_to(replace(start, p=-start.p, L=-start.L)), **counted)


def without_total_momentum(bodies: RigidBodies, state: BodyState) -> BodyState:
    """The state with the velocity of the centre of mass taken from all bodies, and its energy from the heat."""
    total = state.p.sum(axis=1)
    mass = bodies.masses.sum()
    p = state.p - bodies.masses * (total / mass)[:, None]
    return replace(state, p=p, heat=state.heat - 0.5 * float(total @ total) / mass)


def reversal_error(bodies: RigidBodies, advance: Stepper, start: BodyState, steps: int) -> float:
    """How far from its start a trajectory ends that is followed, reversed and followed again.

    Returns:
        The largest error of a position in nm, of a centre or, from the attitude, of an atom of the body.
    """
    state = start
    for _ in range(2):
        for _ in range(steps):
            state = advance(state)
        state = replace(state, p=-state.p, L=-state.L)
    before, after = (bodies.place(s.q, s.A, np.zeros((bodies.n_particles, 3))) for s in (start, state))
    return float(np.abs(after - before).max(initial=0.0))
