"""One look for every method in every figure."""

from studies import methods, style

COMPARED = {method.name for method in (*methods.CONSTANT_ENERGY.values(), *methods.PAPER, *methods.REVERSIBLE.values())}
COMPARED |= {method.name for method in methods.with_bath(methods.Bath(300, 1), 1).values()}


def test_every_method_that_can_be_compared_has_a_look():
    assert [name for name in sorted(COMPARED) if style.of_method(name)["color"] == style.UNKNOWN[0]] == []
