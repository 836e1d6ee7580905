"""Hybrid Monte Carlo: trajectories of a scheme, each accepted or rejected on its true energy.

A trial refreshes the momenta and follows a trajectory of n steps. Its end is accepted with the probability
min(1, exp(-(H1 - H0)/kT)); otherwise the state returns to its start, with all momenta reversed. The ends of trials are
then samples of the canonical ensemble, whatever the step, provided that trajectories are reversible and preserve
phase-space volume. This holds for drifts and kicks, and for gradient kicks, which change momenta by a function of
positions alone.

Where a CMMotionRemover requires zero total momentum, momenta are drawn with a sum of zero, and each kick leaves out the
motion of the centre of mass that it would cause. Such a kick is still a function of positions alone, and the samples
are those of the canonical ensemble with the centre of mass at rest. A removal between steps would be irreversible
wherever forces do not sum to zero.

Where many molecules contribute, energy errors are normally distributed. <exp(-error/kT)> = 1, which holds for every
reversible map that preserves phase-space volume, then makes their mean half their variance in kT^2, and the acceptance
erfc(sd/sqrt(8)).

Sources: Duane, Kennedy, Pendleton and Roweth, Phys. Lett. B 195, 216 (1987); Horowitz, Phys. Lett. B 268, 247 (1991)
for partly refreshed momenta, which detailed balance requires to be reversed after a rejection; Gupta, Irbaeck, Karsch
and Petersson, Phys. Lett. B 242, 437 (1990) for the acceptance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any

import numpy as np

from openmm_sier.dynamics.bodies import BodyState, NotFiniteError, RigidBodies
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.constraints import ConstraintError
from openmm_sier.dynamics.noise import generator
from openmm_sier.dynamics.operators import Operator, Stepper
from openmm_sier.dynamics.schemes import GRADIENT_KICK, KICK
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck

#: Potential energy of a state, kJ/mol.
Potential = Callable[[BodyState], float]

#: Errors within a trajectory that make its trial fail; the trial is then rejected.
FAILURES = (ConstraintError, NotFiniteError)


class NoEnergyError(ValueError):
    """The energy of a sample is not finite, so that no trial can begin there."""


@dataclass(frozen=True, eq=False)
class Trial:
    """A trajectory that has begun and is not at its end.

    Attributes:
        start: the state to return to, with refreshed momenta.
        energy: total energy there, kJ/mol; NaN: the trajectory has failed and is not followed any further.
        thermal: kT with which momenta were drawn, kJ/mol.
        h: length of its steps, ps; NaN: the potential has changed, so that the trial will be abandoned.
        left: steps to its end.
    """

    start: BodyState
    energy: float
    thermal: float
    h: float
    left: int

    @property
    def has_failed(self) -> bool:
        """Whether the trajectory could not be followed."""
        return math.isnan(self.energy)


@dataclass(frozen=True, eq=False)
class SampledState(BodyState):
    """A phase point of hybrid Monte Carlo.

    Attributes:
        trial: the trajectory that it lies on; None: it is a sample.
        trials, accepted: how many trials were completed, and how many were accepted.
        error: energy at the end of the last trial minus that at its start, in kT; infinite if it failed, NaN before the
            first one.
    """

    trial: Trial | None = None
    trials: int = 0
    accepted: int = 0
    error: float = math.nan

    @classmethod
    def of(cls, state: BodyState) -> SampledState:
        """A state as one of hybrid Monte Carlo; one of another kind begins without trials."""
        if isinstance(state, cls):
            return state
        return cls(state.q, state.p, state.A, state.L, state.heat, state.draws)

    def moved_to(self, state: BodyState, **changes: Any) -> SampledState:
        """This state at another phase point, with its heat."""
        place = {name: getattr(state, name) for name in ("q", "p", "A", "L", "heat")}
        return replace(self, **place, **changes)

    def given_up(self) -> SampledState:
        """The start of the trial, which is abandoned for a reason that does not depend on its trajectory."""
        return self if self.trial is None else self.moved_to(self.trial.start, trial=None)


class HybridMonteCarlo:
    """The Metropolis rule around the steps of a scheme without a bath.

    Random numbers are a function of the seed and of the number of draws so far, which travel with the state.

    Attributes:
        bath: source of the temperature and the seed.
        refresh: draws momenta, for a time in ps: the bath as an operator.
        length: number of steps of a trial that begins now.
        failures: errors that make a trial fail.
    """

    def __init__(
        self,
        bath: OrnsteinUhlenbeck,
        refresh: Operator,
        length: Callable[[], int],
        failures: tuple[type[Exception], ...] = FAILURES,
    ):
        self.bath, self.refresh, self.length, self.failures = bath, refresh, length, failures

    def stepper(self, bodies: RigidBodies, advance: Stepper, potential: Potential, h: float) -> Stepper:
        """A step of a trial; the first step begins the trial, and the last one ends it.

        Args:
            bodies: the rigid and point bodies.
            advance: a step of the scheme.
            potential: potential energy of a state.
            h: length of the step, ps. A trial that has begun with another length is abandoned.
        """

        def energy(state: BodyState) -> float:
            return sum(bodies.kinetic_energies(state)) + potential(state)

        def step(state: BodyState) -> SampledState:
            found = SampledState.of(state)
            if found.trial is not None and found.trial.h != h:
                found = found.given_up()
            if found.trial is None:
                found = self._begun(found, energy, h)
            found = self._followed(found, advance)
            return self._decided(found, energy) if found.trial is not None and not found.trial.left else found

        return step

    def _begun(self, sample: SampledState, energy: Potential, h: float) -> SampledState:
        steps, thermal = self.length(), GAS_CONSTANT * self.bath.temperature
        start = self.refresh(BodyState(sample.q, sample.p, sample.A, sample.L, sample.heat, sample.draws), steps * h)
        if not math.isfinite(total := energy(start)):
            raise NoEnergyError(f"no trajectory can begin where the energy is {total}")
        return sample.moved_to(start, draws=start.draws, trial=Trial(start, total, thermal, h, steps))

    def _followed(self, found: SampledState, advance: Stepper) -> SampledState:
        """One step further, or the start of a trial that has failed."""
        trial = found.trial
        assert trial is not None
        trial = replace(trial, left=trial.left - 1)
        if not trial.has_failed:
            try:
                return found.moved_to(advance(found), trial=trial)
            except self.failures:
                trial = replace(trial, energy=math.nan)
        return found.moved_to(trial.start, trial=trial)

    def _decided(self, end: SampledState, energy: Potential) -> SampledState:
        """The sample at the end of a trial."""
        trial = end.trial
        assert trial is not None
        error = math.inf if trial.has_failed else (energy(end) - trial.energy) / trial.thermal
        if math.isnan(error):
            error = math.inf
        luck = generator(self.bath.seed, end.draws, stream=2).random()
        end = replace(end, trials=end.trials + 1, error=error, draws=end.draws + 1, trial=None)
        if error <= -math.log(1 - luck):
            return replace(end, accepted=end.accepted + 1)
        return end.moved_to(reversed_state(trial.start))


def reversed_state(state: BodyState) -> BodyState:
    """The state with all momenta reversed."""
    return replace(state, p=-state.p, L=-state.L)


def refreshment(bath: Operator, bodies: RigidBodies, at_rest: bool) -> Operator:
    """The operator that draws momenta between trials.

    Args:
        bath: the Ornstein-Uhlenbeck process.
        bodies: the rigid and point bodies.
        at_rest: whether the total momentum is held at zero.
    """

    def apply(state: BodyState, time: float) -> BodyState:
        # Infinite friction has no meaning for steps of zero length, in which nothing moves.
        warmed = bath(state, time) if time else state
        return without_total_momentum(bodies, warmed) if at_rest else warmed

    return apply


def at_rest(bodies: RigidBodies, operators: Mapping[str, Operator]) -> dict[str, Operator]:
    """The operators, with kicks that leave the total momentum at zero."""

    def still(kick: Operator) -> Operator:
        def apply(state: BodyState, *times: float) -> BodyState:
            kicked = kick(state, *times)
            return replace(kicked, p=kicked.p - bodies.masses * bodies.centre_velocity(kicked.p))

        return apply

    return {name: still(each) if name in (KICK, GRADIENT_KICK) else each for name, each in operators.items()}


def without_total_momentum(bodies: RigidBodies, state: BodyState) -> BodyState:
    """The state with the velocity of the centre of mass subtracted from all bodies, and its energy from the heat."""
    velocity = bodies.centre_velocity(state.p)
    energy = 0.5 * float(bodies.masses.sum() * (velocity**2).sum())
    return replace(state, p=state.p - bodies.masses * velocity, heat=state.heat - energy)


def expected_acceptance(spread: float) -> float:
    """Mean of min(1, exp(-error)) for normally distributed energy errors with this standard deviation in kT."""
    return math.erfc(spread / math.sqrt(8))


def spread_at(acceptance: float) -> float:
    """The standard deviation of energy errors in kT at which a fraction of trials is accepted.

    >>> round(spread_at(0.5), 3)
    1.349
    """
    return -2 * NormalDist().inv_cdf(acceptance / 2)


def reversal_error(bodies: RigidBodies, advance: Stepper, start: BodyState, steps: int) -> float:
    """Distance between start and end of a trajectory that is followed, reversed and followed back.

    Returns:
        The largest distance of an atom from its place at the start, nm.
    """
    state = start
    for _ in range(2):
        for _ in range(steps):
            state = advance(state)
        state = reversed_state(state)
    before, after = (bodies.place(s.q, s.A, np.zeros((bodies.n_particles, 3))) for s in (start, state))
    return float(np.linalg.norm(after - before, axis=1).max(initial=0.0))
