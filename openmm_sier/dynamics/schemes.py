"""Splitting schemes as data.

A `Scheme` is a list of (operator, fraction of the step). Operators are known by name here; what they do stands in
`openmm_sier.dynamics.operators`. Order, symmetry and cost are derived from the list.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property

from openmm_sier.dynamics import stability
from openmm_sier.dynamics.stages import BATH, DRIFT, GRADIENT_KICK, KICK, Stage

#: Coefficients are taken to satisfy an order condition when it holds to this; published ones have 16 digits.
CONDITION_TOLERANCE = 1e-12
HIGHEST_ORDER = 6

#: A gradient kick displaces the force by a finite amount: it is known as an exponential of operators up to this order.
HIGHEST_GRADIENT_ORDER = 4

Word = tuple[str, ...]


@dataclass(frozen=True)
class Scheme:
    """One step of a symplectic integrator, the first stage first.

    Attributes:
        name: for messages and output.
        stages: `Stage`s, or tuples (operator name, fraction of the step) that become such.
        source: publication of the scheme.

    Raises:
        ValueError: there are no stages, the fractions of a flow do not sum to 1, or a plain operator has a shift.
    """

    name: str
    stages: tuple[Stage, ...]
    source: str = ""

    def __post_init__(self):
        object.__setattr__(self, "stages", tuple(Stage(*stage) for stage in self.stages))
        if not self.stages:
            raise ValueError(f"scheme {self.name} has no stages")
        for stage in self.stages:
            if stage.shift and stage.operator != GRADIENT_KICK:
                raise ValueError(
                    f"scheme {self.name}: only a '{GRADIENT_KICK}' has a shift, got one for '{stage.operator}'"
                )
        for operator in dict.fromkeys(stage.flow for stage in self.stages):
            total = math.fsum(stage.fraction for stage in self.stages if stage.flow == operator)
            if not math.isclose(total, 1.0, rel_tol=0.0, abs_tol=1e-14):
                raise ValueError(f"scheme {self.name}: fractions of '{operator}' must sum to 1, they sum to {total!r}")

    @property
    def operators(self) -> tuple[str, ...]:
        """Names of the operators, in order of appearance."""
        return tuple(dict.fromkeys(stage.operator for stage in self.stages))

    @property
    def is_palindrome(self) -> bool:
        """Whether the list reads the same backwards, which makes the step time-reversible."""
        return self.stages == self.stages[::-1]

    @property
    def reuses_force(self) -> bool:
        """Whether the force at the end of a step is the one at the start of the next."""
        return all(DRIFT not in _before_kick(stages) for stages in (self.stages, self.stages[::-1]))

    @property
    def force_evaluations(self) -> int:
        """Force evaluations a step, the first step of a run aside.

        One for each kick at positions that a drift has changed, and one for the displaced force of a gradient kick.
        """
        moved, count = True, 0
        for _ in range(2):
            count = 0
            for stage in self.stages:
                if stage.operator == DRIFT:
                    moved = True
                elif stage.flow == KICK:
                    count += int(moved) + int(stage.operator == GRADIENT_KICK)
                    moved = False
        return count

    def without(self, operator: str) -> Scheme:
        """This scheme where an operator does nothing: its stages dropped, neighbours of one kind joined."""
        stages: list[Stage] = []
        for stage in self.stages:
            if stage.operator == operator:
                continue
            if stages and stages[-1].operator == stage.operator and not stage.shift:
                stages[-1] = Stage(stage.operator, stages[-1].fraction + stage.fraction)
            else:
                stages.append(stage)
        return Scheme(self.name, tuple(stages), self.source)

    def with_bath(self) -> Scheme:
        """This scheme with a heat bath, symmetrically: in the middle of its middle drift, or else half at either end.

        For SIER2 that is kick, half drift, bath, half drift, kick (Leimkuhler and Matthews, Appl. Math. Res. Express
        2013, 34). A scheme that has a bath is returned as it is.
        """
        if BATH in self.operators:
            return self
        middle = len(self.stages) // 2
        if len(self.stages) % 2 and self.stages[middle].operator == DRIFT:
            half = Stage(DRIFT, 0.5 * self.stages[middle].fraction)
            stages = (*self.stages[:middle], half, Stage(BATH, 1.0), half, *self.stages[middle + 1 :])
        else:
            stages = (Stage(BATH, 0.5), *self.stages, Stage(BATH, 0.5))
        return Scheme(self.name, stages, self.source)

    @cached_property
    def stability_limit(self) -> float:
        """Product of angular frequency and step below which a harmonic mode stays bounded: 2 for SIER2."""
        return stability.stability_limit(self.stages)

    @cached_property
    def accuracy_limit(self) -> float:
        """Product of angular frequency and step up to which the energies of a harmonic mode are right within 10 %."""
        return stability.accuracy_limit(self.stages)

    @cached_property
    def order(self) -> int:
        """Largest n for which the step is exact up to and including h^n.

        The product of exponentials is expanded in words of the operators (their free associative algebra) and compared
        with the exponential of the sum, in which a word of length k has the coefficient 1/k!. The one property of the
        operators that is used is the one of Runge-Kutta-Nystroem schemes, [B, [B, [B, A]]] = 0 of a kick B and a drift
        A, since the kinetic energy is quadratic in the momenta (see `_reduced`).
        """
        letters = tuple(dict.fromkeys(stage.flow for stage in self.stages))
        coefficients: dict[Word, float] = {(): 1.0}
        for stage in self.stages:
            coefficients = _product(coefficients, _exponential(_generator(stage)))
        order = 0
        highest = HIGHEST_GRADIENT_ORDER if any(stage.shift for stage in self.stages) else HIGHEST_ORDER
        for length in range(1, highest + 1):
            exact = 1 / math.factorial(length)
            words = itertools.product(letters, repeat=length)
            errors = _reduced({word: coefficients.get(word, 0.0) - exact for word in words})
            if any(abs(error) > CONDITION_TOLERANCE for error in errors.values()):
                break
            order = length
        return order


def _before_kick(stages) -> list[str]:
    """Names of the operators before the first kick."""
    return [stage.operator for stage in itertools.takewhile(lambda stage: stage.flow != KICK, stages)]


def _generator(stage: Stage) -> dict[Word, float]:
    """What a stage is the exponential of, by words.

    A gradient kick B of the shift d is that of B + (d/2) [B, [A, B]] with A the drift, up to the third order.
    """
    letter = stage.flow
    words: dict[Word, float] = {(letter,): stage.fraction}
    if stage.shift:
        half = 0.5 * stage.fraction * stage.shift
        words[letter, DRIFT, letter] = 2 * half
        words[letter, letter, DRIFT] = words[DRIFT, letter, letter] = -half
    return words


def _reduced(words: dict[Word, float]) -> dict[Word, float]:
    """An equal sum of words, in which no word has three kicks B before a drift A.

    The operators obey [B, [B, [B, A]]] = 0, that is BBBA = 3 BBAB - 3 BABB + ABBB. BBBA begins with no end of itself,
    so that the words that are left do not depend on the order of the replacements, and their sum vanishes only where
    all their coefficients do (a Groebner basis).
    """
    rule = ((3.0, (KICK, KICK, DRIFT, KICK)), (-3.0, (KICK, DRIFT, KICK, KICK)), (1.0, (DRIFT, KICK, KICK, KICK)))
    reduced: dict[Word, float] = {}
    pending = list(words.items())
    while pending:
        word, value = pending.pop()
        start = next((i for i in range(len(word) - 3) if word[i : i + 4] == (KICK, KICK, KICK, DRIFT)), None)
        if start is None:
            reduced[word] = reduced.get(word, 0.0) + value
        else:
            pending += [(word[:start] + other + word[start + 4 :], factor * value) for factor, other in rule]
    return reduced


def _product(left: dict[Word, float], right: dict[Word, float]) -> dict[Word, float]:
    """The product of two sums of words, words up to `HIGHEST_ORDER` long."""
    product: dict[Word, float] = {}
    for first, a in left.items():
        for second, b in right.items():
            if len(first) + len(second) <= HIGHEST_ORDER:
                product[first + second] = product.get(first + second, 0.0) + a * b
    return product


def _exponential(generator: dict[Word, float]) -> dict[Word, float]:
    power: dict[Word, float] = {(): 1.0}
    total = dict(power)
    for n in range(1, HIGHEST_ORDER + 1):
        power = {word: value / n for word, value in _product(power, generator).items()}
        for word, value in power.items():
            total[word] = total.get(word, 0.0) + value
    return total


def alternating(name: str, first: str, second: str, half: tuple[float, ...], source: str = "") -> Scheme:
    """The palindrome that alternates two operators.

    Args:
        name: of the scheme.
        first: operator of the outermost stages.
        second: the other operator.
        half: fractions from the outermost stage to the last one before the middle. The middle stage, which follows
            it, takes what its operator lacks to 1.
        source: publication of the scheme.
    """
    operators = [(first, second)[i % 2] for i in range(len(half) + 1)]
    wings = [Stage(operator, fraction) for operator, fraction in zip(operators, half, strict=False)]
    middle = 1 - 2 * math.fsum(stage.fraction for stage in wings if stage.operator == operators[-1])
    return Scheme(name, (*wings, Stage(operators[-1], middle), *reversed(wings)), source)


SIER2 = alternating("SIER2", KICK, DRIFT, (0.5,), "van Zon and Schofield (2007), Eq. Verlet")

_H1, _H2, _H3 = 0.1720865590295143, 0.5915620307551568, -0.1616217622107222

#: The paper prints h5 = h - 2(h1 + h2); the kicks sum to h with h5 = h - 2(h1 + h3), which `alternating` derives.
SIER4 = alternating(
    "SIER4",
    KICK,
    DRIFT,
    (_H1, _H2, _H3, 0.5 - _H2),
    "van Zon and Schofield (2007), Eq. EFRL; Omelyan, Mryglod and Folk, Comput. Phys. Commun. 146, 188 (2002)",
)

#: Of the schemes without a gradient, which are symplectic to rounding, the best for each force in liquid water.
SIER4V = alternating(
    "SIER4V",
    KICK,
    DRIFT,
    (0.08398315262876693, 0.2539785108410595, 0.6822365335719091, -0.03230286765269967, -0.26621968620067603),
    "Omelyan, Mryglod and Folk, Comput. Phys. Commun. 151, 272 (2003), Eqs. 63 and 71",
)

SIER4G = Scheme(
    "SIER4G",
    (
        Stage(KICK, 1 / 6),
        Stage(DRIFT, 1 / 2),
        Stage(GRADIENT_KICK, 2 / 3, 1 / 24),
        Stage(DRIFT, 1 / 2),
        Stage(KICK, 1 / 6),
    ),
    "Chin, Phys. Lett. A 226, 344 (1997), algorithm A",
)


def _gradient_in_the_middle(share: float) -> tuple[Stage, ...]:
    """The family drift, kick, drift, gradient kick, drift, kick, drift of fourth order; `share` is that of a kick."""
    outer = 0.5 - 1 / math.sqrt(24 * share)
    bracket = (1 - math.sqrt(6 * share) * (1 - share)) / 12
    middle = Stage(GRADIENT_KICK, 1 - 2 * share, 2 * bracket / (1 - 2 * share))
    half = (Stage(DRIFT, outer), Stage(KICK, share), Stage(DRIFT, 0.5 - outer))
    return (*half, middle, *reversed(half))


#: The position form of a gradient scheme: drifts come first and last.
SIER4P = Scheme(
    "SIER4P",
    _gradient_in_the_middle(0.2470939580390842),
    "Omelyan, Mryglod and Folk, Comput. Phys. Commun. 151, 272 (2003), Eq. 44",
)

#: The schemes that users can name. Which one conserves the energy of liquid water best depends on the simulated time
#: for each force evaluation (`openmm-sier schemes`): SIER4P up to 1.5 fs, SIER4G or SIER4P at 2 fs. SIER4V is the best
#: without a gradient, SIER2 bears the longest steps for each force, and SIER4 is the paper's.
CATALOGUE = {scheme.name.lower(): scheme for scheme in (SIER2, SIER4, SIER4V, SIER4G, SIER4P)}
