"""The order of a sequence of stages, from the free associative algebra of its operators.

The product of the exponentials of the stages is expanded in words of the operators and compared with the exponential of
their sum, in which a word of length k has the coefficient 1/k!. One property of the operators is used, that of
Runge-Kutta-Nystroem schemes: [B, [B, [B, A]]] = 0 for a kick B and a drift A, since the kinetic energy is quadratic in
the momenta (see `_reduced`).
"""

import functools
import itertools
import math

from openmm_sier.dynamics.stages import DRIFT, KICK, Stage

#: An order condition counts as satisfied if it holds to this accuracy; published coefficients have 16 digits.
CONDITION_TOLERANCE = 1e-12
HIGHEST_ORDER = 6

#: A gradient kick displaces the force by a finite amount, so that it is an exponential of operators only up to this
#: order.
HIGHEST_GRADIENT_ORDER = 4

Word = tuple[str, ...]


@functools.cache
def order_of(stages: tuple[Stage, ...]) -> int:
    """Return the largest n for which the stages of a step are the exact motion up to and including h^n."""
    coefficients: dict[Word, float] = {(): 1.0}
    for stage in stages:
        coefficients = _product(coefficients, _exponential(_generator(stage)))
    highest = HIGHEST_GRADIENT_ORDER if any(stage.shift for stage in stages) else HIGHEST_ORDER
    for length in range(1, highest + 1):
        words = itertools.product({stage.flow for stage in stages}, repeat=length)
        errors = _reduced({word: coefficients.get(word, 0.0) - 1 / math.factorial(length) for word in words})
        if any(abs(error) > CONDITION_TOLERANCE for error in errors.values()):
            return length - 1
    return highest


def _generator(stage: Stage) -> dict[Word, float]:
    """Return the generator of a stage, whose exponential it is, by words.

    A gradient kick B with shift d is the exponential of B + (d/2) [B, [A, B]], with A the drift, up to the third order.
    """
    letter = stage.flow
    words: dict[Word, float] = {(letter,): stage.fraction}
    if stage.shift:
        half = 0.5 * stage.fraction * stage.shift
        words[letter, DRIFT, letter] = 2 * half
        words[letter, letter, DRIFT] = words[DRIFT, letter, letter] = -half
    return words


def _reduced(words: dict[Word, float]) -> dict[Word, float]:
    """Return an equal sum of words, in which no word has three kicks B before a drift A.

    The operators obey [B, [B, [B, A]]] = 0, that is BBBA = 3 BBAB - 3 BABB + ABBB. No end of BBBA is also its
    beginning, so that the remaining words do not depend on the order of the replacements, and their sum vanishes only
    if all their coefficients do (a Groebner basis).
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
    """Return the product of two sums of words, words up to `HIGHEST_ORDER` long."""
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
