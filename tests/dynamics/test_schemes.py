"""Schemes: their checks and derived properties."""

import dataclasses

import numpy as np
import pytest
from scipy.linalg import expm

from openmm_sier import SIER2, SIER2P3, SIER2V2, SIER4, Scheme
from openmm_sier.dynamics.schemes import CATALOGUE, DRIFT, KICK, alternating

EULER = Scheme("Euler", ((KICK, 1.0), (DRIFT, 1.0)))

#: Yoshida's triple jump, Phys. Lett. A 150, 262 (1990): fourth order and three force evaluations.
X1 = 1 / (2 - 2 ** (1 / 3))
YOSHIDA = alternating("Yoshida", (X1 / 2, X1, (1 - X1) / 2), first=DRIFT)


def measured_order(scheme):
    """Order of the step for two random matrices A and B, which satisfy no relation: exp(h(A + B)) is the exact flow."""
    rng = np.random.default_rng(4)
    operators = {name: rng.normal(size=(5, 5)) for name in scheme.operators}
    total = sum(operators.values())

    def error(h):
        product = np.eye(5)
        for stage in scheme.stages:
            product = product @ expm(stage.fraction * h * operators[stage.operator])
        return np.abs(product - expm(h * total)).max()

    return np.log2(error(0.04) / error(0.02)) - 1


@pytest.mark.parametrize(
    ("scheme", "order"), [(EULER, 1), (SIER2, 2), (SIER4, 4), (YOSHIDA, 4)], ids=lambda v: str(v)[:20]
)
def test_order(scheme, order):
    assert scheme.order == order
    # Of the next order in h there is an error of relative size h.
    assert measured_order(scheme) == pytest.approx(order, abs=0.3)


#: Sixth order only where the kinetic energy is quadratic (Runge-Kutta-Nystroem): Blanes and Moan (2002), SRKN 11.
_KICKS = (0.0414649985182624, 0.198128671918067, -0.0400061921041533, 0.0752539843015807, -0.0115113874206879)
_DRIFTS = (0.123229775946271, 0.290553797799558, -0.127049212625417, -0.246331761062075, 0.357208872795928)
_WING = [fraction for pair in zip(_KICKS, _DRIFTS, strict=True) for fraction in pair]
NYSTROEM = alternating("SRKN 11", (*_WING, 0.5 - sum(_KICKS)))


def test_order_of_a_scheme_for_quadratic_kinetic_energy():
    """For operators in general it is of a lower order."""
    assert NYSTROEM.order == 6
    assert measured_order(NYSTROEM) < 5


def altered(scheme, change):
    """The scheme with its first and last stage changed; the middle one makes up for it."""
    half = [stage.fraction for stage in scheme.stages[: len(scheme.stages) // 2]]
    return alternating("altered", (half[0] + change, *half[1:]))


def test_broken_coefficients_lower_the_order():
    for change in (1e-3, 1e-9):
        broken = altered(SIER4, change)
        assert broken.is_palindrome
        assert broken.order == 2
    assert altered(SIER4, 0.0).order == 4
    # The paper's 16 digits leave the conditions unfulfilled by less than the tolerance.
    assert altered(SIER4, 1e-16).order == 4
    lopsided = Scheme("lopsided", ((KICK, 0.4), (DRIFT, 1.0), (KICK, 0.6)))
    assert lopsided.order == 1
    assert measured_order(lopsided) == pytest.approx(1, abs=0.3)


def test_three_operators():
    """The order conditions hold for any number of operators: a symmetric product of three is of second order."""
    scheme = Scheme("ABCBA", (("A", 0.5), ("B", 0.5), ("C", 1.0), ("B", 0.5), ("A", 0.5)))
    assert scheme.order == 2
    assert measured_order(scheme) == pytest.approx(2, abs=0.3)


@pytest.mark.parametrize(
    ("scheme", "evaluations", "reuses"),
    [
        (SIER2, 1, True),
        (SIER2V2, 2, True),
        (SIER2P3, 3, False),
        (SIER4, 4, True),
        (EULER, 1, False),
        (YOSHIDA, 3, False),
        (alternating("position Verlet", (0.5,), first=DRIFT), 1, False),
        (Scheme("two kicks in a row", ((KICK, 0.25), (KICK, 0.25), (DRIFT, 1.0), (KICK, 0.5))), 1, True),
        (Scheme("drift", ((DRIFT, 1.0),)), 0, None),
    ],
    ids=lambda v: getattr(v, "name", str(v)),
)
def test_cost(scheme, evaluations, reuses):
    assert scheme.force_evaluations == evaluations
    if reuses is not None:
        assert scheme.reuses_force is reuses


def test_the_published_coefficients_of_schemes_for_long_steps():
    """McLachlan's two stages, and the digits of Blanes, Casas and Sanz-Serna for three, of which one is computed."""
    two, three = ([stage.fraction for stage in scheme.stages] for scheme in (SIER2V2, SIER2P3))
    assert two[:3] == [0.1931833275037836, 0.5, 1 - 2 * 0.1931833275037836]
    # McLachlan's has the least sum of squares of the two errors of second order, those of [A, [A, B]] and [B, [A, B]].
    share = np.linspace(0.19, 0.2, 1001)
    first, second = (1 - 6 * share + 6 * share**2) / 12, (1 - 6 * share) / 24
    assert share[np.argmin(first**2 + second**2)] == pytest.approx(two[0], abs=2e-5)
    assert three[:2] == pytest.approx([0.11888010966548, 0.29619504261126], abs=5e-14)
    for scheme in (SIER2V2, SIER2P3):
        assert scheme.is_palindrome
        assert scheme.order == 2
        assert measured_order(scheme) == pytest.approx(2, abs=0.3)


def test_every_scheme_names_its_source():
    for name, scheme in CATALOGUE.items():
        assert name == scheme.name.lower()
        assert scheme.source


def test_schemes_are_frozen_values():
    with pytest.raises(dataclasses.FrozenInstanceError):
        SIER2.stages = ()
    again = Scheme(SIER2.name, [[KICK, 0.5], [DRIFT, 1], [KICK, 0.5]], SIER2.source)
    assert again == SIER2
    assert hash(again) == hash(SIER2)


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        ((), "scheme X has no stages"),
        (((KICK, 0.5), (DRIFT, 1.0)), r"scheme X: .*'kick' must sum to 1, got 0\.5"),
        (((KICK, 1.0), (DRIFT, 1.1)), r"'drift' must sum to 1, got 1\.1"),
        (((KICK, float("nan")), (DRIFT, 1.0)), r"fractions and shifts must be finite, got \('kick', nan, 0\.0\)"),
        (
            ((KICK, 0.5, 0.1), (DRIFT, 1.0), (KICK, 0.5, 0.1)),
            "only a 'gradient kick' has a shift, got one for 'kick'",
        ),
        # Rounding of nine coefficients is 1e-15; this is a wrong digit.
        (((KICK, 0.5), (DRIFT, 1.0), (KICK, 0.5 + 1e-12)), "'kick' must sum to 1"),
    ],
)
def test_schemes_check_themselves(stages, message):
    with pytest.raises(ValueError, match=message):
        Scheme("X", stages)


def test_alternating_completes_the_middle():
    scheme = alternating("X", (0.3, 0.5))
    expected = ((KICK, 0.3), (DRIFT, 0.5), (KICK, 0.4), (DRIFT, 0.5), (KICK, 0.3))
    assert scheme.stages == Scheme("", expected).stages
    with pytest.raises(ValueError, match="'drift'"):
        alternating("X", (0.3, 0.6))
