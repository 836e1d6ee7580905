"""Splitting schemes as data.

A `Scheme` is a list of (operator, fraction of the step). Operators are only names here;
`openmm_sier.dynamics.operators` defines their actions. Order, symmetry and cost are derived from the list.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from numbers import Real

from openmm_sier.dynamics import step_limits
from openmm_sier.dynamics.order import order_of
from openmm_sier.dynamics.stages import BATH, DRIFT, DRIFT_FROM_BATH, DRIFT_TO_BATH, GRADIENT_KICK, KICK, Stage


@dataclass(frozen=True)
class Scheme:
    """One step of a splitting integrator as a list of stages, in order.

    >>> leapfrog = Scheme("leapfrog", (("kick", 0.5), ("drift", 1.0), ("kick", 0.5)))
    >>> leapfrog.order, leapfrog.force_evaluations, leapfrog.is_palindrome
    (2, 1, True)

    Attributes:
        name: name in messages and output.
        stages: `Stage` objects, or tuples (operator name, fraction of the step) that become stages.
        source: publication of the scheme.
        constant_energy_step: the usual step for rigid water at constant energy, ps, at which the energy is conserved
            over runs of any length (docs/measurements/whole-runs.md); None if not measured.
        bath_step: the usual step in a heat bath, ps, where the energy need not be conserved.
        heavy_bath_step: the same with hydrogens of 4 dalton, those of solutes of 3, see `prepare_system`.
        trial_step: the usual step in hybrid Monte Carlo, ps, with which most trials of some ten thousand atoms are
            accepted (docs/measurements/sampling.md).
        heavy_trial_step: the same with hydrogens of 4 dalton, those of solutes of 3.

    Raises:
        ValueError: there are no stages, a number is not finite, the fractions of a flow do not sum to 1, or a plain
            operator has a shift.
        TypeError: a name is not a string, or a fraction or shift is not a number.
    """

    name: str
    stages: tuple[Stage, ...]
    source: str = ""
    constant_energy_step: float | None = field(default=None, compare=False)
    bath_step: float | None = field(default=None, compare=False)
    heavy_bath_step: float | None = field(default=None, compare=False)
    trial_step: float | None = field(default=None, compare=False)
    heavy_trial_step: float | None = field(default=None, compare=False)

    def __repr__(self) -> str:
        return self.name

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise TypeError(f"the name of a scheme must be a string, got {self.name!r}")
        try:
            object.__setattr__(self, "stages", tuple(Stage(*stage) for stage in self.stages))
        except TypeError:
            raise TypeError(
                f"scheme {self.name}: each stage must be (operator name, fraction), got {self.stages!r}"
            ) from None
        if not self.stages:
            raise ValueError(f"scheme {self.name} has no stages")
        for stage in self.stages:
            has_numbers = isinstance(stage.fraction, Real) and isinstance(stage.shift, Real)
            if not (isinstance(stage.operator, str) and has_numbers):
                raise TypeError(f"scheme {self.name}: a stage must be (operator name, fraction), got {tuple(stage)}")
            if not (math.isfinite(stage.fraction) and math.isfinite(stage.shift)):
                raise ValueError(f"scheme {self.name}: fractions and shifts must be finite, got {tuple(stage)}")
        if wrong := [stage.operator for stage in self.stages if stage.shift and stage.operator != GRADIENT_KICK]:
            raise ValueError(f"scheme {self.name}: only a '{GRADIENT_KICK}' has a shift, got one for '{wrong[0]}'")
        for flow in dict.fromkeys(stage.flow for stage in self.stages):
            total = math.fsum(stage.fraction for stage in self.stages if stage.flow == flow)
            if not math.isclose(total, 1.0, rel_tol=0.0, abs_tol=1e-14):
                raise ValueError(f"scheme {self.name}: fractions of '{flow}' must sum to 1, got {total!r}")

    @property
    def operators(self) -> tuple[str, ...]:
        """Names of the operators, in order of appearance."""
        return tuple(dict.fromkeys(stage.operator for stage in self.stages))

    @property
    def is_palindrome(self) -> bool:
        """Whether the list reads the same backwards, which makes the step time-reversible."""
        return self.stages == self.stages[::-1]

    @cached_property
    def reuses_force(self) -> bool:
        """Whether the force at the end of a step is the one at the start of the next."""
        ends = [stage.flow for stage in self.stages if stage.flow in (DRIFT, KICK)]
        return DRIFT not in (*ends[:1], *ends[-1:])

    @cached_property
    def force_evaluations(self) -> int:
        """Force evaluations per step, not counting the first step of a run.

        One for each kick at positions that a drift has changed, and one for the displaced force of a gradient kick.
        """
        has_moved, count = True, 0
        for _ in range(2):
            count = 0
            for stage in self.stages:
                if stage.flow == DRIFT:
                    has_moved = True
                elif stage.flow == KICK:
                    count += int(has_moved) + int(stage.operator == GRADIENT_KICK)
                    has_moved = False
        return count

    def with_bath(self) -> Scheme:
        """Return this scheme with a heat bath, placed so that averages keep the scheme's order.

        SIER2, or any kick, drift, kick, becomes a whole kick, half drift, bath, half drift: the leapfrog "middle"
        scheme of Zhang et al., J. Phys. Chem. A 123, 6056 (2019), OpenMM's LangevinMiddleIntegrator. Positions visited
        are those of kick, half drift, bath, half drift, kick (Leimkuhler and Matthews, Appl. Math. Res. Express 2013,
        34), which have no error at all in a harmonic oscillator. Momenta at the end of a step are those after the bath,
        and have none either. Other schemes have half of the bath at either end: in the middle of a higher-order scheme
        positions and momenta are not those of a whole step, and a bath there would reduce the order to two. A scheme
        that already has a bath is returned unchanged.
        """
        if BATH in self.operators:
            return self
        if self.is_palindrome and [stage.operator for stage in self.stages] == [KICK, DRIFT, KICK]:
            middle = Stage(DRIFT_TO_BATH, 0.5), Stage(BATH, 1.0), Stage(DRIFT_FROM_BATH, 0.5)
            return replace(self, stages=(Stage(KICK, 1.0), *middle))
        return replace(self, stages=(Stage(BATH, 0.5), *self.stages, Stage(BATH, 0.5)))

    def without_bath(self) -> Scheme:
        """Return this scheme without its bath, with neighbours of one kind joined: the inverse of `with_bath`."""
        if self.bath_divides_drift:
            return replace(self, stages=(Stage(KICK, 0.5), Stage(DRIFT, 1.0), Stage(KICK, 0.5)))
        stages: list[Stage] = []
        for stage in self.stages:
            if stage.operator == BATH:
                continue
            if stages and stages[-1].operator == stage.operator and not stage.shift:
                stages[-1] = Stage(stage.operator, stages[-1].fraction + stage.fraction)
            else:
                stages.append(stage)
        return replace(self, stages=tuple(stages))

    @cached_property
    def bath_divides_drift(self) -> bool:
        """Whether `with_bath` put the bath into the middle of a drift."""
        return DRIFT_TO_BATH in self.operators

    @property
    def within_drifts(self) -> Scheme:
        """Scheme of inner steps, for fast forces in the drifts."""
        return _SIER2_WITH_BATH if self.bath_divides_drift else SIER4G

    def inner_fraction(self, substeps: int) -> float:
        """Return the longest inner step as a fraction of the step, with `substeps` in the longest drift.

        If a bath divides a drift, the inner step around the bath counts in the drifts on both sides.
        """
        return 1 / (2 * substeps - 1) if self.bath_divides_drift else self.longest_drift / substeps

    @cached_property
    def momentum_lag(self) -> float:
        """Fraction of a kick by which momenta at the end of a step lag behind those of the palindrome.

        It is 1/2 for Verlet's scheme with a bath in the middle of the drift, and 0 for palindromes. If momenta lag,
        the energy at the end of steps differs in first order of the step from the conserved energy.
        """
        return 0.5 if [stage.flow for stage in self.stages] == [KICK, DRIFT, BATH, DRIFT] else 0.0

    @cached_property
    def longest_drift(self) -> float:
        """Largest magnitude of a drift's fraction of the step; 0 without drifts."""
        return max((abs(stage.fraction) for stage in self.stages if stage.flow == DRIFT), default=0.0)

    @property
    def stability_limit(self) -> float:
        """Product of angular frequency and step below which a harmonic mode stays bounded, 2 for SIER2."""
        return self._limits[0]

    @property
    def accuracy_limit(self) -> float:
        """Product of angular frequency and step below which energies of a mode are right within 10 %."""
        return self._limits[1]

    @property
    def spin_limit(self) -> float:
        """Product of the thermal angular velocity sqrt(kT/I) of a body and the step up to which kicks follow it."""
        return self.accuracy_limit / step_limits.FAST_SPIN

    @cached_property
    def _limits(self) -> tuple[float, float]:
        return step_limits.limits(self.stages)

    @cached_property
    def order(self) -> int:
        """Largest n for which the step is exact up to and including h^n; see `dynamics.order`."""
        return order_of(self.stages)


def alternating(
    name: str, half: tuple[float, ...], source: str = "", first: str = KICK, **usual_steps: float
) -> Scheme:
    """Return a palindrome of alternating kicks and drifts.

    Args:
        name: name of the scheme.
        half: fractions from the outermost stage to the last one before the middle. The middle stage makes the fractions
            of its operator sum to 1.
        source: publication of the scheme.
        first: operator of the outermost stages.
        usual_steps: `constant_energy_step`, `bath_step`, `trial_step` and others of `Scheme`, ps.
    """
    second = KICK if first == DRIFT else DRIFT
    operators = [(first, second)[i % 2] for i in range(len(half) + 1)]
    wings = [Stage(operator, fraction) for operator, fraction in zip(operators, half, strict=False)]
    middle = 1 - 2 * math.fsum(stage.fraction for stage in wings if stage.operator == operators[-1])
    return Scheme(name, (*wings, Stage(operators[-1], middle), *reversed(wings)), source, **usual_steps)


SIER2 = alternating(
    "SIER2",
    (0.5,),
    "van Zon and Schofield (2007), Eq. 7 (Verlet)",
    constant_energy_step=0.002,
    bath_step=0.004,
    heavy_bath_step=0.009,
    trial_step=0.002,
    heavy_trial_step=0.003,
)

#: A constant, since a scheme computes its limits at their first use.
_SIER2_WITH_BATH = SIER2.with_bath()

_H1, _H2, _H3 = 0.1720865590295143, 0.5915620307551568, -0.1616217622107222

#: The paper prints h5 = h - 2(h1 + h2); the kicks sum to h with h5 = h - 2(h1 + h3), which `alternating` derives.
SIER4 = alternating(
    "SIER4",
    (_H1, _H2, _H3, 0.5 - _H2),
    "van Zon and Schofield (2007), Eq. 8 (EFRL); Omelyan, Mryglod and Folk, Comput. Phys. Commun. 146, 188 (2002)",
    constant_energy_step=0.004,
    bath_step=0.005,
    trial_step=0.005,
)

#: The best scheme per force evaluation in liquid water of those without a gradient, which are symplectic to rounding.
SIER4V = alternating(
    "SIER4V",
    (0.08398315262876693, 0.2539785108410595, 0.6822365335719091, -0.03230286765269967, -0.26621968620067603),
    "Omelyan, Mryglod and Folk, Comput. Phys. Commun. 151, 272 (2003), Eqs. 63 and 71",
    constant_energy_step=0.0055,
    bath_step=0.0065,
    trial_step=0.0065,
)

_ENDS = (Stage(KICK, 1 / 6), Stage(DRIFT, 1 / 2))

SIER4G = Scheme(
    "SIER4G",
    (*_ENDS, Stage(GRADIENT_KICK, 2 / 3, 1 / 24), *reversed(_ENDS)),
    "Chin, Phys. Lett. A 226, 344 (1997), algorithm A",
    constant_energy_step=0.004,
    bath_step=0.006,
    heavy_bath_step=0.009,
    trial_step=0.006,
    heavy_trial_step=0.009,
)

#: Of the family drift, kick, drift, gradient kick, drift, kick, drift of fourth order: the share of a kick, which fixes
#: the outer drift and the force gradient.
_SHARE = 0.2470939580390842
_OUTER = 0.5 - 1 / math.sqrt(24 * _SHARE)
_WING = (Stage(DRIFT, _OUTER), Stage(KICK, _SHARE), Stage(DRIFT, 0.5 - _OUTER))
_BRACKET = (1 - math.sqrt(6 * _SHARE) * (1 - _SHARE)) / 12

#: The position form of a gradient scheme, in which drifts come first and last.
SIER4P = Scheme(
    "SIER4P",
    (*_WING, Stage(GRADIENT_KICK, 1 - 2 * _SHARE, 2 * _BRACKET / (1 - 2 * _SHARE)), *reversed(_WING)),
    "Omelyan, Mryglod and Folk, Comput. Phys. Commun. 151, 272 (2003), Eq. 44",
    constant_energy_step=0.005,
    bath_step=0.006,
    trial_step=0.006,
)

#: Two stages with the least sum of squares of their two errors of second order: for 3 fs per force evaluation.
SIER2V2 = alternating(
    "SIER2V2",
    (0.1931833275037836, 0.5),
    "McLachlan, SIAM J. Sci. Comput. 16, 151 (1995); Omelyan, Mryglod and Folk, Phys. Rev. E 65, 056706 (2002)",
    constant_energy_step=0.006,
    bath_step=0.006,
    trial_step=0.006,
    heavy_trial_step=0.009,
)

#: Of the family of three stages that no harmonic mode makes unstable near half its period: there the trace of a step
#: touches -2 and turns back (`step_limits`), which fixes one of the two coefficients. It is computed here, since the
#: published digits fulfil this condition less well.
_FIRST = 0.11888010966548

#: The best scheme without a gradient at 4 fs per force evaluation, where it is as accurate as Verlet at 2 fs.
SIER2P3 = alternating(
    "SIER2P3",
    (_FIRST, (0.5 - _FIRST) / (2 - 6 * _FIRST), 0.5 - _FIRST),
    "Blanes, Casas and Sanz-Serna, SIAM J. Sci. Comput. 36, A1556 (2014), three stages",
    DRIFT,
    constant_energy_step=0.012,
    bath_step=0.012,
    trial_step=0.009,
    heavy_trial_step=0.015,
)

#: The schemes that users can name. Which one conserves the energy of liquid water best depends on the simulated time
#: per force evaluation (docs/measurements/accuracy.md). It is SIER4P up to 1.5 fs, SIER4G or SIER4P at 2 fs, SIER2V2,
#: SIER2P3 or SIER4P at 3 fs, and SIER2P3 beyond. SIER4V is the best of fourth order without a gradient, SIER2 has the
#: cheapest step, and SIER4 is the paper's.
CATALOGUE = {scheme.name.lower(): scheme for scheme in (SIER2, SIER2V2, SIER2P3, SIER4, SIER4V, SIER4G, SIER4P)}
