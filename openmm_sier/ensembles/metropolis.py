"""Hybrid Monte Carlo: a step is a trial, a trajectory that is accepted or rejected on its true energy."""

import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
import openmm

from openmm_sier.dynamics.acceptance import largest_error, over_relaxed, usual_chances
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.schemes import BATH, Scheme
from openmm_sier.engines.protocol import Engine
from openmm_sier.engines.records import Clock
from openmm_sier.engines.session import Advance
from openmm_sier.engines.trials import ACCEPTED, ERROR, TRIALS, Trial, draw_start, refuse_energy, reversal_error
from openmm_sier.engines.variables import PREFIX
from openmm_sier.ensembles.ensemble import ConstantTemperature, make_number
from openmm_sier.system.forces import kind_of

#: Global variables: the step in ps at which reversibility was checked, and the error found, nm.
CHECKED_STEP, REVERSAL = (PREFIX + name for name in ("checked_step", "reversal"))

#: A trajectory that comes back to its start within this distance, in nm, counts as reversible. An irreversible one,
#: such as that of a scheme that is not a palindrome, misses by a multiple of this at usual steps. Rounding and forces
#: in single precision cause a miss of 1e-12 to 1e-6, see docs/guide/hmc.md.
REVERSIBLE = 1e-4

#: The same on a GPU in single precision, of trajectories to their first end. A step rounds positions to 1e-6 nm, a
#: hundred times as coarsely as in mixed precision, and chaos magnifies this ten times in 72 fs: a peptide in water
#: misses by 1e-4 nm after one such trial, and by 1e-2 nm after three. With a scheme that is not a palindrome water
#: misses by 0.2 nm.
SINGLE_REVERSIBLE = 1e-2


@dataclass(frozen=True)
class Metropolis(ConstantTemperature):
    """Sample the canonical ensemble without an error of the step, as `SIERHMCIntegrator` does.

    The ends of trials are samples. A step that cannot be completed is undone, so that the Context is always at a
    sample.

    Attributes:
        temperature: in K.
        friction: momenta keep a factor exp(-friction t) in a trial of length t, 1/ps; None draws all of them anew. In
            either case their kinetic energy is over-relaxed, see `dynamics.acceptance`.
        steps_per_trial: number of steps of the scheme in a trial.
        extra_chances: how many times a trajectory whose end is rejected is extended by the same number of steps and
            its new end tested; None takes `usual_chances`.
    """

    friction: float | None
    steps_per_trial: int
    extra_chances: int | None = None

    counts: ClassVar[tuple[str, ...]] = (
        *ConstantTemperature.counts,
        TRIALS,
        ACCEPTED,
        ERROR,
        CHECKED_STEP,
        REVERSAL,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.temperature:
            raise ValueError("temperature must be above zero for hybrid Monte Carlo, got 0 K")
        if self.friction is not None:
            make_number(self, "friction", "frictionCoeff", "1/ps", least=0)
            if not self.friction:
                raise ValueError("frictionCoeff must be above zero, got 0: momenta would never be drawn")
        make_number(self, "steps_per_trial", "stepsPerTrial", least=1)
        if self.extra_chances is not None:
            make_number(self, "extra_chances", "extraChances", least=0)

    @property
    def steps(self) -> int:
        return self.steps_per_trial

    @property
    def has_friction(self) -> bool:
        """Return True, since momenta are drawn anew, in part or all of them."""
        return True

    def scheme_for(self, scheme: Scheme) -> Scheme:
        if BATH in scheme.operators:
            raise ValueError(
                f"scheme {scheme.name} has a bath, but hybrid Monte Carlo draws momenta only between trials: take a "
                "scheme without a bath"
            )
        if not scheme.is_palindrome:
            raise ValueError(
                f"scheme {scheme.name} is not a palindrome, so that its trajectories cannot be reversed: take a scheme "
                "that is one"
            )
        return scheme

    def method(self, method: IntegrationMethod) -> IntegrationMethod:
        return replace(method, updates_context=False, trial_steps=self.steps_per_trial)

    def check(self, system: openmm.System, engine: Engine) -> None:
        for force in system.getForces():
            if kind_of(force).sets:
                raise openmm.OpenMMException(
                    f"Remove the {type(force).__name__}: it acts within trajectories, which hybrid Monte Carlo does "
                    "not allow. The integrator keeps the temperature, and the pressure if you give it pressure=1*bar"
                )
        super().check(system, engine)

    def maker(self, engine: Engine) -> Advance:
        return partial(self._make_trial, engine)

    def _make_trial(self, engine: Engine, steps: int, signals: Collection[Any]) -> int:
        """Make a trial, and count it at once, so that an error does not find it counted in part; see `Advance`."""
        tally, length = engine.tally, self.steps_per_trial * engine.method.step
        checked = self._check_reversal(engine)
        clock = engine.clock
        outcome = engine.make_trial(self._trial(engine))
        made, accepted = tally.counts[TRIALS] + 1, tally.counts[ACCEPTED] + outcome.is_accepted
        engine.clock = Clock(clock.time + length, clock.steps + 1)
        tally.counts |= {**checked, TRIALS: made, ACCEPTED: accepted, ERROR: outcome.error}
        return 1

    # --- the choices of a trial ---

    def _trial(self, engine: Engine) -> Trial:
        """Draw the random numbers of a trial; nothing is drawn where nothing moves.

        Where the centre of mass was stopped after the last trial, it is given a velocity before momenta are drawn, in
        part or all of them, and the kinetic energy that is over-relaxed has that of the centre too.
        """
        tally, method, kT = engine.tally, engine.method, GAS_CONSTANT * self.temperature
        kept = 0.0 if self.friction is None else math.exp(-self.friction * self.steps_per_trial * method.step)
        centre, kinetic, threshold = np.zeros(3), 0.0, 0.0
        freedoms = engine.degrees_of_freedom(conserved=False)
        if method.step > 0 and freedoms > 0:
            mass = engine.moving.moving_mass
            if engine.removes_momentum:
                thermal = np.sqrt(np.divide(kT, mass, out=np.zeros(3), where=mass > 0))
                centre = thermal * tally.noise(stream=3).standard_normal(3)
            before = (engine.kinetic_energy() + 0.5 * float(mass @ centre**2)) / (0.5 * kT)
            kinetic = 0.5 * kT * over_relaxed(before, freedoms, tally.noise(stream=5))
            threshold = largest_error(tally.seed, tally.draws + 1)
        return Trial(self.steps_per_trial, self._chances(method), kept, kT, kinetic, threshold, centre)

    def _chances(self, method: IntegrationMethod) -> int:
        """Return how many times a trajectory may go on."""
        if self.extra_chances is None:
            return usual_chances(self.steps_per_trial * method.step)
        return self.extra_chances

    # --- reversibility ---

    def _check_reversal(self, engine: Engine) -> dict[str, float]:
        """Follow a trajectory there and back, once for each step size, with momenta that are drawn for it.

        One that cannot be followed says nothing, and the next trial begins with another.

        Returns:
            The counts that change if one was followed.

        Raises:
            openmm.OpenMMException: it does not come back.
        """
        counts, step = engine.tally.counts, engine.method.step
        if counts[CHECKED_STEP] == step:
            return {}
        refuse_energy(engine.potential_energy(), engine.clock)
        sample = engine.save()
        try:
            trial = self._trial(engine)
            if trial.kinetic_energy:
                draw_start(engine, trial)
            last = 1 if engine.precision == "single" else 1 + self._chances(engine.method)
            # Later ends need not exist, for example where atoms leave a potential that ends.
            for steps in (self.steps_per_trial * last, self.steps_per_trial):
                error = reversal_error(engine, steps)
                if math.isfinite(error):
                    break
        finally:
            engine.restore(sample)
        if not math.isfinite(error):
            return {}
        allowed = SINGLE_REVERSIBLE if engine.precision == "single" else REVERSIBLE
        if not error <= allowed:
            raise openmm.OpenMMException(_misses(steps, error, allowed, engine.precision))
        return {REVERSAL: error, CHECKED_STEP: step}


def _misses(steps: int, error: float, allowed: float, precision: str | None) -> str:
    """Return a message that a trajectory of so many steps missed its start by an error, nm."""
    where = "" if precision is None else f" in {precision} precision"
    finer = "" if precision != "single" else "; or give the Simulation a platform and {'Precision': 'mixed'}"
    return (
        f"A trajectory of {steps} steps, followed backwards, missed its start by {error:.1e} nm; up to {allowed:.0e} "
        f"nm is allowed{where}. Samples would not be exact: take fewer or shorter steps in a trajectory, or fewer "
        f"extraChances{finer}"
    )
