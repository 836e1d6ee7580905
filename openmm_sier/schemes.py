"""Splitting schemes as data.

A `Scheme` is a list of (operator, fraction of the step). Operators are known by name here; what they do stands in
`openmm_sier.propagation`. Order, symmetry and cost are derived from the list.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property

KICK = "kick"
DRIFT = "drift"
BATH = "bath"

#: Coefficients are taken to satisfy an order condition when it holds to this; published ones have 16 digits.
CONDITION_TOLERANCE = 1e-12
HIGHEST_ORDER = 6


@dataclass(frozen=True)
class Scheme:
    """One step of a symplectic integrator, the first stage first.

    Attributes:
        name: for messages and output.
        stages: pairs of operator name and fraction of the step.
        source: publication of the scheme.

    Raises:
        ValueError: there are no stages, a fraction is not finite, or the fractions of an operator do not sum to 1.
    """

    name: str
    stages: tuple[tuple[str, float], ...]
    source: str = ""

    def __post_init__(self):
        object.__setattr__(self, "stages", tuple((str(o), float(f)) for o, f in self.stages))
        if not self.stages:
            raise ValueError(f"scheme {self.name} has no stages")
        for operator in self.operators:
            fractions = [f for o, f in self.stages if o == operator]
            total = math.fsum(fractions)
            if not math.isclose(total, 1.0, abs_tol=1e-14):
                raise ValueError(f"scheme {self.name}: fractions of '{operator}' must sum to 1, they sum to {total!r}")

    @property
    def operators(self) -> tuple[str, ...]:
        """Names of the operators, in order of appearance."""
        return tuple(dict.fromkeys(o for o, _ in self.stages))

    @property
    def is_palindrome(self) -> bool:
        """Whether the list reads the same backwards, which makes the step time-reversible."""
        return self.stages == self.stages[::-1]

    @property
    def reuses_force(self) -> bool:
        """Whether the force at the end of a step is the one at the start of the next."""
        return all(DRIFT not in _before(stages, KICK) for stages in (self.stages, self.stages[::-1]))

    @property
    def force_evaluations(self) -> int:
        """Force evaluations a step, the first step of a run aside: kicks at positions that a drift has changed."""
        moved, count = True, 0
        for _ in range(2):
            count = 0
            for operator, _ in self.stages:
                if operator == DRIFT:
                    moved = True
                elif operator == KICK and moved:
                    moved, count = False, count + 1
        return count

    def without(self, operator: str) -> Scheme:
        """This scheme where an operator does nothing: its stages dropped, neighbours of one kind joined."""
        stages: list[tuple[str, float]] = []
        for name, fraction in self.stages:
            if name == operator:
                continue
            if stages and stages[-1][0] == name:
                stages[-1] = (name, stages[-1][1] + fraction)
            else:
                stages.append((name, fraction))
        return Scheme(self.name, tuple(stages), self.source)

    def with_bath(self) -> Scheme:
        """This scheme with a heat bath, symmetrically: in the middle of its middle drift, or else half at either end.

        For SIER2 that is kick, half drift, bath, half drift, kick (Leimkuhler and Matthews, Appl. Math. Res. Express
        2013, 34). A scheme that has a bath is returned as it is.
        """
        if BATH in self.operators:
            return self
        middle = len(self.stages) // 2
        if len(self.stages) % 2 and self.stages[middle][0] == DRIFT:
            half = (DRIFT, 0.5 * self.stages[middle][1])
            stages = (*self.stages[:middle], half, (BATH, 1.0), half, *self.stages[middle + 1 :])
        else:
            stages = ((BATH, 0.5), *self.stages, (BATH, 0.5))
        return Scheme(self.name, stages, self.source)

    @cached_property
    def order(self) -> int:
        """Largest n for which the step is exact up to and including h^n.

        The product of exponentials is expanded in words of the operators (their free associative algebra) and compared
        with the exponential of the sum, in which a word of length k has the coefficient 1/k!. No property of the
        operators is assumed, so that a scheme that needs one (Runge-Kutta-Nystroem) may do better than this.
        """
        letters = self.operators
        coefficients: dict[tuple[str, ...], float] = {(): 1.0}
        for operator, fraction in self.stages:
            coefficients = _append_exponential(coefficients, operator, fraction)
        order = 0
        for length in range(1, HIGHEST_ORDER + 1):
            exact = 1 / math.factorial(length)
            words = itertools.product(letters, repeat=length)
            if any(abs(coefficients.get(word, 0.0) - exact) > CONDITION_TOLERANCE for word in words):
                break
            order = length
        return order


def _before(stages, operator):
    """Names of the stages before the first of an operator."""
    return [name for name, _ in itertools.takewhile(lambda stage: stage[0] != operator, stages)]


def _append_exponential(coefficients, letter, fraction):
    """Word coefficients of (what they describe) times exp(fraction * letter), words up to `HIGHEST_ORDER` long."""
    product: dict[tuple[str, ...], float] = {}
    for word, value in coefficients.items():
        for power in range(HIGHEST_ORDER - len(word) + 1):
            longer = word + (letter,) * power
            product[longer] = product.get(longer, 0.0) + value * fraction**power / math.factorial(power)
    return product


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
    wings = list(zip(operators, half, strict=False))
    middle = 1 - 2 * math.fsum(f for o, f in wings if o == operators[-1])
    return Scheme(name, (*wings, (operators[-1], middle), *reversed(wings)), source)


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

#: The schemes that users can name.
CATALOGUE = {scheme.name.lower(): scheme for scheme in (SIER2, SIER4)}
